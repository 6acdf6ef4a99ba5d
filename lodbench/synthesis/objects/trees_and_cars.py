"""Trees and cars: trunks with round crowns or cones, hulls with glazed cabins; no two alike."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.kernels.looks import SurfaceClass
from lodbench.synthesis.objects.mesh_builder import MeshBuilder, Points, Triangles, palette, ring_walls

_TRUNK = palette("5c4c3c")
_LEAVES = palette("465c2c 546832 3c522a 626e38 4e643e")
_NEEDLES = palette("30462e 384e34 2a3e2c")
_PAINTS = palette("e8e8e8 3c3e42 96989c 222428 962824 2e4676 c4beb2")
_GLASS = palette("343c44")
_SIZES_M = ((3.8, 4.9), (1.7, 1.9), (1.4, 1.75))  # of cars: length, width and height
# Rings of four corners, from the ground up: back and front end, half the width, height; of a unit car.
_RINGS = (
    (-0.5, 0.5, 0.5, 0.14),
    (-0.5, 0.5, 0.5, 0.55),
    (-0.42, 0.24, 0.46, 0.60),
    (-0.30, 0.10, 0.38, 1.0),
)


def add_trees(
    builder: MeshBuilder,
    feet: Points,
    chances: np.random.Generator,
    broadleaf: float,
    room_m: Points | None = None,
    *,
    is_far: bool = False,
) -> None:
    """Adds a tree at each foot, (N, 3) metres, a share of them broadleaved.

    ``room_m``, (N,), is the greatest radius of each crown; None where nothing is near. Trees seen from afar
    only are of fewer triangles and without trunks.
    """
    count = len(feet)
    is_broad = chances.random(count) < broadleaf
    radius = np.where(is_broad, chances.uniform(1.7, 4.3, count), chances.uniform(1.4, 2.8, count))
    radius = radius if room_m is None else np.minimum(radius, room_m)
    slender = np.where(is_broad, chances.uniform(2.2, 3.2, count), chances.uniform(3.6, 5.0, count))
    height = slender * radius + 1.0
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
    picked = colours[chances.integers(len(colours), size=count)]
    return np.asarray(picked * chances.uniform(0.85, 1.15, (count, 1)))


def _post() -> tuple[Points, Triangles]:
    """Returns a trunk of unit size with five sides, rooted a little below the ground, and its triangles."""
    spin = np.arange(5) * 2 * np.pi / 5
    rings = [np.stack([np.cos(spin), np.sin(spin), np.full(5, z)], axis=1) for z in (-0.3, 1.0)]
    return np.concatenate(rings), ring_walls(5)


def _ball(halvings: int) -> tuple[Points, Triangles]:
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


def add_cars(
    builder: MeshBuilder, feet: Points, ways: Points, slope: Points, chances: np.random.Generator
) -> None:
    """Adds a car over each foot, (N, 3) metres, that points along a way, (N, 2) unit directions.

    ``slope``, (N,), is by how much the ground rises per metre ahead.
    """
    count = len(feet)
    lengths, widths, heights = (chances.uniform(*bounds, count) for bounds in _SIZES_M)
    shape, faces, is_glass = _unit_car()
    ahead, left, up = np.moveaxis(shape[None] * np.stack([lengths, widths, heights], axis=1)[:, None], 2, 0)
    points = np.empty((count, len(shape), 3))
    points[..., 0] = feet[:, None, 0] + ahead * ways[:, None, 0] + left * -ways[:, None, 1]
    points[..., 1] = feet[:, None, 1] + ahead * ways[:, None, 1] + left * ways[:, None, 0]
    points[..., 2] = feet[:, None, 2] + up + ahead * slope[:, None]
    paint = _PAINTS[chances.integers(len(_PAINTS), size=count)] * chances.uniform(0.85, 1.1, (count, 1))
    tint = np.where(is_glass[None, :, None], _GLASS, paint[:, None, :])
    surface = np.where(is_glass, SurfaceClass.CAR_GLASS, SurfaceClass.CAR_BODY).astype(np.uint8)
    builder.add_copies(surface, points, faces, tint)


def _unit_car() -> tuple[Points, Triangles, NDArray[np.bool_]]:
    """Returns a car of unit size, its triangles, and which are glass: a hull, and a cabin with a roof."""
    rings = [
        [(back, -half, z), (front, -half, z), (front, half, z), (back, half, z)]
        for back, front, half, z in _RINGS
    ]
    # Both triangles of a side in a row: eight of the hull's foot, eight of the hull, eight panes, the roof.
    sides = ring_walls(4, 4).reshape(2, -1, 3).swapaxes(0, 1).reshape(-1, 3)
    faces = np.concatenate([sides, [(12, 13, 14), (12, 14, 15)]])
    return np.array(rings, float).reshape(-1, 3), faces, np.arange(len(faces)) // 8 == 2
