"""From a scene to the arrays the silhouette engine's kernel works on, a few buildings at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.kernels.arguments import SceneArrays
from lodbench.rendering.engine_arrays import Indices
from lodbench.rendering.selection import bounding_spheres, sphere_tree
from lodbench.rendering.topology import edge_table

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
