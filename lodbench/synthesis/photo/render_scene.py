"""What a picture shows, made ready for the kernel: city and props as one mesh in small spatial groups."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.mesh.textured import TexturedMesh
from lodbench.citymodel.scene import Scene
from lodbench.kernels.looks import LAND_COVER, TEXTURED, Charts, Skin, SurfaceClass
from lodbench.rendering.texture_charts import make_charts
from lodbench.rendering.triangle_groups import grouped_scene, triangle_groups
from lodbench.synthesis.objects.scene_props import SceneProps
from lodbench.synthesis.photo.shading import linear

Floats = NDArray[np.float64]

# A surface this steep is a wall; one flatter than the other is a flat roof.
_WALL_UP, _FLAT_UP = 0.3, 0.985
# Share of level tops, as level of detail 1 has, that are painted as tiled roofs.
_TILED_TOPS = 0.5
# Level faces of a building, floors included, that are larger than this are no tiled roof.
_MOST_TILED_M2 = 1600.0
ON_GROUND = [kind for kind in SurfaceClass if kind.is_ground]
_ON_WALLS = [SurfaceClass.WINDOW, SurfaceClass.DOOR, SurfaceClass.FRAME]
_NO_CASTERS = np.array([*ON_GROUND, *_ON_WALLS, LAND_COVER, TEXTURED], dtype=np.uint8)


class RenderScene(NamedTuple):
    """A city with its surroundings, ready to be pictured."""

    mesh: Scene  # its triangles as a ``Scene`` whose "buildings" are groups of neighbours
    skin: Skin  # what they look like
    is_occluder: NDArray[np.bool_]  # (T,) whether a triangle stands before buildings without being one
    casters: Scene | None  # those triangles that cast shadows worth drawing, or None if none do
    charts: Charts  # where on its texture each textured triangle is; its ``Skin.number`` is the row


class _Loose(NamedTuple):
    """Triangles before grouping: corners (T, 3, 3) float64, and per triangle as in ``Skin``."""

    corners: Floats
    surface: NDArray[np.uint8]
    number: NDArray[np.int32]
    tint: NDArray[np.float32]
    is_plain: NDArray[np.bool_]


def make_render_scene(
    scene: Scene, props: SceneProps | None, textured: TexturedMesh | None = None
) -> RenderScene:
    """Returns the render scene of a city and what stands around it, in any frame.

    Where the props hold the buildings themselves, or there is a textured mesh (in the scene's frame), those
    of the scene are left out.
    """
    parts = []
    if textured is None and (props is None or not props.has_buildings):
        parts.append(_of_scene(scene))
    if props is not None:
        parts.append(_of_props(props.in_frame(scene.origin)))
    if textured is not None:
        parts.append(_of_textured(textured))
    order, starts = triangle_groups(np.concatenate([part.corners for part in parts]))
    loose = _Loose(*(np.concatenate(arrays)[order] for arrays in zip(*parts, strict=True)))
    mesh = grouped_scene(loose.corners, starts)
    is_occluder = (loose.surface >= int(SurfaceClass.TRUNK)) & (loose.surface < 100)
    return RenderScene(mesh, _skin(loose), is_occluder, _casters(loose), make_charts(textured))


def make_skin(props: SceneProps) -> Skin:
    """Returns what the triangles of props look like, in their order."""
    return _skin(_of_props(props))


def _skin(loose: _Loose) -> Skin:
    normal = _normals(loose.corners)
    place = _wall_places(loose, normal)
    _add_crowns(place, loose)
    return Skin(normal.astype(np.float32), loose.surface, loose.number, loose.tint, place)


def _casters(loose: _Loose) -> Scene | None:
    """Returns the triangles that cast shadows: not the ground, nor what lies on a wall or a texture."""
    corners = loose.corners[~np.isin(loose.surface, _NO_CASTERS)]
    if not len(corners):
        return None
    order, starts = triangle_groups(corners)
    return grouped_scene(corners[order], starts)


def _of_scene(scene: Scene) -> _Loose:
    """Returns a city's triangles: walls, pitched and flat roofs told apart by their slope."""
    corners = scene.vertices[scene.triangles].astype(np.float64)
    building = np.repeat(np.arange(scene.num_buildings), np.diff(scene.triangle_starts))
    up = np.abs(_normals(corners)[:, 2])
    # A hash of the number, not of the order: the same house has the same roof in every tile.
    tiled = ((building.astype(np.int64) * 2654435761 >> 7) % 1000) < 1000 * _TILED_TOPS
    # Nobody tiles a hall.
    area_m2 = 0.5 * np.linalg.norm(np.cross(*np.diff(corners, axis=1).swapaxes(0, 1)), axis=1)
    level_m2 = np.bincount(building, area_m2 * (up >= _FLAT_UP), scene.num_buildings)
    tiled &= level_m2[building] < _MOST_TILED_M2
    flat = np.where(tiled, SurfaceClass.ROOF_TILE, SurfaceClass.ROOF_FLAT)
    has_slope = np.zeros(scene.num_buildings, dtype=bool)
    has_slope[building[(up > _WALL_UP) & (up < _FLAT_UP)]] = True
    flat = np.where(has_slope[building], SurfaceClass.ROOF_FLAT, flat)
    roof = np.where(up < _FLAT_UP, SurfaceClass.ROOF_TILE, flat)
    surface = np.where(up < _WALL_UP, SurfaceClass.WALL, roof)
    tint = np.full((len(corners), 3), -1.0, dtype=np.float32)
    plain = np.zeros(len(corners), dtype=bool)
    return _Loose(corners, surface.astype(np.uint8), building.astype(np.int32), tint, plain)


def _of_props(props: SceneProps) -> _Loose:
    """Returns the triangles of props; black, which nothing out of doors is, stands for no tint."""
    tint = linear(props.tint).astype(np.float32)
    tint[~props.tint.any(axis=1)] = -1.0
    corners = props.vertices[props.triangles].astype(np.float64)
    plain = np.ones(len(corners), dtype=bool)
    return _Loose(corners, props.surface, props.objects, tint, plain)


def _of_textured(mesh: TexturedMesh) -> _Loose:
    count = len(mesh.corners)
    kinds, numbers = np.full(count, TEXTURED, np.uint8), np.arange(count, dtype=np.int32)
    return _Loose(mesh.corners, kinds, numbers, np.zeros((count, 3), np.float32), np.ones(count, bool))


def _normals(corners: Floats) -> Floats:
    """Returns (T, 3) unit normals; (0, 0, 1) where a triangle has no area."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    normal[length == 0] = 0.0, 0.0, 1.0
    return np.asarray(normal / np.where(length == 0, 1.0, length)[:, None])


def _wall_places(loose: _Loose, normal: Floats) -> NDArray[np.float32]:
    """Returns ``Skin.place`` of walls: triangles of one building and one plane are one wall."""
    place = np.zeros((len(normal), 7), dtype=np.float32)
    walls = np.flatnonzero((loose.surface == SurfaceClass.WALL) & ~loose.is_plain)
    if not len(walls):
        return place
    tangent = np.stack([-normal[walls, 1], normal[walls, 0]], axis=1)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    tangent[(tangent[:, 0] < 0) | ((tangent[:, 0] == 0) & (tangent[:, 1] < 0))] *= -1.0
    xy = loose.corners[walls, :, :2]
    along = np.einsum("tcx,tx->tc", xy, tangent)
    away = xy[:, 0, 1] * tangent[:, 0] - xy[:, 0, 0] * tangent[:, 1]
    turn = np.round(np.arctan2(tangent[:, 1], tangent[:, 0]) / 0.02).astype(np.int64)
    offset = np.round(away / 0.25).astype(np.int64)
    keys = np.stack([loose.number[walls].astype(np.int64), turn, offset], axis=1)
    _, wall = np.unique(keys, axis=0, return_inverse=True)
    wall, count = wall.reshape(-1), int(wall.max()) + 1
    # Along the wall and up.
    spans = np.stack([along, loose.corners[walls, :, 2]], axis=2)
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, wall, spans.min(axis=1))
    np.maximum.at(high, wall, spans.max(axis=1))
    (start, base), (end, top) = low.T, high.T
    place[walls, :2] = tangent
    place[walls, 2:6] = np.stack([start, end - start, base, top], axis=1)[wall]
    return place


def _add_crowns(place: NDArray[np.float32], loose: _Loose) -> None:
    """Writes ``Skin.place`` of leaves: the middle of all leaves of a tree."""
    leaves = np.flatnonzero(loose.surface == SurfaceClass.FOLIAGE)
    if not len(leaves):
        return
    _, tree = np.unique(loose.number[leaves], return_inverse=True)
    size = np.bincount(tree)
    middle = loose.corners[leaves].mean(axis=1)
    for axis in range(3):
        place[leaves, axis] = (np.bincount(tree, middle[:, axis]) / size)[tree]
    place[leaves, 6] = 1.0
