"""The demo town some years before its photos, as aerial surveys deliver it.

As a textured map, one GLB file: what stood then, in the colours it had, in another season. The ground is
painted from above, each face of a building on a rectangle of its own; texels are shaded where they lie in the
world, in the light of one day. Of any textured mesh: a surface model and an orthophoto, from above.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.citymodel.textured_map import TexturedMesh
from lodbench.errors import RenderingError
from lodbench.kernels import bake, draw_from_above, light_corners
from lodbench.kernels.looks import CameraResponse, Look, Shading, SurfaceClass
from lodbench.rendering.raster import RasterRenderer
from lodbench.storage import random_stream, write_bytes
from lodbench.synthesis.objects import MeshBuilder, SceneProps
from lodbench.synthesis.photo import (
    ON_GROUND,
    LookRanges,
    apply_camera_response,
    draw_look,
    draw_sun_map,
    make_render_scene,
    make_skin,
    plain_shading,
)
from lodbench.synthesis.town.buildings import Age
from lodbench.synthesis.town.props import add_buildings, add_greenery, building_colours, fine_bodies
from lodbench.synthesis.town.town import ORIGIN_M, Town, add_ground

Floats = NDArray[np.float64]

_GROUND_TEXEL_M, _FACE_TEXEL_M = 0.3, 0.2
# A face's rectangle is at least this large; smaller ones, panes and ledges, have one colour.
_LEAST_FACE_M2 = 4.0
_MARGIN = 2  # texels round a rectangle: a neighbour's do not bleed in where pictures are halved
_ATLAS_WIDTH = 2048


class Layout(NamedTuple):
    """Triangles on one picture."""

    triangle: NDArray[np.int64]  # (N,) their numbers
    # (N, 3, 2) float64 column and row of the corners, the picture's upper left corner being (0, 0).
    texels: Floats
    size: tuple[int, int]  # width and height of the picture
    texel_m: float  # size of a texel


def lay_out_ground(
    corners: Floats, triangle: NDArray[np.int64], square: tuple[float, float, float]
) -> Layout:
    """Returns ground triangles viewed from above; those that reach out of the picture are left out.

    They are those with some numbers, (N,), of all corners, (T, 3, 3) metres. The picture's square is its west
    and south edges and its side, metres.
    """
    west, south, side = square
    texels = (corners[triangle, :, :2] - (west, south)) / _GROUND_TEXEL_M
    count = int(np.ceil(side / _GROUND_TEXEL_M))
    texels[..., 1] = count - texels[..., 1]
    inside = ((texels >= 1) & (texels <= count - 1)).all(axis=(1, 2))
    return Layout(triangle[inside], texels[inside], (count, count), _GROUND_TEXEL_M)


def lay_out_faces(corners: Floats, triangle: NDArray[np.int64], polygon: NDArray[np.int64]) -> Layout:
    """Returns the triangles of planar polygons, each polygon on a rectangle, packed in rows.

    They are those with some numbers, (N,), of all corners, (T, 3, 3) metres; those of one polygon, of which
    ``polygon``, (T,), tells, lie in a row. Small polygons are left out.
    """
    starts = np.flatnonzero(np.diff(polygon[triangle], prepend=-1))
    own = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(triangle))))
    flat = _on_plane(corners[triangle], starts, own)
    low, high = np.full((len(starts), 2), np.inf), np.full((len(starts), 2), -np.inf)
    np.minimum.at(low, own, flat.min(axis=1))
    np.maximum.at(high, own, flat.max(axis=1))
    side_m = np.minimum(high - low, (_ATLAS_WIDTH - 4 * _MARGIN) * _FACE_TEXEL_M)
    sides = np.ceil(side_m / _FACE_TEXEL_M).astype(np.int64) + 2 * _MARGIN
    is_large = side_m.prod(axis=1) >= _LEAST_FACE_M2
    places, height = _packed(sides[is_large])
    place = np.zeros((len(starts), 2), dtype=np.int64)
    place[is_large] = places
    texels = (flat - low[own, None]) / _FACE_TEXEL_M + (place + _MARGIN)[own, None]
    kept = is_large[own]
    return Layout(triangle[kept], texels[kept], (_ATLAS_WIDTH, height), _FACE_TEXEL_M)


def _on_plane(corners: Floats, starts: NDArray[np.int64], own: NDArray[np.int64]) -> Floats:
    """Returns (N, 3, 2) metres along two axes of each polygon's plane, the first of them level."""
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = np.add.reduceat(areas, starts, axis=0)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    is_level = np.abs(normal[:, 2]) > 0.999
    level = np.stack([-normal[:, 1], normal[:, 0], np.zeros(len(normal))], axis=1)
    level[is_level] = 1.0, 0.0, 0.0
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    steep = np.cross(level, normal)
    axes = np.stack([level, steep], axis=1)[own]
    return np.asarray(np.einsum("nax,ncx->nca", axes, corners))


def _packed(sides: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
    """Returns upper left corners of rectangles, (N, 2), in rows of falling height, and the height of all."""
    places = np.zeros_like(sides)
    column = row = tallest = 0
    for k in np.argsort(-sides[:, 1], kind="stable"):
        width, height = sides[k]
        if column + width > _ATLAS_WIDTH:
            column, row, tallest = 0, row + tallest, 0
        places[k] = column, row
        column, tallest = column + width, max(tallest, height)
    return places, int(row + tallest)


def baked(layout: Layout, corners: Floats, shading: Shading) -> NDArray[np.float32]:
    """Returns the (H, W, 3) linear RGB of a layout's picture; 0 where no triangle lies.

    Later triangles lie on earlier ones. Each is painted a texel further than it reaches, below all others.
    Corners, (T, 3, 3) metres, and shading are of all triangles.
    """
    width, height = layout.size
    light = np.zeros((height, width, 3), dtype=np.float32)
    for margin in (1.5, 0.0):
        bake(layout.triangle, layout.texels, corners, layout.texel_m, margin, shading, light)
    return light


def corner_light(triangle: NDArray[np.int64], corners: Floats, shading: Shading) -> NDArray[np.float32]:
    """Returns the (N, 3, 3) linear RGB of the corners of some triangles; arguments as for ``baked``."""
    light = np.zeros((len(triangle), 3, 3), dtype=np.float32)
    light_corners(triangle, corners, shading, light)
    return light


# The map is a square of tiles round the middle of town; what lies around it has plain colours.
_TILES, _TILE_M, _LAND_M = 4, 325.0, 1500.0
# Ground triangles hang over a tile's edge.
_HANG_M = 24.0
_SUN_MAP, _BAND = 2048, 256
# Shares of what has changed since: facades and roofs in other colours, trees that were not there yet.
REPAINTED, REROOFED, YOUNG_TREES = 0.15, 0.08, 0.08
# A low autumn sun, grass and leaves gone dry; the demo's photos are of late spring to summer.
_DAY = LookRanges(
    sun_elevation_deg=(24.0, 30.0),
    sun_share=(0.5, 0.6),
    sun_warmth=(0.2, 0.5),
    haze_range_m=(1e6, 1e6),
    sky_white=(0.4, 0.7),
    dryness=(0.75, 0.95),
    exposure=(1.05, 1.15),
    saturation=(0.65, 0.75),
    vignette=(0.0, 0.0),
    blur_px=(0.4, 0.5),
    noise=(0.004, 0.008),
)


class Patch(NamedTuple):
    """Triangles of the map that share a picture, or have colours at their corners."""

    name: str  # unique
    corners: Floats  # (N, 3, 3) metres
    texels: Floats | None  # (N, 3, 2) places on the picture, or None
    colours: NDArray[np.uint8]  # (H, W, 3) picture, or (N, 3, 3) colours, uint8 RGB


def write_textured_map(path: Path, town: Town, scene: Scene) -> None:
    """Writes the map of a town at the time of its survey as a ``.glb`` file, whole or not at all.

    It is in the local frame of the scene, which is the town's at any level of detail.
    """
    painter = _Painter(town, scene)
    tiles = [patch for cell in np.ndindex(_TILES, _TILES) for patch in painter.tile(np.array(cell))]
    write_bytes(path, _glb([*tiles, painter.surroundings()]), survives_power_cut=False)


class _Painter:
    """The town then, ready to be painted tile by tile."""

    def __init__(self, town: Town, scene: Scene) -> None:
        then, self.polygon = town_then(town)
        props = then.in_frame(scene.origin)
        self.corners = props.vertices[props.triangles].astype(np.float64)
        self.is_ground = np.isin(props.surface, ON_GROUND)
        look, self.response = survey_look(town.seed)
        self.shading = plain_shading(make_skin(props), look)
        self.middle = (then.origin - scene.origin)[:2]
        place = (self.corners.mean(axis=1)[:, :2] - self.middle) / _TILE_M + _TILES / 2
        self.tile_of = np.floor(place).astype(np.int64)
        self.in_town = ((self.tile_of >= 0) & (self.tile_of < _TILES)).all(axis=1)
        heights = self.corners[self.in_town, :, 2]
        self.levels = float(heights.min()), float(heights.max())
        casters = make_render_scene(scene, props).casters
        if casters is None:
            raise RenderingError("There is nothing to picture.", "Take another seed.")
        self.casters = RasterRenderer(casters, band=_BAND)

    def tile(self, cell: NDArray[np.int64]) -> Iterator[Patch]:
        """Yields ground, faces of houses, and what is too small for a picture, of one tile."""
        corner, name = self.middle + (cell - _TILES / 2) * _TILE_M, f"{cell[0]} {cell[1]}"
        extent = [(*(corner + _TILE_M * np.array(c)), z) for c in np.ndindex(2, 2) for z in self.levels]
        sun = np.array(self.shading.look.sun)
        shading = self.shading._replace(sun_map=draw_sun_map(self.casters, sun, np.array(extent), _SUN_MAP))
        here = np.flatnonzero((self.tile_of == cell).all(axis=1))
        west, south = corner - _HANG_M
        square = (float(west), float(south), _TILE_M + 2 * _HANG_M)
        ground = lay_out_ground(self.corners, here[self.is_ground[here]], square)
        faces = lay_out_faces(self.corners, here[self.polygon[here] >= 0], self.polygon)
        for kind, layout in (("ground", ground), ("houses", faces)):
            if len(layout.triangle):
                picture = apply_camera_response(baked(layout, self.corners, shading), self.response)
                yield Patch(f"{kind} {name}", self.corners[layout.triangle], layout.texels, picture)
        rest = np.setdiff1d(here, np.concatenate([ground.triangle, faces.triangle]))
        if len(rest):
            yield self._plain(f"small {name}", rest, shading)

    def surroundings(self) -> Patch:
        """Returns the land around the town, without shadows."""
        is_near = np.abs(self.corners.mean(axis=1)[:, :2] - self.middle).max(axis=1) < _LAND_M
        return self._plain("around", np.flatnonzero(is_near & ~self.in_town), self.shading)

    def _plain(self, name: str, triangle: NDArray[np.int64], shading: Shading) -> Patch:
        light = corner_light(triangle, self.corners, shading)
        sharp = self.response._replace(blur_px=0.0, noise=0.0)
        return Patch(name, self.corners[triangle], None, apply_camera_response(light, sharp))


def _glb(patches: Sequence[Patch]) -> bytes:
    """Returns patches as a binary glTF file, y up, pictures as JPEG."""
    from PIL import Image

    trimesh: Any = import_module("trimesh")
    scene = trimesh.Scene()
    for patch in patches:
        points = patch.corners.reshape(-1, 3)[:, [0, 2, 1]] * (1.0, 1.0, -1.0)
        visual: Any
        if patch.texels is None:
            visual = trimesh.visual.ColorVisuals(vertex_colors=patch.colours.reshape(-1, 3))
        else:
            height, width = patch.colours.shape[:2]
            uv = patch.texels.reshape(-1, 2) / (width, height)
            uv[:, 1] = 1.0 - uv[:, 1]
            image = Image.fromarray(patch.colours)
            image.format = "JPEG"
            material = trimesh.visual.material.PBRMaterial(
                name=patch.name, baseColorTexture=image, metallicFactor=0.0, roughnessFactor=1.0
            )
            visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
        faces = np.arange(len(points)).reshape(-1, 3)
        mesh = trimesh.Trimesh(points, faces, visual=visual, process=False)
        scene.add_geometry(mesh, node_name=patch.name, geom_name=patch.name)
    return bytes(scene.export(file_type="glb"))


def town_then(town: Town) -> tuple[SceneProps, NDArray[np.int64]]:
    """Returns the town as it was: houses since pulled down stand, new ones do not, raised ones are lower.

    Returns:
        All that stood, in the frame of ``ORIGIN_M``, without cars, which do not stay; and (T,) the planar
        polygon of each triangle, -1 for what is no building's.
    """
    now = {building.identifier: number for number, building in enumerate(town.standing)}
    builder = MeshBuilder(len(now))
    # As for the photos, so that what is still there has the same number and with it the same patterns.
    add_ground(builder, town)
    add_greenery(builder, town)
    land = builder.build(ORIGIN_M)
    draws = random_stream(town.seed, "demo", "survey", "trees").random(int(land.objects.max()) + 1)
    is_tree = np.isin(land.surface, (SurfaceClass.FOLIAGE, SurfaceClass.TRUNK))
    # Some trees were planted since.
    land = land.part(~(is_tree & (draws[land.objects] < YOUNG_TREES)))
    gone = builder.new_objects(len(town.mapped))
    numbers = np.array([now.get(b.identifier, gone[k]) for k, b in enumerate(town.mapped)], dtype=np.int64)
    colours = np.stack([_colours_then(town, building.identifier) for building in town.mapped])
    then = MeshBuilder(len(now))
    bodies = [[(b.lod2, None)] if b.age is Age.RAISED else fine_bodies(b) for b in town.mapped]
    polygon = add_buildings(then, bodies, colours, numbers)
    points, triangles = land.vertices.astype(np.float64), land.triangles.astype(np.int64)
    then.add(land.surface, points, triangles, land.tint.astype(float), land.objects.astype(np.int64))
    return then.build(ORIGIN_M), np.concatenate([polygon, np.full(len(land), -1)])


def survey_look(seed: int) -> tuple[Look, CameraResponse]:
    """Returns the light of the survey's day, and the camera that saw it."""
    look, response = draw_look(_DAY, random_stream(seed, "demo", "survey", "day"))
    return look._replace(seed=seed, haze_per_m=0.0), response


def _colours_then(town: Town, name: str) -> NDArray[np.float64]:
    """Returns a building's colours then, (8, 3) RGB: some facades and roofs have been done over since."""
    colours = building_colours(town, name)
    chances = random_stream(town.seed, "demo", "survey", name)
    other = building_colours(town, f"{name} then")
    draws = chances.random(2)
    if draws[0] < REPAINTED:
        colours[0] = other[0]
    if draws[1] < REROOFED:
        colours[1:3] = other[1:3]
    return colours


NO_DATA = -9999.0


def viewed_from_above(
    corners: Floats, west: float, north: float, cell_m: float, shape: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Returns (rows, columns) the highest point over the middle of each cell, NaN for none, and its triangle.

    Args:
        corners: (T, 3, 3) metres.
        west: Edge of the first cell, metres.
        north: Likewise.
        cell_m: Width of a cell.
        shape: Rows and columns.
    """
    heights, triangle = np.full(shape, np.nan, np.float32), np.full(shape, -1, np.int32)
    scale = np.array([1.0 / cell_m, -1.0 / cell_m, 1.0])
    draw_from_above((corners - (west, north, 0.0)) * scale, heights, triangle)
    return heights, triangle


def orthophoto(
    mesh: TexturedMesh, west: float, north: float, cell_m: float, triangle: NDArray[np.int32]
) -> NDArray[np.uint8]:
    """Returns (rows, columns, 3) RGB of what is viewed from above; black where nothing is.

    Args:
        mesh: In the frame of the cells.
        west: As for ``viewed_from_above``.
        north: Likewise.
        cell_m: Likewise.
        triangle: As that returns it.
    """
    rows, columns = np.nonzero(triangle >= 0)
    own = triangle[rows, columns]
    corners = mesh.corners[own, :, :2]
    places = np.column_stack([west + (columns + 0.5) * cell_m, north - (rows + 0.5) * cell_m])
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = _cross(b - a, c - a)
    weights = (
        np.stack([_cross(b - places, c - places), _cross(c - places, a - places)], axis=1) / area[:, None]
    )
    weights = np.column_stack([weights, 1.0 - weights.sum(axis=1)])
    colours = np.einsum("nk,nkc->nc", weights, mesh.colours[own].astype(np.float64))
    uv = np.einsum("nk,nkc->nc", weights, mesh.uv[own])
    for number, picture in enumerate(mesh.pictures):
        chosen = np.flatnonzero(mesh.picture[own] == number)
        height, width = picture.shape[:2]
        x = np.floor(uv[chosen, 0] * width).astype(np.int64) % width
        y = np.floor((1.0 - uv[chosen, 1]) * height).astype(np.int64) % height
        colours[chosen] = picture[y, x]
    picture = np.zeros((*triangle.shape, 3), np.uint8)
    picture[rows, columns] = np.clip(np.rint(colours), 0, 255)
    return picture


def _cross(first: Floats, second: Floats) -> Floats:
    return np.asarray(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])


def write_surface_model(
    folder: Path,
    mesh: TexturedMesh,
    origin: Floats,
    crs: str,
    *,
    cell_m: float = 0.5,
    noise_m: float = 0.0,
    side_m: float | None = None,
    seed: int = 0,
) -> tuple[Path, Path]:
    """Writes ``dsm.tif`` and ``dop.tif`` (cells of half the width) of a mesh; returns both.

    Args:
        folder: Where; it is there.
        mesh: In a local frame, metres.
        origin: (3,) of that frame in ``crs``.
        crs: Reference system, in metres.
        cell_m: Width of the surface model's cells.
        noise_m: Standard deviation of its heights.
        side_m: Of the square round the mesh's middle that is written; None for all of it.
        seed: Of the noise.
    """
    points = mesh.corners.reshape(-1, 3)
    low, high = points.min(axis=0), points.max(axis=0)
    if side_m is not None:
        middle = 0.5 * (low + high)
        low, high = middle - 0.5 * side_m, middle + 0.5 * side_m
    west, north = (float(value) for value in (np.floor(low[0]), np.ceil(high[1])))
    rows, columns = (int(side) for side in np.ceil((high - low)[[1, 0]] / cell_m))
    shape = (rows, columns)
    heights, _ = viewed_from_above(mesh.corners, west, north, cell_m, shape)
    heights += random_stream(seed, "surface model").normal(scale=noise_m, size=shape) if noise_m else 0.0
    fine = (2 * shape[0], 2 * shape[1])
    _, triangle = viewed_from_above(mesh.corners, west, north, 0.5 * cell_m, fine)
    colours = np.moveaxis(orthophoto(mesh, west, north, 0.5 * cell_m, triangle), 2, 0)
    heights = np.where(np.isnan(heights), NO_DATA, heights + origin[2]).astype(np.float32)
    place = west + float(origin[0]), north + float(origin[1])
    return (
        write_raster(folder / "dsm.tif", heights[None], place, cell_m, crs, nodata=NO_DATA),
        write_raster(folder / "dop.tif", colours, place, 0.5 * cell_m, crs),
    )


def write_raster(
    path: Path, bands: NDArray[Any], place: tuple[float, float], cell_m: float, crs: str, **more: Any
) -> Path:
    """Writes bands (B, rows, columns) as GeoTIFF."""
    import rasterio
    from rasterio.transform import from_origin

    profile = {
        "driver": "GTiff", "count": len(bands), "height": bands.shape[1], "width": bands.shape[2],
        "dtype": bands.dtype, "crs": crs, "transform": from_origin(*place, cell_m, cell_m),
        "tiled": True, "compress": "deflate", **more,
    }  # fmt: skip
    with rasterio.open(path, "w", **profile) as raster:
        raster.write(bands)
    return path
