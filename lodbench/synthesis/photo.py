"""Photos of cities, made on the CPU: procedural surfaces, sun and shadow, sky, haze, a camera's faults.

Looks and light first: palettes, ranges, the sun's shadow map. Then the renderer: a z-buffer, shaded pixel by
pixel, through a camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from functools import cache
from importlib.resources import files
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.citymodel.textured_map import TexturedMesh
from lodbench.errors import ConfigError, nearest_names
from lodbench.geometry import Camera, Pose
from lodbench.kernels import expose, looks, resolve_photo
from lodbench.kernels.arguments import MAX_LIGHT, TONE_STEPS, Band, Buffer
from lodbench.kernels.looks import CameraResponse, Look, Skin, SunMap, SurfaceClass, Triple
from lodbench.params import read_settings, to_params
from lodbench.photos.pictures import encoded
from lodbench.rendering.raster import RasterRenderer, grouped_scene, make_charts, triangle_groups
from lodbench.synthesis.objects import SceneProps, palette

_GRASSLAND = np.full((1, 1), int(looks.SurfaceClass.GRASS), dtype=np.uint8)
_FAR, _EAST = np.full((1, 1), 1e6, dtype=np.float32), np.zeros((1, 1), dtype=np.float32)
# One cell of grass, for scenes whose triangles all say what they are.
NO_LAND_COVER = looks.LandCover(_GRASSLAND, _FAR, _EAST, 0.0, 0.0, 1.0, 3.0, 1.5)


def linear(colours: object) -> NDArray[np.float64]:
    """Returns linear RGB, 0 to 1, of 8-bit colours: a square, which the camera response undoes."""
    return (np.asarray(colours, dtype=np.float64) / 255.0) ** 2


_WALLS = "e1dacb d0ceca e4cdac bca48e eeebe4 a66e58 d6be96 b4b2ac 965c4a cad6d6 787674 e8d6be"
_TILES = "9e543e 8a4e40 b06a4c 685c56 545254 784034 92705c 464242 be7c5c 6e7074 603c32 807a70"
_TILES += " 9ea09e 48505c 46608c 587062 d6d6d2"  # fibre cement, slate, painted sheets
_FLATS = "969490 6e6e70 bcbab4 847c70 d6d4d0 5c5c5c 7a826c a8a094 8e969c 524e4a"
_FLATS += " 607446 b6ae9e 2c364e 688096 e4e4e2"  # planted, gravel, solar panels, sheet metal: as over halls
_PAINTS = "e6e6e6 1e2024 787a7e aaacb0 8c181a 22366e 3c3e42 cdc8be 18422c d6d6d2"
PALETTES = looks.Palettes(*(linear(palette(codes)) for codes in (_WALLS, _TILES, _FLATS, _PAINTS)))


def plain_shading(skin: looks.Skin, look: Look) -> looks.Shading:
    """Returns the shading of triangles that all say what they are: no land cover, no textures; no shadows."""
    return looks.Shading(skin, look, NO_LAND_COVER, NO_SUN_MAP, PALETTES, make_charts(None))


Range = tuple[float, float]


def _drawn(low: float, high: float, within: Range = (0.0, 1.5)) -> Any:
    """Returns a field: a range, and the bounds of any other; without them shares, and a little more."""
    return field(default=(low, high), metadata={"within": within})


@dataclass(frozen=True, slots=True)
class LookRanges:
    """From what the look of a picture is drawn: each value uniform between two bounds, ends included.

    ``conf/training/varied.yaml`` says what each is.

    Raises:
        ConfigError: A range is not ascending, or out of bounds.
    """

    sun_elevation_deg: tuple[float, float] = _drawn(20.0, 68.0, (5.0, 90.0))
    sun_azimuth_deg: tuple[float, float] = _drawn(-180.0, 180.0, (-360.0, 360.0))
    sun_share: tuple[float, float] = _drawn(0.25, 0.85)
    sun_warmth: tuple[float, float] = _drawn(-0.1, 0.5, (-1.0, 1.0))
    haze_range_m: tuple[float, float] = _drawn(1200.0, 9000.0, (200.0, 1e6))
    sky_white: tuple[float, float] = _drawn(0.1, 0.9)
    dryness: tuple[float, float] = _drawn(0.0, 0.8)
    texture: tuple[float, float] = _drawn(0.6, 1.3)
    tint_jitter: tuple[float, float] = _drawn(0.02, 0.14)
    dirt: tuple[float, float] = _drawn(0.1, 0.9)
    windows: tuple[float, float] = _drawn(0.7, 1.0)
    window_light: tuple[float, float] = _drawn(0.0, 0.5)
    storey_m: tuple[float, float] = _drawn(2.7, 3.6, (2.0, 6.0))
    window_spacing_m: tuple[float, float] = _drawn(2.0, 3.8, (1.2, 10.0))
    skylights: tuple[float, float] = _drawn(0.0, 0.14)
    roof_units: tuple[float, float] = _drawn(0.0, 0.3)
    exposure: tuple[float, float] = _drawn(0.75, 1.3, (0.2, 4.0))
    contrast: tuple[float, float] = _drawn(0.9, 1.25, (0.3, 3.0))
    saturation: tuple[float, float] = _drawn(0.6, 1.2, (0.0, 3.0))
    white_balance: tuple[float, float] = _drawn(-0.08, 0.08, (-0.5, 0.5))
    vignette: tuple[float, float] = _drawn(0.0, 0.25)
    blur_px: tuple[float, float] = _drawn(0.0, 0.9, (0.0, 10.0))
    noise: tuple[float, float] = _drawn(0.002, 0.025, (0.0, 0.2))
    jpeg_quality: tuple[float, float] = _drawn(78.0, 97.0, (5.0, 100.0))
    repaint: tuple[float, float] = _drawn(0.0, 0.0)

    def __post_init__(self) -> None:
        for each in fields(self):
            (low, high), (least, most) = getattr(self, each.name), each.metadata["within"]
            if not least <= low <= high <= most:
                raise ConfigError(
                    f"look.{each.name} is [{low:g}, {high:g}], not an ascending range within "
                    f"{least:g} to {most:g}."
                )


@cache
def look_ranges(name: str) -> LookRanges:
    """Returns the ranges of a look that ``conf/training`` names: ``plain``, ``varied``, ``hard``.

    Raises:
        ConfigError: There is no such look.
    """
    known = {
        entry.name.removesuffix(".yaml"): entry for entry in (files("lodbench.conf") / "training").iterdir()
    }
    if name not in known:
        raise ConfigError(f"There is no look {name}.", nearest_names(name, sorted(known)))
    return to_params(read_settings(known[name].read_text(encoding="utf-8")), LookRanges, "look")


def draw_look(ranges: LookRanges, generator: np.random.Generator) -> tuple[Look, CameraResponse]:
    """Returns a look drawn from ranges; always as many draws, so that one range changes nothing else."""
    names = [each.name for each in fields(ranges) if each.name != "repaint"]
    drawn = {name: float(generator.uniform(*getattr(ranges, name))) for name in names}
    seeds = generator.integers(1 << 30, size=2)
    # Drawn last, as it came last: looks without it stay what they were.
    drawn["repaint"] = float(generator.uniform(*ranges.repaint))
    elevation, azimuth = math.radians(drawn["sun_elevation_deg"]), math.radians(drawn["sun_azimuth_deg"])
    level = math.cos(elevation)
    sun = np.array([level * math.sin(azimuth), level * math.cos(azimuth), math.sin(elevation)])
    # A low sun is weaker and redder; together with the sky it lights level ground about alike.
    warmth = drawn["sun_warmth"] + 0.5 * max(0.0, 0.45 - math.sin(elevation))
    sun_colour = np.array([1.0 + 0.22 * warmth, 1.0, 1.0 - 0.38 * warmth])
    share, white = drawn["sun_share"], drawn["sky_white"]
    sun_rgb = sun_colour * share * 1.15 / max(0.45, math.sin(elevation))
    brightness = 0.55 + 0.35 * share
    light = Look(
        sun=_triple(sun),
        sun_rgb=_triple(sun_rgb),
        sky_rgb=_sky((1.0, 1.0, 1.0), (0.75, 0.95, 1.3), white, 1.05 - share),
        haze_rgb=_sky((0.92, 0.94, 0.96), (0.66, 0.78, 0.94), white, brightness),
        zenith_rgb=_sky((0.8, 0.84, 0.9), (0.16, 0.33, 0.72), white, brightness),
        haze_per_m=1.0 / drawn["haze_range_m"],
        seed=int(seeds[0]),
        **{name: drawn[name] for name in Look._fields[6:-1]},
    )
    camera = {name: drawn[name] for name in CameraResponse._fields[:-2]}
    quality = round(drawn["jpeg_quality"])
    return light, CameraResponse(**camera, jpeg_quality=quality, seed=int(seeds[1]))


def _sky(overcast: Triple, clear: Triple, white: float, brightness: float) -> Triple:
    """Returns a colour between that of an overcast and of a clear sky."""
    return _triple(brightness * (white * np.array(overcast) + (1.0 - white) * np.array(clear)))


def _triple(values: NDArray[np.float64]) -> Triple:
    # Not an array: the kernel would count references to it at every pixel.
    red, green, blue = values.tolist()
    return red, green, blue


Floats = NDArray[np.float64]

# The sun as a camera this far away: its rays are parallel to within a hundredth of a degree per metre.
_DISTANCE_M = 60_000.0
# Beyond this distance from the middle of what is seen, nothing casts a shadow.
REACH_M = 450.0


_LEVEL = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
# Nothing casts a shadow.
NO_SUN_MAP = SunMap(np.zeros((1, 1), dtype=np.float32), _LEVEL, (0.0, 0.0, 0.0), 1.0, 0.0)


def ground_in_view(camera: Camera, pose: Pose, low_m: float, high_m: float) -> Floats:
    """Returns places, (N, 3), where a view meets the lowest and the highest level of a scene.

    Nothing further than ``2 * REACH_M`` is among them: its shadows are too small to be seen.
    """
    share = np.linspace(0.0, 1.0, 9)
    u, v = (axis.ravel() for axis in np.meshgrid(share * camera.width, share * camera.height))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))], axis=1)
    rays = rays @ pose.rotation
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    drop = np.where(np.abs(rays[:, 2]) > 1e-6, rays[:, 2], 1e-6)
    distance = (np.array([[low_m], [high_m]]) - pose.center[2]) / drop
    distance = np.where(distance > 0, np.minimum(distance, 2.0 * REACH_M), 2.0 * REACH_M)
    points = (pose.center + rays * distance[..., None]).reshape(-1, 3)
    points[:, 2] = np.clip(points[:, 2], low_m, high_m)
    return np.asarray(points)


def draw_sun_map(raster: RasterRenderer, sun: Floats, visible: Floats, size: int) -> SunMap:
    """Returns the depth map, so many pixels wide, of the part of a scene that can be seen.

    The raster draws what casts shadows; ``sun``, (3,), leads towards the sun; ``visible``, (N, 3) local
    metres, are points that a picture shows.
    """
    rotation = _looking_along(-sun)
    middle = np.median(visible, axis=0)
    near = visible[np.linalg.norm(visible - middle, axis=1) <= REACH_M]
    plan = (near - middle) @ rotation.T
    radius = float(np.abs(plan[:, :2]).max()) + 2.0 if len(near) else 10.0
    center = middle + sun * _DISTANCE_M
    focal = 0.5 * size * _DISTANCE_M / radius
    camera = Camera(size, size, focal, focal, 0.5 * size, 0.5 * size)
    depth = raster.depth(camera, Pose.from_center(rotation, center))
    # Tuples, not arrays: the kernel would count references to arrays at every pixel.
    rows = tuple((float(x), float(y), float(z)) for x, y, z in rotation)
    x, y, z = (float(value) for value in center)
    return SunMap(depth, rows, (x, y, z), focal, 2.0 * radius / size)


def _looking_along(axis: Floats) -> Floats:
    """Returns the (3, 3) rotation of a camera that looks along a unit vector."""
    aside = np.array([0.0, 1.0, 0.0]) if abs(axis[2]) > 0.9 else np.array([0.0, 0.0, 1.0])
    right = np.cross(axis, aside)
    right /= np.linalg.norm(right)
    return np.ascontiguousarray(np.stack([right, np.cross(axis, right), axis]))


# Side of the shadow map, pixels: of the largest one each is half a metre where 450 m are in view.
_LEAST_SUN_MAP, _MOST_SUN_MAP = 512, 1536
# The scenes are of many small triangles.
_BAND = 256


class PhotoRenderer:
    """Renders photos: procedural surfaces, sun with cast shadows, sky, haze, and a camera's faults.

    Deferred: the z-buffer keeps the nearest triangle of two by two samples per pixel, and each triangle in a
    pixel is shaded once. A photo depends on its arguments only, whatever the threads.

    Args:
        scene: The city as the picture shows it, local metric frame.
        props: What stands around it; see ``lodbench.synthesis.objects``.
        cover: What covers ground of class ``LAND_COVER``.
        threads: Worker threads; None for one per core.
        textured: A textured mesh of the place to picture instead of the city, in the scene's frame.
            Its textures hold the light of the day they were taken: the sun casts nothing on them.
    """

    def __init__(
        self,
        scene: Scene,
        props: SceneProps | None = None,
        cover: looks.LandCover | None = None,
        threads: int | None = None,
        textured: TexturedMesh | None = None,
    ) -> None:
        self._render_scene = make_render_scene(scene, props, textured)
        self._cover = cover or NO_LAND_COVER
        self._raster = RasterRenderer(self._render_scene.mesh, threads, band=_BAND)
        casters = self._render_scene.casters
        self._casters = None if casters is None else RasterRenderer(casters, threads, band=_BAND)
        low, high = np.percentile(self._render_scene.mesh.vertices[:, 2], [0.5, 99.5])
        self._levels_m = float(low), float(high)

    def photo(self, camera: Camera, pose: Pose, look: Look, response: CameraResponse) -> NDArray[np.uint8]:
        """Returns the (H, W, 3) RGB photo from a pose in the scene's frame.

        Raises:
            RenderingError: The camera has lens distortion or is wider or higher than 4096 pixels.
        """
        return apply_camera_response(self.light(camera, pose, look), response)

    def jpeg(self, camera: Camera, pose: Pose, look: Look, response: CameraResponse) -> bytes:
        """Returns the photo as a JPEG file, of the response's quality."""
        return photo_file(self.photo(camera, pose, look, response), ".jpg", response)

    def light(self, camera: Camera, pose: Pose, look: Look) -> NDArray[np.float32]:
        """Returns (H, W, 3) linear RGB, before the camera."""
        out = np.empty((camera.height, camera.width, 3), dtype=np.float32)
        rotation, center = np.ascontiguousarray(pose.rotation), np.ascontiguousarray(pose.center)
        sun_map = self._sun_map(camera, pose, look)
        made = self._render_scene
        shading = looks.Shading(made.skin, look, self._cover, sun_map, PALETTES, made.charts)

        def resolve(band: Band, buffer: Buffer) -> None:
            resolve_photo(band, buffer, rotation, center, shading, out)

        self._raster.draw_bands(camera.scaled(2 * camera.width, 2 * camera.height), pose, resolve)
        return out

    def depth(self, camera: Camera, pose: Pose) -> NDArray[np.float32]:
        """Returns (H, W) float32 depth of all that is pictured, metres; 0 for the sky."""
        return self._raster.depth(camera, pose)

    def occluders(self, camera: Camera, pose: Pose) -> NDArray[np.bool_]:
        """Returns the (H, W) mask of trees, cars and fences that nothing hides."""
        triangle = self._raster.draw(camera, pose).triangle
        return np.asarray((triangle >= 0) & self._render_scene.is_occluder[triangle])

    def _sun_map(self, camera: Camera, pose: Pose, look: Look) -> looks.SunMap:
        if self._casters is None:
            return NO_SUN_MAP
        visible = ground_in_view(camera, pose, *self._levels_m)
        # As fine as the picture, about: in steps, so that its memory is used again.
        size = min(_MOST_SUN_MAP, max(_LEAST_SUN_MAP, (3 * max(camera.width, camera.height) // 2) // 64 * 64))
        return draw_sun_map(self._casters, np.array(look.sun), visible, size)


def photo_file(photo: NDArray[np.uint8], suffix: str, response: CameraResponse) -> bytes:
    """Returns a (H, W, 3) RGB photo as a file: ``.jpg`` of the response's quality, or ``.png``."""
    options = [cv2.IMWRITE_JPEG_QUALITY, response.jpeg_quality] if suffix == ".jpg" else []
    return encoded(np.ascontiguousarray(photo[..., ::-1]), suffix, options)


_MIDDLE = 0.45  # the grey that contrast leaves as it is


def apply_camera_response(light: NDArray[np.float32], how: CameraResponse) -> NDArray[np.uint8]:
    """Returns the (H, W, 3) 8-bit RGB picture of (H, W, 3) linear RGB light, which may be overwritten.

    A light of 1 is white paper in full light.
    """
    import cv2

    if how.blur_px > 0.15:
        blurred = cv2.GaussianBlur(light, (0, 0), how.blur_px, borderType=cv2.BORDER_REPLICATE)
        light = np.asarray(blurred, dtype=np.float32)
    picture = np.empty(light.shape, dtype=np.uint8)
    expose(light, how, _tone_curve(how), picture)
    return picture


def _tone_curve(how: CameraResponse) -> NDArray[np.float32]:
    """Returns the brightness, 0 to 1, of linear light 0, 1 / TONE_STEPS, 2 / TONE_STEPS, ...

    It is the inverse of ``linear``, with a shoulder instead of a hard cut at white, and contrast.
    """
    light = np.arange(TONE_STEPS * MAX_LIGHT + 2) / TONE_STEPS
    value = np.sqrt(1.0 - np.exp(-1.55 * light))
    dark = _MIDDLE * (np.minimum(value, _MIDDLE) / _MIDDLE) ** how.contrast
    bright = 1.0 - (1.0 - _MIDDLE) * ((1.0 - np.maximum(value, _MIDDLE)) / (1.0 - _MIDDLE)) ** how.contrast
    return np.where(value < _MIDDLE, dark, bright).astype(np.float32)


# A surface this steep is a wall; one flatter than the other is a flat roof.
_WALL_UP, _FLAT_UP = 0.3, 0.985
# Share of level tops, as level of detail 1 has, that are painted as tiled roofs.
_TILED_TOPS = 0.5
# Level faces of a building, floors included, that are larger than this are no tiled roof.
_MOST_TILED_M2 = 1600.0
ON_GROUND = [kind for kind in SurfaceClass if kind.is_ground]
_ON_WALLS = [SurfaceClass.WINDOW, SurfaceClass.DOOR, SurfaceClass.FRAME]
_NO_CASTERS = np.array([*ON_GROUND, *_ON_WALLS, looks.LAND_COVER, looks.TEXTURED], dtype=np.uint8)


class RenderScene(NamedTuple):
    """A city with its surroundings, ready to be pictured."""

    mesh: Scene  # its triangles as a ``Scene`` whose "buildings" are groups of neighbours
    skin: Skin  # what they look like
    is_occluder: NDArray[np.bool_]  # (T,) whether a triangle stands before buildings without being one
    casters: Scene | None  # those triangles that cast shadows worth drawing, or None if none do
    charts: looks.Charts  # where on its texture each textured triangle is; its ``Skin.number`` is the row


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
    """Returns a city's triangles: walls, pitched and flat roofs distinguished by their slope."""
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
    kinds, numbers = np.full(count, looks.TEXTURED, np.uint8), np.arange(count, dtype=np.int32)
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
