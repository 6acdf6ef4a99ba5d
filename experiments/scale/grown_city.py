"""A seeded city of any size round one and the same core: tiles of a thousand buildings, ring by ring.

Building b of a city is building b of every larger one, bit for bit, so that two sizes can be compared
on the same views.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from mapbox_earcut import triangulate_float64
from numpy.typing import NDArray

from lodbench.bench import Progress, no_progress
from lodbench.citymodel.scene import Scene, build_scene
from lodbench.citymodel.scene_file import read_scene, write_scene
from lodbench.errors import CityModelError
from lodbench.storage import digest_of, file_digest, make_folder, random_stream
from lodbench.storage.paths import cache_root

Floats = NDArray[np.float64]

TILE_BUILDINGS = 1000
_COLUMNS, _ROWS = 40, 25
# The lot of a building, metres: houses, yards and their share of the streets.
_LOT_M = (30.0, 40.0)
_TILE_M = (_COLUMNS * _LOT_M[0], _ROWS * _LOT_M[1])

# Outlines of blocks in a unit square, counter-clockwise: a slab, an L, a T and a court open to one side.
_OUTLINES = (
    ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)),
    ((-0.5, -0.5), (0.5, -0.5), (0.5, -0.1), (-0.1, -0.1), (-0.1, 0.5), (-0.5, 0.5)),
    ((-0.2, -0.5), (0.2, -0.5), (0.2, 0.1), (0.5, 0.1), (0.5, 0.5), (-0.5, 0.5), (-0.5, 0.1), (-0.2, 0.1)),
    ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (0.2, 0.5), (0.2, -0.1), (-0.2, -0.1), (-0.2, 0.5), (-0.5, 0.5)),
)


def grown_city(buildings: int, seed: int = 0, progress: Progress = no_progress) -> Scene:
    """Returns a city of so many blocks on flat ground, the first tile's in the middle."""
    places = _tile_places(-(-buildings // TILE_BUILDINGS))
    tiles = []
    for k, place in enumerate(places):
        count = min(TILE_BUILDINGS, buildings - k * TILE_BUILDINGS)
        tiles.append(_tile(seed, k, place, count))
        progress(k + 1, len(places))
    return _joined(tiles)


def open_grown_city(buildings: int, seed: int = 0, progress: Progress = no_progress) -> Path:
    """Returns the scene folder of ``grown_city`` in the cache, made if it is not there.

    Raises:
        OSError: The cache cannot be written.
    """
    name = f"city-{buildings}-{digest_of([seed, file_digest(Path(__file__))])}"
    folder = cache_root() / "bench" / name
    try:
        read_scene(folder)
    except CityModelError:
        make_folder(folder.parent)
        write_scene(grown_city(buildings, seed, progress), folder, survives_power_cut=False)
    return folder


def _tile_places(count: int) -> NDArray[np.int64]:
    """Returns (count, 2) columns and rows of tiles, ring by ring round (0, 0)."""
    reach = int(np.ceil(np.sqrt(count))) // 2 + 1
    grid = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2, indexing="ij"), axis=2).reshape(-1, 2)
    order = np.lexsort((grid[:, 1], grid[:, 0], np.abs(grid).max(axis=1)))
    return grid[order[:count]]


def _tile(seed: int, index: int, place: NDArray[np.int64], count: int) -> Scene:
    """Returns the first buildings of a tile."""
    stream = random_stream(seed, "grown city", index)
    # Always drawn for a whole tile: a city that ends within it has the same buildings.
    kinds = stream.integers(0, len(_OUTLINES), TILE_BUILDINGS)
    sizes = stream.uniform([13.0, 13.0, 6.0], [24.0, 30.0, 28.0], (TILE_BUILDINGS, 3))
    towers = stream.random(TILE_BUILDINGS) < 0.03
    sizes[towers, 2] *= 2.0
    turns = np.radians(stream.uniform(-8.0, 8.0, TILE_BUILDINGS))
    shifts = stream.uniform(-2.0, 2.0, (TILE_BUILDINGS, 2))
    lots = np.stack(np.divmod(np.arange(TILE_BUILDINGS), _ROWS), axis=1) + 0.5
    middles = (lots - [_COLUMNS / 2, _ROWS / 2]) * _LOT_M + place * _TILE_M + shifts
    points: list[Floats] = []
    triangles: list[NDArray[np.int64]] = []
    owners: list[NDArray[np.int32]] = []
    offset = 0
    for kind, outline in enumerate(_OUTLINES):
        mine = np.flatnonzero(kinds[:count] == kind)
        solid, faces = _prism(np.array(outline))
        corners = solid * sizes[mine, None]
        cos, sin = np.cos(turns[mine, None]), np.sin(turns[mine, None])
        x = corners[:, :, 0] * cos - corners[:, :, 1] * sin + middles[mine, None, 0]
        y = corners[:, :, 0] * sin + corners[:, :, 1] * cos + middles[mine, None, 1]
        points.append(np.stack([x, y, corners[:, :, 2]], axis=2).reshape(-1, 3))
        first = offset + np.arange(len(mine)) * len(solid)
        triangles.append((first[:, None, None] + faces).reshape(-1, 3))
        owners.append(np.repeat(mine, len(faces)).astype(np.int32))
        offset += len(mine) * len(solid)
    names = tuple(f"{index}-{b}" for b in range(count))
    return build_scene(np.concatenate(points), np.concatenate(triangles), np.concatenate(owners), names)


def _prism(outline: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Returns the corners, (2 N, 3), and outward triangles of an upright prism of height 1."""
    n = len(outline)
    corners = np.concatenate([np.column_stack([outline, np.full(n, z)]) for z in (0.0, 1.0)])
    roof = triangulate_float64(outline, np.array([n], dtype=np.uint32)).reshape(-1, 3).astype(np.int64) + n
    a, b, c = (corners[roof[:, i], :2] for i in range(3))
    is_clockwise = (b - a)[:, 0] * (c - a)[:, 1] < (b - a)[:, 1] * (c - a)[:, 0]
    roof[is_clockwise] = roof[is_clockwise][:, ::-1]
    i, j = np.arange(n), np.roll(np.arange(n), -1)
    walls = [np.stack([i, j, j + n], axis=1), np.stack([i, j + n, i + n], axis=1)]
    return corners, np.concatenate([roof, *walls, roof[:, ::-1] - n])


def _joined(tiles: list[Scene]) -> Scene:
    """Returns the buildings of all tiles, in order, as one scene."""
    vertices = np.cumsum([0, *(len(tile.vertices) for tile in tiles)])
    corners = np.cumsum([0, *(len(tile.triangles) for tile in tiles)])
    return replace(
        tiles[0],
        vertices=np.concatenate([tile.vertices for tile in tiles]),
        triangles=np.concatenate(
            [tile.triangles + np.int32(start) for tile, start in zip(tiles, vertices[:-1], strict=True)]
        ),
        vertex_starts=_starts([tile.vertex_starts for tile in tiles], vertices),
        triangle_starts=_starts([tile.triangle_starts for tile in tiles], corners),
        building_ids=tuple(name for tile in tiles for name in tile.building_ids),
    )


def _starts(parts: list[NDArray[np.int64]], offsets: NDArray[np.int64]) -> NDArray[np.int64]:
    """Returns the offsets of all buildings from those within each tile."""
    inner = [part[:-1] + offset for part, offset in zip(parts, offsets[:-1], strict=True)]
    return np.concatenate([*inner, offsets[-1:]])
