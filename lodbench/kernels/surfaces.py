"""Surfaces in a drawn photo: ground and roads, facades with windows, roofs, leaves, paint, noise."""

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
def visibility(grain_m, pixel_m):
    """Returns how much of a pattern of a grain size a pixel of a size still shows, 0 to 1.

    A pattern finer than two pixels is left out, so that it cannot alias.
    """
    return min(1.0, max(0.0, grain_m / (2.0 * pixel_m) - 0.5))


@per_pixel
def noise(x, y, size_m, pixel_m, seed):
    """Returns noise in [-1, 1] of a grain size, faded where a pixel no longer shows it."""
    shown = visibility(size_m, pixel_m)
    if shown <= 0.0:
        return 0.0
    return shown * value_noise(x / size_m, y / size_m, seed)


@per_pixel
def stripe(x, low, high, width):
    """Returns how much of a pixel of a width, centred on x, lies between low and high, about."""
    blur = max(width, 1e-6)
    rising = min(1.0, max(0.0, (x - low) / blur + 0.5))
    falling = min(1.0, max(0.0, (high - x) / blur + 0.5))
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
def add_scaled(a, b, factor):
    """Returns the triple a and so many times b."""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


@per_pixel
def dot(a, b):
    """Returns the scalar product of two triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


_LAST_CLASS = 200
_GROUND, _GRASS, _FIELD = int(SurfaceClass.GROUND), int(SurfaceClass.GRASS), int(SurfaceClass.FIELD)
_ROAD, _MARKING = int(SurfaceClass.ROAD), int(SurfaceClass.MARKING)
_PAVEMENT, _WATER = int(SurfaceClass.PAVEMENT), int(SurfaceClass.WATER)
_NO_TINT = (-1.0, -1.0, -1.0)  # no tint
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
    if kind > _LAST_CLASS:
        return _land_cover_colour(x, y, pixel_m, look, cover)
    return _class_colour(kind, tint, x, y, pixel_m, look)


@per_pixel
def _class_colour(kind, tint, x, y, pixel_m, look):
    seed, texture = look.seed, look.texture
    broad = 0.6 * noise(x, y, 23.0, pixel_m, seed) + 0.4 * noise(x, y, 6.1, pixel_m, seed + 1)
    fine = 0.6 * noise(x, y, 1.1, pixel_m, seed + 2) + 0.4 * noise(x, y, 0.3, pixel_m, seed + 3)
    if kind == _WATER:
        base = tint if tint[0] >= 0.0 else (0.018, 0.045, 0.045)
        ripple = noise(x, y, 1.7, pixel_m, seed + 4) + noise(x + 0.3 * y, y, 0.5, pixel_m, seed + 5)
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
        slabs = 1.0 - 0.18 * (1.0 - joint) * visibility(_SLAB_M, 2.0 * pixel_m)
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
        rows = visibility(row_m, pixel_m) * np.sin(across * (2.0 * np.pi / row_m))
        colour = scaled(colour, 0.8 + 0.4 * shade + 0.12 * texture * rows)
    return scaled(colour, 1.0 + texture * (0.28 * fine + 0.16 * broad))


@per_pixel
def _land_cover_colour(x, y, pixel_m, look, cover):
    rows, columns = cover.classes.shape
    # A wavering look-up hides the cells' corners.
    wave = 0.45 * cover.cell_m
    px = x + wave * value_noise(x / 1.9, y / 1.9, 71)
    py = y + wave * value_noise(x / 1.9, y / 1.9, 72)
    column = np.int64(np.floor((px - cover.west) / cover.cell_m))
    row = np.int64(np.floor((py - cover.south) / cover.cell_m))
    is_inside = column >= 0 and row >= 0 and column < columns and row < rows
    kind = np.int64(cover.classes[row, column]) if is_inside else np.int64(_FIELD)
    from_centre, along = _road_coordinates(x, y, cover)
    half = cover.half_road_m
    verge = half if kind == _FIELD else half + cover.pavement_m
    blur = 0.5 * pixel_m
    if kind == _WATER or from_centre > verge + blur:
        return _class_colour(kind, _NO_TINT, x, y, pixel_m, look)
    # From the middle of the road outward; two are mixed only where a pixel shows both.
    colour, reflectance = (0.0, 0.0, 0.0), 0.0
    if from_centre < half + blur:
        colour, reflectance = _class_colour(np.int64(_ROAD), _NO_TINT, x, y, pixel_m, look)
        dash = stripe(along / _DASH_M % 1.0, 0.25, 0.75, pixel_m / _DASH_M)
        line = 2.0 * stripe(from_centre, 0.0, 0.5 * _LINE_M, pixel_m) * dash * (half > 2.4)
        edge = stripe(from_centre, half - 0.35, half - 0.35 + _LINE_M, pixel_m) * (half > 3.2)
        worn = 1.0 - 0.5 * look.dirt * (0.5 + 0.5 * value_noise(x / 3.0, y / 3.0, look.seed + 12))
        colour = mix(colour, (0.6, 0.6, 0.58), min(1.0, line + edge) * worn)
    if from_centre > half - blur:
        outer = kind if from_centre > verge - blur or kind == _FIELD else np.int64(_PAVEMENT)
        beside, _ = _class_colour(outer, _NO_TINT, x, y, pixel_m, look)
        if kind != _FIELD:
            beside = mix(
                beside, (0.34, 0.335, 0.32), 0.6 * stripe(from_centre, half, half + _KERB_M, pixel_m)
            )
        colour = mix(beside, colour, stripe(from_centre, -1.0, half, pixel_m))
    return colour, reflectance


@per_pixel
def _road_coordinates(x, y, cover):
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
    direction = cover.road_rad[j, i]
    c, s = np.cos(direction), np.sin(direction)
    # A square interpolated linearly comes out too large by just this much.
    excess = cover.cell_m * cover.cell_m * (s * s * u * (1.0 - u) + c * c * v * (1.0 - v))
    from_centre = np.sqrt(max(0.0, square - excess))
    # Along is measured in sixteen directions: dashes do not shear where a road bends slowly.
    direction = np.round(direction * (8.0 / np.pi)) * (np.pi / 8.0)
    return from_centre, x * np.cos(direction) + y * np.sin(direction)


_WALL, _WINDOW, _GLASS = int(SurfaceClass.WALL), int(SurfaceClass.WINDOW), int(SurfaceClass.CAR_GLASS)
_TILE, _FLAT, _BODY = int(SurfaceClass.ROOF_TILE), int(SurfaceClass.ROOF_FLAT), int(SurfaceClass.CAR_BODY)
_FOLIAGE, _FENCE, _CHIMNEY = int(SurfaceClass.FOLIAGE), int(SurfaceClass.FENCE), int(SurfaceClass.CHIMNEY)
_COURSE_M = 0.34  # a row of roof tiles
_BRICK_M = 0.25
_UNIT_M = 6.5  # grid of machines on flat roofs
_SKYLIGHT_M = 2.6  # grid of skylights and panels on pitched roofs


@per_pixel
def _base_colour(table, tint, number, look):
    """Returns an object's colour: its own or one of a table's, a little off."""
    red, green, blue = tint
    if red < 0.0 or unit_hash(number, look.seed, 2) < look.repaint:
        pick = np.int64(unit_hash(number, look.seed, 3) * table.shape[0])
        red, green, blue = table[pick, 0], table[pick, 1], table[pick, 2]
    spread = 2.0 * look.tint_jitter
    bright = 1.0 + 1.6 * spread * (unit_hash(number, look.seed, 4) - 0.5)
    warm = 0.5 * spread * (unit_hash(number, look.seed, 5) - 0.5)
    return red * (bright + warm), green * bright, blue * (bright - warm)


@per_pixel
def _glass(number, i, j, look):
    """Returns the colour of a pane: dark, or lighter where a blind is down."""
    dark = 0.012 + 0.03 * look.window_light
    blind = unit_hash(i * 31 + number, j, look.seed + 21)
    if blind < 0.18 + 0.3 * look.window_light:
        light = 0.12 + 0.5 * unit_hash(i, j + number, look.seed + 22)
        return light, light * 0.97, light * 0.9
    return dark, dark * 1.15, dark * 1.3


@per_pixel
def _facade(colour, skin, triangle, number, point, pixel_m, look):
    """Returns the colour of a wall with windows at a point, and the share of sky it mirrors.

    The point is (3,) local metres, ``number`` is the building's, ``pixel_m`` the size of a pixel there.
    """
    place, (x, y, z) = skin.place, point
    along = x * place[triangle, 0] + y * place[triangle, 1] - place[triangle, 2]
    width, up = np.float64(place[triangle, 3]), z - place[triangle, 4]
    rise = np.float64(place[triangle, 5] - place[triangle, 4])
    stain = look.dirt * (
        0.10 * noise(along, z, 3.7, pixel_m, number) + 0.06 * noise(along, 0.2 * z, 0.8, pixel_m, number)
    )
    colour = scaled(colour, 1.0 + look.texture * stain - 0.1 * look.dirt * max(0.0, 1.0 - up / 2.0))
    has_windows = unit_hash(number, look.seed, 6) < look.windows
    if not has_windows or rise < 2.4 or width < 1.6:
        return colour, 0.0
    # Storeys and axes fit the wall, so that no window is cut by a corner or by the eaves.
    storey = rise / max(1.0, np.round(rise / (look.storey_m * (0.9 + 0.2 * unit_hash(number, 7, 7)))))
    axis = width / max(
        1.0, np.round(width / (look.window_spacing_m * (0.75 + 0.6 * unit_hash(number, 8, 8))))
    )
    u, v = along / axis, up / storey
    i, j = np.int64(np.floor(u)), np.int64(np.floor(v))
    share = 0.3 + 0.3 * unit_hash(number, look.seed, 9)
    # Some buildings have bands of glass.
    if unit_hash(number, look.seed, 10) < 0.15:
        share = 0.92
    low, high = 0.5 - 0.5 * share, 0.5 + 0.5 * share
    sill, head = 0.30, 0.80
    if j == 0 and unit_hash(number, look.seed, 13) < 0.3:
        low, high, sill, head = 0.08, 0.92, 0.08, 0.82  # shop windows
    blur_u, blur_v = 1.4 * pixel_m / axis, 1.4 * pixel_m / storey
    rim_u, rim_v = 0.09 / axis, 0.09 / storey
    frame = stripe(u - i, low - rim_u, high + rim_u, blur_u) * stripe(
        v - j, sill - rim_v, head + rim_v, blur_v
    )
    pane = stripe(u - i, low, high, blur_u) * stripe(v - j, sill, head, blur_v)
    if unit_hash(i * 7 + number, j, look.seed + 14) < 0.06:
        return colour, 0.0  # walled up, or none
    light = 0.55 if unit_hash(number, look.seed, 15) < 0.6 else 0.08
    colour = mix(colour, (light, light, light), 0.7 * (frame - pane))
    return mix(colour, _glass(number, i, j, look), pane), 0.22 * pane


@per_pixel
def _pitched(colour, number, point, normal, pixel_m, look):
    """Returns the colour of a tiled roof: rows of tiles, stains, moss, skylights."""
    x, y, z = point
    flat = np.sqrt(normal[0] * normal[0] + normal[1] * normal[1])
    # A pitched roof drawn as a box has its rows along the grid.
    across, down = x, y
    if flat >= 0.02:
        across, down = (x * normal[1] - y * normal[0]) / flat, z / flat
    row, column = down / _COURSE_M, across / _BRICK_M
    edge = 1.0 - stripe(row % 1.0, 0.0, 0.78, 0.15)
    tile = 0.16 * visibility(_COURSE_M, pixel_m) * (edge - 0.3)
    single = unit_hash(np.int64(np.floor(row)), np.int64(np.floor(column)), number) - 0.5
    mottled = 0.30 * visibility(_BRICK_M, pixel_m) * single
    stain = look.dirt * (
        0.22 * noise(across, down, 2.9, pixel_m, number)
        + 0.16 * noise(across * 2.0, 0.3 * down, 1.1, pixel_m, number + 1)
    )
    colour = scaled(colour, 1.0 + look.texture * (mottled - tile + stain))
    i, j = np.int64(np.floor(across / _SKYLIGHT_M)), np.int64(np.floor(down / _SKYLIGHT_M))
    if flat > 0.02 and unit_hash(i + 977 * number, j, look.seed + 31) < look.skylights:
        u, v = across / _SKYLIGHT_M - i, down / _SKYLIGHT_M - j
        size = 0.2 if unit_hash(number, look.seed, 32) < 0.6 else 0.46
        blur = pixel_m / _SKYLIGHT_M
        pane = stripe(u, 0.5 - size, 0.5 + size, blur) * stripe(v, 0.5 - size, 0.5 + size, blur)
        return mix(colour, (0.015, 0.02, 0.035), pane), 0.2 * pane
    return colour, 0.0


@per_pixel
def _flat_roof(colour, number, x, y, pixel_m, look):
    """Returns the colour of a flat roof: gravel or sheets, puddle stains, machines and hatches."""
    turn = np.pi * unit_hash(number, 41, 41)
    u, v = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
    sheet = visibility(1.0, 2.0 * pixel_m) * (1.0 - stripe(u % 1.0, 0.04, 0.96, 0.06))
    stain = look.dirt * (
        0.2 * noise(u, v, 7.3, pixel_m, number) + 0.14 * noise(u, v, 2.1, pixel_m, number + 1)
    )
    fine = 0.12 * noise(u, v, 0.35, pixel_m, number + 2)
    colour = scaled(colour, 1.0 + look.texture * (stain + fine) - 0.15 * sheet)
    i, j = np.int64(np.floor(u / _UNIT_M)), np.int64(np.floor(v / _UNIT_M))
    if unit_hash(i + 613 * number, j, look.seed + 42) < look.roof_units:
        size_u = 0.07 + 0.16 * unit_hash(i, j, number + 43)
        size_v = 0.07 + 0.12 * unit_hash(i, j, number + 44)
        p, q = u / _UNIT_M - i - 0.5, v / _UNIT_M - j - 0.5
        blur = pixel_m / _UNIT_M
        shadow = stripe(p, -size_u - 0.08, size_u, blur) * stripe(q, -size_v - 0.08, size_v, blur)
        box = stripe(p, -size_u, size_u, blur) * stripe(q, -size_v, size_v, blur)
        light = 0.18 + 0.5 * unit_hash(i, j, number + 45)
        colour = mix(scaled(colour, 1.0 - 0.55 * (shadow - shadow * box)), (light, light, light), box)
    return colour, 0.0


@per_pixel
def _leaves(tint, number, point, pixel_m, look):
    """Returns the colour of leaves, dark in the gaps between them."""
    x, y, z = point
    green = tint if tint[0] >= 0.0 else (0.035, 0.062, 0.018)
    hue = unit_hash(number, look.seed, 51)
    colour = mix(green, (0.13, 0.105, 0.03), 0.5 * look.dryness * hue)
    colour = scaled(colour, 0.7 + 0.6 * unit_hash(number, look.seed, 52))
    clump = noise(x + 0.7 * z, y - 0.7 * z, 1.1, pixel_m, number)
    leaf = noise(x - 0.6 * z, y + 0.6 * z, 0.4, pixel_m, number + 1)
    return scaled(colour, max(0.15, 1.0 + look.texture * (0.45 * clump + 0.4 * leaf)))


@per_pixel
def surface_colour(triangle, point, normal, pixel_m, shading):
    """Returns the linear RGB of a triangle at a point, (3,) local metres, and the share of sky it mirrors.

    The normal is unit, ``pixel_m`` the size of a pixel there.
    """
    skin, look, palettes, (x, y, z) = shading.skin, shading.look, shading.palettes, point
    kind, number = np.int64(skin.surface[triangle]), np.int64(skin.number[triangle])
    red, green, blue = skin.tint[triangle, 0], skin.tint[triangle, 1], skin.tint[triangle, 2]
    tint = (np.float64(red), np.float64(green), np.float64(blue))
    if kind < _WALL or kind > 200:
        return ground_colour(kind, tint, x, y, pixel_m, look, shading.cover)
    if kind == _WALL:
        colour = _base_colour(palettes.walls, tint, number, look)
        return _facade(colour, skin, triangle, number, point, pixel_m, look)
    if kind == _TILE:
        colour = _base_colour(palettes.tiles, tint, number, look)
        return _pitched(colour, number, point, normal, pixel_m, look)
    if kind == _FLAT:
        return _flat_roof(_base_colour(palettes.flats, tint, number, look), number, x, y, pixel_m, look)
    if kind == _FOLIAGE or kind == _FENCE:
        return _leaves(tint, number, point, pixel_m, look), 0.0
    if kind == _WINDOW or kind == _GLASS:
        i, j = np.int64(np.floor(0.7 * (x + y))), np.int64(np.floor(z / 1.5))
        return _glass(number, i, j, look), 0.3
    if kind == _BODY:
        return _base_colour(palettes.paints, tint, number, look), 0.12
    colour = _base_colour(palettes.walls, tint, number, look)
    return scaled(colour, 1.0 + 0.1 * look.texture * value_noise(2.0 * (x + y), 2.0 * z, number)), 0.0
