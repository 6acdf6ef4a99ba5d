"""Ground in a picture: earth, grass, fields, pavements, water, and roads with their markings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.rendering.compiled import per_pixel
from lodbench.synthesis.objects.scene_props import SurfaceClass
from lodbench.synthesis.photo.noise import detail, grain, mix, scaled, stripe, unit_hash, value_noise

# Ground whose class, cell by cell, is in a ``LandCover``.
LAND_COVER = np.uint8(255)
# Surfaces that carry their own light: those of a textured mesh.
TEXTURED = np.uint8(254)
_LAST = 200

_GROUND, _GRASS, _FIELD = int(SurfaceClass.GROUND), int(SurfaceClass.GRASS), int(SurfaceClass.FIELD)
_ROAD, _MARKING = int(SurfaceClass.ROAD), int(SurfaceClass.MARKING)
_PAVEMENT, _WATER = int(SurfaceClass.PAVEMENT), int(SurfaceClass.WATER)

_OWN = (-1.0, -1.0, -1.0)  # no tint

_FIELD_M = 90.0  # size of a farmer's field
_SLAB_M = 0.5  # paving slabs
_KERB_M = 0.2
_LINE_M = 0.14  # painted lines
_DASH_M = 6.0  # a dash and its gap


class LandCover(NamedTuple):
    """What covers the ground, on a grid."""

    # (rows, columns) uint8 ``SurfaceClass``, south to north; roads are in ``road_m2``.
    classes: NDArray[np.uint8]
    # (rows, columns) float32 square of the distance to the middle of the nearest road.
    road_m2: NDArray[np.float32]
    # (rows, columns) float32 direction of that road, counter-clockwise from east.
    road_rad: NDArray[np.float32]
    west: float  # left edge of the first column, local metres
    south: float  # lower edge of the first row
    cell_m: float  # size of a cell
    half_road_m: float  # half the width of a carriageway
    pavement_m: float  # width of the pavement beside it


_GRASSLAND = np.full((1, 1), _GRASS, dtype=np.uint8)
_FAR, _EAST = np.full((1, 1), 1e6, dtype=np.float32), np.zeros((1, 1), dtype=np.float32)
# One cell of grass, for scenes whose triangles all say what they are.
NO_LAND_COVER = LandCover(_GRASSLAND, _FAR, _EAST, 0.0, 0.0, 1.0, 3.0, 1.5)


@per_pixel
def ground_colour(kind, tint, x, y, pixel_m, look, cover):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns the linear RGB of a ground surface at a point, and the share of sky it mirrors.

    The kind is a ``SurfaceClass``, or ``LAND_COVER`` to look it up in the cover. A tint of negative red
    stands for the class's own. The point is x and y in local metres, where a pixel has a size of ``pixel_m``.
    """
    if kind > _LAST:
        return _covered_colour(x, y, pixel_m, look, cover)
    return _cover(kind, tint, x, y, pixel_m, look)


@per_pixel
def _cover(kind, tint, x, y, pixel_m, look):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    seed, texture = look.seed, look.texture
    broad = 0.6 * grain(x, y, 23.0, pixel_m, seed) + 0.4 * grain(x, y, 6.1, pixel_m, seed + 1)
    fine = 0.6 * grain(x, y, 1.1, pixel_m, seed + 2) + 0.4 * grain(x, y, 0.3, pixel_m, seed + 3)
    if kind == _WATER:
        base = tint if tint[0] >= 0.0 else (0.018, 0.045, 0.045)
        ripple = grain(x, y, 1.7, pixel_m, seed + 4) + grain(x + 0.3 * y, y, 0.5, pixel_m, seed + 5)
        return scaled(base, 1.0 + 0.2 * texture * (ripple + broad)), 0.25 + 0.06 * ripple
    if kind == _GRASS or kind == _FIELD:
        return _plants(kind, tint, x, y, broad, fine, pixel_m, look), 0.0
    if kind == _ROAD:
        grey = 0.055 + 0.09 * unit_hash(seed, 11, 5)
        base = tint if tint[0] >= 0.0 else (grey, grey, grey * 1.03)
        worn = 0.10 * fine + 0.16 * look.dirt * broad
        return scaled(base, 1.0 + texture * worn), 0.02
    if kind == _MARKING:
        base = tint if tint[0] >= 0.0 else (0.62, 0.62, 0.6)
        return scaled(base, 1.0 - 0.35 * look.dirt * (0.5 + 0.5 * fine)), 0.0
    if kind == _PAVEMENT:
        base = tint if tint[0] >= 0.0 else (0.24, 0.23, 0.215)
        joint = stripe(x / _SLAB_M % 1.0, 0.06, 0.94, 0.1) * stripe(y / _SLAB_M % 1.0, 0.06, 0.94, 0.1)
        slabs = 1.0 - 0.18 * (1.0 - joint) * detail(_SLAB_M, 2.0 * pixel_m)
        return scaled(base, slabs * (1.0 + texture * (0.06 * fine + 0.14 * look.dirt * broad))), 0.0
    base = tint if tint[0] >= 0.0 else (0.20, 0.155, 0.10)
    return scaled(base, 1.0 + texture * (0.22 * fine + 0.2 * broad)), 0.0


@per_pixel
def _plants(kind, tint, x, y, broad, fine, pixel_m, look):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns the colour of lawns and fields: green to straw, in patches; fields in rows."""
    seed, texture = look.seed, look.texture
    lush = tint if tint[0] >= 0.0 else (0.055, 0.095, 0.028)
    dry = min(1.0, max(0.0, look.dryness + 0.3 * broad))
    colour = mix(lush, (0.21, 0.175, 0.085), dry)
    if kind == _FIELD:
        bend = 25.0 * value_noise(x / 300.0, y / 300.0, seed + 6)
        i, j = np.int64(np.floor((x + bend) / _FIELD_M)), np.int64(np.floor((y - bend) / (1.6 * _FIELD_M)))
        crop, shade = unit_hash(i, j, seed + 7), unit_hash(i, j, seed + 8)
        if crop < 0.3:
            colour = mix(colour, (0.17, 0.12, 0.075), 0.85)  # ploughed
        elif crop < 0.55:
            colour = mix(colour, (0.30, 0.245, 0.11), 0.8)  # ripe
        across = x if unit_hash(i, j, seed + 9) < 0.5 else y
        row_m = 1.0 + 2.0 * shade
        rows = detail(row_m, pixel_m) * np.sin(across * (2.0 * np.pi / row_m))
        colour = scaled(colour, 0.8 + 0.4 * shade + 0.12 * texture * rows)
    return scaled(colour, 1.0 + texture * (0.28 * fine + 0.16 * broad))


@per_pixel
def _covered_colour(x, y, pixel_m, look, cover):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    rows, columns = cover.classes.shape
    # A wavering look-up hides the cells' corners.
    wave = 0.45 * cover.cell_m
    px = x + wave * value_noise(x / 1.9, y / 1.9, 71)
    py = y + wave * value_noise(x / 1.9, y / 1.9, 72)
    column = np.int64(np.floor((px - cover.west) / cover.cell_m))
    row = np.int64(np.floor((py - cover.south) / cover.cell_m))
    is_inside = column >= 0 and row >= 0 and column < columns and row < rows
    kind = np.int64(cover.classes[row, column]) if is_inside else np.int64(_FIELD)
    away, along = _road_place(x, y, cover)
    half = cover.half_road_m
    verge = half if kind == _FIELD else half + cover.pavement_m
    blur = 0.5 * pixel_m
    if kind == _WATER or away > verge + blur:
        return _cover(kind, _OWN, x, y, pixel_m, look)
    # From the middle of the road outward; two are mixed only where a pixel shows both.
    colour, mirrored = (0.0, 0.0, 0.0), 0.0
    if away < half + blur:
        colour, mirrored = _cover(np.int64(_ROAD), _OWN, x, y, pixel_m, look)
        dash = stripe(along / _DASH_M % 1.0, 0.25, 0.75, pixel_m / _DASH_M)
        line = 2.0 * stripe(away, 0.0, 0.5 * _LINE_M, pixel_m) * dash * (half > 2.4)
        edge = stripe(away, half - 0.35, half - 0.35 + _LINE_M, pixel_m) * (half > 3.2)
        worn = 1.0 - 0.5 * look.dirt * (0.5 + 0.5 * value_noise(x / 3.0, y / 3.0, look.seed + 12))
        colour = mix(colour, (0.6, 0.6, 0.58), min(1.0, line + edge) * worn)
    if away > half - blur:
        outer = kind if away > verge - blur or kind == _FIELD else np.int64(_PAVEMENT)
        beside, _ = _cover(outer, _OWN, x, y, pixel_m, look)
        if kind != _FIELD:
            beside = mix(beside, (0.34, 0.335, 0.32), 0.6 * stripe(away, half, half + _KERB_M, pixel_m))
        colour = mix(beside, colour, stripe(away, -1.0, half, pixel_m))
    return colour, mirrored


@per_pixel
def _road_place(x, y, cover):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns the distance from the middle of the nearest road and the way along it, metres."""
    rows, columns = cover.road_m2.shape
    fx = (x - cover.west) / cover.cell_m - 0.5
    fy = (y - cover.south) / cover.cell_m - 0.5
    i, j = np.int64(np.floor(fx)), np.int64(np.floor(fy))
    if i < 0 or j < 0 or i >= columns - 1 or j >= rows - 1:
        return 1e6, 0.0
    u, v = fx - i, fy - j
    low = cover.road_m2[j, i] * (1.0 - u) + cover.road_m2[j, i + 1] * u
    high = cover.road_m2[j + 1, i] * (1.0 - u) + cover.road_m2[j + 1, i + 1] * u
    square = low * (1.0 - v) + high * v
    if square > 400.0:
        return 1e6, 0.0  # on no road, however wide
    turn = cover.road_rad[j, i]
    c, s = np.cos(turn), np.sin(turn)
    # A square interpolated linearly comes out too large by just this much.
    excess = cover.cell_m * cover.cell_m * (s * s * u * (1.0 - u) + c * c * v * (1.0 - v))
    away = np.sqrt(max(0.0, square - excess))
    # Along is measured in sixteen directions: dashes do not shear where a road bends slowly.
    turn = np.round(turn * (8.0 / np.pi)) * (np.pi / 8.0)
    return away, x * np.cos(turn) + y * np.sin(turn)
