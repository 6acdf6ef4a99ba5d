"""A scene laid out for the silhouette engine, kept on disk if large; and the engine's working memory."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.kernels import arguments
from lodbench.kernels.arguments import (
    BRANCH,
    LANES,
    MAX_CORNERS,
    STRIP,
    Coverage,
    EdgeLists,
    SceneArrays,
    Scratch,
)
from lodbench.rendering import edges, projection
from lodbench.rendering.edges import edge_table
from lodbench.rendering.masks import words_per_row
from lodbench.rendering.projection import bounding_spheres, sphere_tree
from lodbench.storage import digest_of, file_digest, make_folder, new_folder, write_text
from lodbench.storage.digest import map_array, write_arrays
from lodbench.storage.json_text import parse_json
from lodbench.storage.paths import cache_limit_bytes, cache_root, mark_used, prune_cache

Floats = NDArray[np.float64]
Indices = NDArray[np.uint32]

# Room in a hypothesis's list of edges: more than most views have, and small enough for the cache.
_LIST_CAPACITY = 8192


def blank_scratch(scene: SceneArrays, width: int, height: int) -> Scratch:
    """Returns working memory for a scene and a size of image, pixels."""
    vertices, triangles, edges = (int(n) for n in np.diff(scene.starts, axis=0).max(axis=0, initial=0))
    capacity = max(_LIST_CAPACITY, -(-(edges + 1) // LANES) * LANES)
    return Scratch(
        poses=np.zeros(12 * LANES),
        u=np.zeros(LANES * vertices, dtype=np.int32),
        v=np.zeros(LANES * vertices, dtype=np.int32),
        extent=np.zeros(4 * LANES),
        nearest=np.zeros(LANES),
        facing=np.zeros(LANES * triangles, dtype=np.int32),
        lists=edge_lists(capacity),
        coverage=blank_coverage(width, height),
        # Not filled: of a large city most of it is never touched.
        candidates=np.zeros((2, len(scene.order) + BRANCH), dtype=np.int64),
        polygons=np.zeros((2, MAX_CORNERS, 3)),
    )


def blank_coverage(width: int, height: int) -> Coverage:
    """Returns the coverage of an empty view."""
    strips = words_per_row(width)
    return Coverage(
        np.zeros(strips * (height + 1) * STRIP + LANES, dtype=np.int16),
        np.full((LANES, strips), height, dtype=np.int64),
        np.full((LANES, strips), -1, dtype=np.int64),
    )


def edge_lists(capacity: int) -> EdgeLists:
    """Returns empty lists with room for ``capacity`` edges each, a multiple of 8."""
    return EdgeLists(
        np.zeros(LANES * capacity, dtype=np.int64),
        np.zeros(LANES * capacity, dtype=np.int64),
        np.zeros(LANES, dtype=np.int64),
        np.zeros(capacity, dtype=np.int32),
        np.zeros(capacity, dtype=np.int32),
        np.zeros(capacity, dtype=np.int32),
        np.zeros(capacity),
        np.zeros(capacity),
    )


# Triangles laid out at a time: sorting their edges takes some fifty times their size meanwhile.
_CHUNK_TRIANGLES = 1 << 18


def scene_arrays(scene: Scene) -> SceneArrays:
    """Returns a scene laid out for the kernel; every array is read only, as those mapped from disk are."""
    columns: dict[str, list[NDArray[np.generic]]] = {}
    edge_counts = [np.zeros(1, dtype=np.int64)]
    for part in _parts(scene):
        arrays, edges_of_building = _part_arrays(part)
        edge_counts.append(edges_of_building)
        for name, array in arrays.items():
            columns.setdefault(name, []).append(array)
    starts = [scene.vertex_starts, scene.triangle_starts, np.cumsum(np.concatenate(edge_counts))]
    whole: dict[str, NDArray[np.generic]] = {"starts": np.stack(starts, axis=1), **_bounds(scene)}
    for name in list(columns):
        # One at a time, so that no more than one array is there twice.
        whole[name] = np.concatenate(columns.pop(name))
    return SceneArrays(**_read_only(whole))  # type: ignore[arg-type]


def moved_arrays(arrays: SceneArrays, scene: Scene) -> SceneArrays:
    """Returns the arrays of a scene that differs in where its vertices are from one laid out."""
    return arrays._replace(**_read_only({**_coordinates(scene), **_bounds(scene)}))  # type: ignore[arg-type]


def _coordinates(scene: Scene) -> dict[str, NDArray[np.generic]]:
    return dict(zip("xyz", np.ascontiguousarray(scene.vertices.T), strict=True))


def _bounds(scene: Scene) -> dict[str, NDArray[np.generic]]:
    spheres = bounding_spheres(scene)
    return {"spheres": spheres, **sphere_tree(spheres)._asdict()}


def _read_only(arrays: dict[str, NDArray[np.generic]]) -> dict[str, NDArray[np.generic]]:
    for array in arrays.values():
        array.setflags(write=False)
    return arrays


def _parts(scene: Scene) -> Iterator[Scene]:
    """Yields a scene in parts of a few buildings, whose triangles count vertices from the part's first."""
    wanted = np.arange(0, len(scene.triangles), _CHUNK_TRIANGLES)
    cuts = np.unique([0, *np.searchsorted(scene.triangle_starts, wanted), scene.num_buildings])
    for first, stop in pairwise(cuts):
        v, t = scene.vertex_starts[first : stop + 1], scene.triangle_starts[first : stop + 1]
        yield replace(
            scene,
            vertices=scene.vertices[v[0] : v[-1]],
            triangles=scene.triangles[t[0] : t[-1]] - np.int32(v[0]),
            vertex_starts=v - v[0],
            triangle_starts=t - t[0],
            building_ids=scene.building_ids[first:stop],
            pitched=None,
            stored_digest="",
        )


def _part_arrays(scene: Scene) -> tuple[dict[str, NDArray[np.generic]], NDArray[np.int64]]:
    """Returns the arrays of some buildings that have a row per vertex, triangle or edge; and edge counts."""
    edges = edge_table(scene)
    edge_counts = np.diff(edges.starts)
    buildings = np.arange(scene.num_buildings)
    first_vertex = scene.vertex_starts[:-1, None]
    of_triangle = np.repeat(buildings, np.diff(scene.triangle_starts))
    of_edge = np.repeat(buildings, edge_counts)
    corners = _columns(scene.triangles - first_vertex[of_triangle])
    ends = _columns(edges.corners - first_vertex[of_edge])
    sides = _columns(edges.sides - scene.triangle_starts[:-1, None][of_edge])
    arrays: dict[str, NDArray[np.generic]] = {
        **_coordinates(scene),
        **dict(zip(("corner_a", "corner_b", "corner_c"), corners, strict=True)),
        **dict(zip(("tail", "head"), ends, strict=True)),
        **dict(zip(("side_a", "side_b"), sides, strict=True)),
        "second_weight": edges.second_weight,
    }
    return arrays, edge_counts


def _columns(table: NDArray[np.int64]) -> list[Indices]:
    """Returns the columns of an (N, K) table of indices as K contiguous uint32 arrays."""
    return [np.ascontiguousarray(column, dtype=np.uint32) for column in table.T]


_LOGGER = logging.getLogger(__name__)

# Fewer triangles are laid out in a second or two: not worth their place on disk.
_STORED_FROM_TRIANGLES = 500_000
_DIGESTS = "digests.json"


def open_arrays(scene: Scene) -> SceneArrays:
    """Returns a scene laid out for the kernel, mapped from the cache where that is worth it.

    Only scenes that are themselves mapped from disk are kept: their digest is known without reading
    them. A cache that cannot be written costs nothing but the time.
    """
    if not scene.stored_digest or len(scene.triangles) < _STORED_FROM_TRIANGLES:
        return scene_arrays(scene)
    folder = arrays_folder(scene)
    if folder.is_dir():
        try:
            arrays = _read(folder)
            mark_used(folder)
            return arrays
        except (OSError, ValueError, KeyError, TypeError) as error:
            _LOGGER.warning("The engine's arrays in %s are damaged: %s. They are made anew.", folder, error)
    arrays = scene_arrays(scene)
    try:
        make_folder(folder.parent)
        with new_folder(folder, survives_power_cut=False) as partial:
            digests = write_arrays(partial, arrays._asdict())
            write_text(partial / _DIGESTS, json.dumps(digests), survives_power_cut=False)
        prune_cache(folder.parent, cache_limit_bytes(), keep=folder)
        return _read(folder)
    except OSError as error:
        _LOGGER.info("The engine's cache %s cannot be written: %s", folder.parent, error)
        return arrays


def arrays_folder(scene: Scene) -> Path:
    """Returns where the arrays of a scene that is mapped from disk are kept."""
    return cache_root() / "engine" / digest_of([scene.stored_digest, _code_digest()], length=24)


def _read(folder: Path) -> SceneArrays:
    digests = parse_json((folder / _DIGESTS).read_text(encoding="utf-8"))
    mapped = (map_array(folder / f"{name}.npy", digests[name]) for name in SceneArrays._fields)
    # As plain arrays: compiled code is chosen by type, and a memmap is another.
    return SceneArrays(*(np.asarray(array) for array in mapped))


@cache
def _code_digest() -> str:
    """Returns a digest of the code that lays scenes out: no version number has to be remembered."""
    files = (arguments.__file__, edges.__file__, projection.__file__, __file__)
    return digest_of([file_digest(Path(str(file))) for file in files])
