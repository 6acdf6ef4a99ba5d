"""Surfaces of buildings, trees and cars in a picture: facades with windows, roofs, leaves, paint."""

from __future__ import annotations

import numpy as np

from lodbench.kernels.compiled import per_pixel
from lodbench.kernels.looks import SurfaceClass
from lodbench.kernels.patterns import (
    detail,
    grain,
    ground_colour,
    mix,
    scaled,
    stripe,
    unit_hash,
    value_noise,
)

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
        0.10 * grain(along, z, 3.7, pixel_m, number) + 0.06 * grain(along, 0.2 * z, 0.8, pixel_m, number)
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
    wide, tall = 1.4 * pixel_m / axis, 1.4 * pixel_m / storey
    rim_u, rim_v = 0.09 / axis, 0.09 / storey
    frame = stripe(u - i, low - rim_u, high + rim_u, wide) * stripe(v - j, sill - rim_v, head + rim_v, tall)
    pane = stripe(u - i, low, high, wide) * stripe(v - j, sill, head, tall)
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
    tile = 0.16 * detail(_COURSE_M, pixel_m) * (edge - 0.3)
    single = unit_hash(np.int64(np.floor(row)), np.int64(np.floor(column)), number) - 0.5
    mottled = 0.30 * detail(_BRICK_M, pixel_m) * single
    stain = look.dirt * (
        0.22 * grain(across, down, 2.9, pixel_m, number)
        + 0.16 * grain(across * 2.0, 0.3 * down, 1.1, pixel_m, number + 1)
    )
    colour = scaled(colour, 1.0 + look.texture * (mottled - tile + stain))
    i, j = np.int64(np.floor(across / _SKYLIGHT_M)), np.int64(np.floor(down / _SKYLIGHT_M))
    if flat > 0.02 and unit_hash(i + 977 * number, j, look.seed + 31) < look.skylights:
        u, v = across / _SKYLIGHT_M - i, down / _SKYLIGHT_M - j
        size = 0.2 if unit_hash(number, look.seed, 32) < 0.6 else 0.46
        wide = pixel_m / _SKYLIGHT_M
        pane = stripe(u, 0.5 - size, 0.5 + size, wide) * stripe(v, 0.5 - size, 0.5 + size, wide)
        return mix(colour, (0.015, 0.02, 0.035), pane), 0.2 * pane
    return colour, 0.0


@per_pixel
def _flat_roof(colour, number, x, y, pixel_m, look):
    """Returns the colour of a flat roof: gravel or sheets, puddle stains, machines and hatches."""
    turn = np.pi * unit_hash(number, 41, 41)
    u, v = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
    sheet = detail(1.0, 2.0 * pixel_m) * (1.0 - stripe(u % 1.0, 0.04, 0.96, 0.06))
    stain = look.dirt * (
        0.2 * grain(u, v, 7.3, pixel_m, number) + 0.14 * grain(u, v, 2.1, pixel_m, number + 1)
    )
    fine = 0.12 * grain(u, v, 0.35, pixel_m, number + 2)
    colour = scaled(colour, 1.0 + look.texture * (stain + fine) - 0.15 * sheet)
    i, j = np.int64(np.floor(u / _UNIT_M)), np.int64(np.floor(v / _UNIT_M))
    if unit_hash(i + 613 * number, j, look.seed + 42) < look.roof_units:
        size_u = 0.07 + 0.16 * unit_hash(i, j, number + 43)
        size_v = 0.07 + 0.12 * unit_hash(i, j, number + 44)
        p, q = u / _UNIT_M - i - 0.5, v / _UNIT_M - j - 0.5
        wide = pixel_m / _UNIT_M
        shadow = stripe(p, -size_u - 0.08, size_u, wide) * stripe(q, -size_v - 0.08, size_v, wide)
        box = stripe(p, -size_u, size_u, wide) * stripe(q, -size_v, size_v, wide)
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
    clump = grain(x + 0.7 * z, y - 0.7 * z, 1.1, pixel_m, number)
    leaf = grain(x - 0.6 * z, y + 0.6 * z, 0.4, pixel_m, number + 1)
    return scaled(colour, max(0.15, 1.0 + look.texture * (0.45 * clump + 0.4 * leaf)))


@per_pixel
def surface_colour(triangle, point, normal, pixel_m, shading):
    """Returns the linear RGB of a triangle at a point, (3,) local metres, and the share of sky it mirrors.

    The normal is unit, ``pixel_m`` the size of a pixel there.
    """
    skin, look, tables, (x, y, z) = shading.skin, shading.look, shading.palettes, point
    kind, number = np.int64(skin.surface[triangle]), np.int64(skin.number[triangle])
    red, green, blue = skin.tint[triangle, 0], skin.tint[triangle, 1], skin.tint[triangle, 2]
    tint = (np.float64(red), np.float64(green), np.float64(blue))
    if kind < _WALL or kind > 200:
        return ground_colour(kind, tint, x, y, pixel_m, look, shading.cover)
    if kind == _WALL:
        colour = _base_colour(tables.walls, tint, number, look)
        return _facade(colour, skin, triangle, number, point, pixel_m, look)
    if kind == _TILE:
        colour = _base_colour(tables.tiles, tint, number, look)
        return _pitched(colour, number, point, normal, pixel_m, look)
    if kind == _FLAT:
        return _flat_roof(_base_colour(tables.flats, tint, number, look), number, x, y, pixel_m, look)
    if kind == _FOLIAGE or kind == _FENCE:
        return _leaves(tint, number, point, pixel_m, look), 0.0
    if kind == _WINDOW or kind == _GLASS:
        i, j = np.int64(np.floor(0.7 * (x + y))), np.int64(np.floor(z / 1.5))
        return _glass(number, i, j, look), 0.3
    if kind == _BODY:
        return _base_colour(tables.paints, tint, number, look), 0.12
    colour = _base_colour(tables.walls, tint, number, look)
    return scaled(colour, 1.0 + 0.1 * look.texture * value_noise(2.0 * (x + y), 2.0 * z, number)), 0.0
