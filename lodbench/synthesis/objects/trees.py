"""Trees: trunks, round crowns and cones, no two alike."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.synthesis.objects.mesh_builder import MeshBuilder, ring_walls
from lodbench.synthesis.objects.scene_props import SurfaceClass

Points = NDArray[np.float64]

_TRUNK = (92.0, 76.0, 60.0)
_LEAVES = np.array([(70, 92, 44), (84, 104, 50), (60, 82, 42), (98, 110, 56), (78, 100, 62)], float)
_NEEDLES = np.array([(48, 70, 46), (56, 78, 52), (42, 62, 44)], float)


def add_trees(
    builder: MeshBuilder,
    feet: Points,
    chances: np.random.Generator,
    broadleaf: float,
    room_m: Points | None = None,
    *,
    is_far: bool = False,
) -> None:
    """Adds a tree at each place.

    Args:
        builder: Takes them.
        feet: (N, 3) where they stand, metres.
        chances: Source of chance.
        broadleaf: Share of trees that are no conifers.
        room_m: (N,) greatest radius of each crown; None where nothing is near.
        is_far: Whether they are seen from afar only: of fewer triangles and without trunks.
    """
    count = len(feet)
    is_broad = chances.random(count) < broadleaf
    radius = np.where(is_broad, chances.uniform(1.7, 4.3, count), chances.uniform(1.4, 2.8, count))
    radius = radius if room_m is None else np.minimum(radius, room_m)
    height = (
        np.where(is_broad, chances.uniform(2.2, 3.2, count), chances.uniform(3.6, 5.0, count)) * radius + 1.0
    )
    ball, faces = _ball(0 if is_far else 1)
    crown = ball[None] * (1.0 + chances.normal(0.0, 0.13, (count, len(ball), 1)))
    # A conifer is a cone: the higher, the narrower.
    taper = np.where(is_broad[:, None], 1.0, np.clip(0.62 - 0.6 * ball[None, :, 2], 0.04, 1.0))
    trunk_m = np.where(is_broad, 0.28, 0.1) * height
    half = 0.5 * (height - trunk_m)
    points = crown * np.stack([radius, radius, half], axis=1)[:, None, :]
    points[:, :, :2] *= taper[:, :, None]
    points += feet[:, None, :] + np.stack([0 * half, 0 * half, trunk_m + half], axis=1)[:, None, :]
    leaf = np.where(is_broad[:, None], _drawn(_LEAVES, count, chances), _drawn(_NEEDLES, count, chances))
    shade = chances.normal(1.0, 0.07, (count, len(faces), 1))
    trees = builder.add_copies(SurfaceClass.FOLIAGE, points, faces, leaf[:, None, :] * shade)
    if not is_far:
        size = np.stack([0.06 * radius + 0.07, 0.06 * radius + 0.07, trunk_m + 0.4 * half], axis=1)
        post, sides = _post()
        trunks = post[None] * size[:, None, :] + feet[:, None, :]
        builder.add_copies(SurfaceClass.TRUNK, trunks, sides, _TRUNK, trees)


def _drawn(colours: Points, count: int, chances: np.random.Generator) -> Points:
    return np.asarray(
        colours[chances.integers(len(colours), size=count)] * chances.uniform(0.85, 1.15, (count, 1))
    )


def _post() -> tuple[Points, NDArray[np.int64]]:
    """Returns a trunk of unit size with five sides, rooted a little below the ground, and its triangles."""
    spin = np.arange(5) * 2 * np.pi / 5
    rings = [np.stack([np.cos(spin), np.sin(spin), np.full(5, z)], axis=1) for z in (-0.3, 1.0)]
    return np.concatenate(rings), ring_walls(5)


def _ball(halvings: int) -> tuple[Points, NDArray[np.int64]]:
    """Returns an icosahedron, its edges halved some times, on the unit sphere; triangles look outward."""
    import trimesh

    solid = trimesh.creation.icosahedron()
    points, faces = np.asarray(solid.vertices), np.asarray(solid.faces)
    for _ in range(halvings):
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        _, first, edge = np.unique(edges, axis=0, return_index=True, return_inverse=True)
        # Middles are numbered in the order in which the faces name their edges.
        number = len(points) + np.argsort(np.argsort(first))[edge].reshape(-1, 3)
        middles = points[edges[np.sort(first)]].sum(axis=1)
        points = np.concatenate([points, middles / np.linalg.norm(middles, axis=1, keepdims=True)])
        (a, b, c), (ab, bc, ca) = faces.T, number.T
        parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        faces = np.stack([np.stack(part, axis=1) for part in parts], axis=1).reshape(-1, 3)
    return points, faces
