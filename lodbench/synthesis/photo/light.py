"""What decides the light of triangles where nothing else is given: palettes, grass, no shadows."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import ConfigError, nearest_names
from lodbench.geometry import Camera, Pose
from lodbench.kernels import looks
from lodbench.kernels.looks import CameraResponse, Look, SunMap, Triple
from lodbench.params import read_settings, to_params
from lodbench.rendering.raster import RasterRenderer, make_charts
from lodbench.synthesis.objects import palette

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


def draw_sun_map(raster: RasterRenderer, sun: Floats, seen: Floats, size: int) -> SunMap:
    """Returns the depth map, so many pixels wide, of the part of a scene that can be seen.

    The raster draws what casts shadows; ``sun``, (3,), leads towards the sun; ``seen``, (N, 3) local metres,
    are points that a picture shows.
    """
    rotation = _looking_along(-sun)
    middle = np.median(seen, axis=0)
    near = seen[np.linalg.norm(seen - middle, axis=1) <= REACH_M]
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
