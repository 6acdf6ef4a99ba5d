"""What surfaces are painted with: triples, noise from integer hashes, and the ground with its roads."""

from __future__ import annotations

import numpy as np

from lodbench.kernels.compiled import per_pixel
from lodbench.kernels.looks import SurfaceClass

_MASK = 0xFFFFFFFF


@per_pixel
def unit_hash(a, b, c):
    """Returns a number in [0, 1) that three integers, each within 31 bits, decide."""
    h = (a * 0x27D4EB2D + b * 0x165667B1 + c * 0x1E3779B1) & _MASK
    h ^= h >> 15
    h = (h * 0x5EBCA6B7) & _MASK
    h ^= h >> 13
    h = (h * 0x42B2AE35) & _MASK
    h ^= h >> 16
    return h * (1.0 / 4294967296.0)


@per_pixel
def value_noise(x, y, seed):
    """Returns smooth noise in [-1, 1] of a point of the plane; its grain has size 1."""
    fx, fy = np.floor(x), np.floor(y)
    i, j = np.int64(fx), np.int64(fy)
    u, v = x - fx, y - fy
    u, v = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v)
    low = unit_hash(i, j, seed) * (1.0 - u) + unit_hash(i + 1, j, seed) * u
    high = unit_hash(i, j + 1, seed) * (1.0 - u) + unit_hash(i + 1, j + 1, seed) * u
    return 2.0 * (low * (1.0 - v) + high * v) - 1.0


@per_pixel
def detail(grain_m, pixel_m):
    """Returns how much of a pattern of a grain size a pixel of a size still shows, 0 to 1.

    A pattern finer than two pixels is left out, so that it cannot alias.
    """
    return min(1.0, max(0.0, grain_m / (2.0 * pixel_m) - 0.5))


@per_pixel
def grain(x, y, size_m, pixel_m, seed):
    """Returns noise in [-1, 1] of a grain size, faded where a pixel no longer shows it."""
    shown = detail(size_m, pixel_m)
    if shown <= 0.0:
        return 0.0
    return shown * value_noise(x / size_m, y / size_m, seed)


@per_pixel
def stripe(x, low, high, width):
    """Returns how much of a pixel of a width, centred on x, lies between low and high, about."""
    wide = max(width, 1e-6)
    rising = min(1.0, max(0.0, (x - low) / wide + 0.5))
    falling = min(1.0, max(0.0, (high - x) / wide + 0.5))
    return rising * falling


@per_pixel
def mix(a, b, share):
    """Returns the colour a with a share of b."""
    keep = 1.0 - share
    return a[0] * keep + b[0] * share, a[1] * keep + b[1] * share, a[2] * keep + b[2] * share


@per_pixel
def scaled(a, factor):
    """Returns a triple times a number."""
    return a[0] * factor, a[1] * factor, a[2] * factor


@per_pixel
def plus(a, b, factor):
    """Returns the triple a and so many times b."""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


@per_pixel
def dot(a, b):
    """Returns the scalar product of two triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


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


@per_pixel
def ground_colour(kind, tint, x, y, pixel_m, look, cover):
    """Returns the linear RGB of a ground surface at a point, and the share of sky it mirrors.

    The kind is a ``SurfaceClass``, or ``LAND_COVER`` to look it up in the cover. A tint of negative red
    stands for the class's own. The point is x and y in local metres, where a pixel has a size of ``pixel_m``.
    """
    if kind > _LAST:
        return _covered_colour(x, y, pixel_m, look, cover)
    return _cover(kind, tint, x, y, pixel_m, look)


@per_pixel
def _cover(kind, tint, x, y, pixel_m, look):
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
def _plants(kind, tint, x, y, broad, fine, pixel_m, look):
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
def _covered_colour(x, y, pixel_m, look, cover):
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
def _road_place(x, y, cover):
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
