"""Scenes cut out of scenes."""

import numpy as np

from lodbench.citymodel import Scene


def part_of(scene: Scene, buildings) -> Scene:
    """Returns the scene of some of the buildings, ascending."""
    points, triangles, v_starts, t_starts = [], [], [0], [0]
    for b in buildings:
        v0, v1 = scene.vertex_starts[b : b + 2]
        t0, t1 = scene.triangle_starts[b : b + 2]
        points.append(scene.vertices[v0:v1])
        triangles.append(scene.triangles[t0:t1] - v0 + v_starts[-1])
        v_starts.append(v_starts[-1] + v1 - v0)
        t_starts.append(t_starts[-1] + t1 - t0)
    return Scene(
        np.concatenate(points),
        np.concatenate(triangles).astype(np.int32),
        np.array(v_starts, dtype=np.int64),
        np.array(t_starts, dtype=np.int64),
        tuple(scene.building_ids[b] for b in buildings),
        scene.lod,
        scene.crs,
        scene.origin,
    )
