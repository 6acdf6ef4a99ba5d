"""Triangles of scene props while they are collected."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.kernels.looks import SurfaceClass
from lodbench.synthesis.objects.scene_props import SceneProps

Points = NDArray[np.float64]
Triangles = NDArray[np.int64]
Numbers = NDArray[np.int64]
Tint = NDArray[np.float64] | tuple[float, float, float]
Classes = SurfaceClass | NDArray[np.uint8]


def palette(codes: str) -> Points:
    """Returns colours, (N, 3) RGB from 0 to 255, of codes as in HTML without the sign: "e2d8c4 ece6da"."""
    return np.array([tuple(bytes.fromhex(code)) for code in codes.split()], dtype=np.float64)


def pick(colours: Points, chances: np.random.Generator, low: float, high: float) -> Points:
    """Returns one of some colours, (3,), by chance, and so many times as bright."""
    return np.asarray(colours[int(chances.integers(len(colours)))] * chances.uniform(low, high))


class MeshBuilder:
    """Collects triangles, and numbers the objects they belong to."""

    def __init__(self, num_buildings: int) -> None:
        self._num_buildings = num_buildings
        self._num_objects = num_buildings
        self._parts: list[tuple[Points, Triangles, NDArray[np.uint8], NDArray[np.int64], Points]] = []
        self._num_points = 0

    def new_objects(self, count: int) -> NDArray[np.int64]:
        """Returns so many fresh numbers, (count,)."""
        first, self._num_objects = self._num_objects, self._num_objects + count
        return np.arange(first, self._num_objects)

    def add(
        self,
        surface: Classes,
        points: Points,
        triangles: Triangles,
        tint: Tint,
        objects: Numbers | int | None = None,
    ) -> None:
        """Adds triangles, (T, 3) indices into points, (P, 3) local metres.

        Class, RGB and object are of all, or (T,), (T, 3) and (T,) of each; without ``objects`` they are a new
        one.
        """
        count = len(triangles)
        if objects is None:
            objects = self.new_objects(1)[0]
        kinds = np.broadcast_to(np.asarray(surface, np.uint8), count)
        owners = np.broadcast_to(np.asarray(objects, np.int64), count)
        tints = np.broadcast_to(np.asarray(tint, np.float64), (count, 3))
        self._parts.append((points, triangles + self._num_points, kinds, owners, tints))
        self._num_points += len(points)

    def add_copies(
        self, surface: Classes, points: Points, faces: Triangles, tint: Tint, objects: Numbers | None = None
    ) -> Numbers:
        """Adds many objects of the same triangles, each with points of its own; returns their numbers, (N,).

        Points are (N, P, 3) local metres, faces (F, 3) indices into the P of one object, a class of all or
        (F,), RGB of all or (N, F, 3); without ``objects``, (N,), the numbers are new.
        """
        count, size, _ = points.shape
        numbers = self.new_objects(count) if objects is None else objects
        triangles = (faces[None] + size * np.arange(count)[:, None, None]).reshape(-1, 3)
        colours = np.broadcast_to(np.asarray(tint, np.float64), (count, len(faces), 3)).reshape(-1, 3)
        kinds = np.tile(np.broadcast_to(np.asarray(surface, np.uint8), len(faces)), count)
        self.add(kinds, points.reshape(-1, 3), triangles, colours, np.repeat(numbers, len(faces)))
        return numbers

    def build(self, origin: Points) -> SceneProps:
        """Returns everything added, in the frame of an origin, (3,)."""
        points, triangles, surface, objects, tint = (
            np.concatenate(arrays) for arrays in zip(*self._parts, strict=True)
        )
        return SceneProps(
            vertices=points.astype(np.float32),
            triangles=triangles.astype(np.int32),
            surface=surface,
            objects=objects.astype(np.int32),
            tint=np.clip(np.round(tint), 0, 255).astype(np.uint8),
            num_buildings=self._num_buildings,
            origin=np.asarray(origin, dtype=np.float64),
        )


def ring_walls(size: int, rings: int = 2) -> Triangles:
    """Returns the triangles between closed rings of so many points, each above the last, facing outward."""
    k = np.arange(size * (rings - 1))
    ahead = k - k % size + (k + 1) % size
    return np.concatenate([np.stack([k, ahead, ahead + size], 1), np.stack([k, ahead + size, k + size], 1)])


def grid_triangles(rows: int, columns: int) -> Triangles:
    """Returns the triangles of a grid of points, which face up where rows go north and columns east."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


# Between two rings of four points, the second above the first, and over the second.
BLOCK_FACES = np.concatenate([ring_walls(4), [[4, 5, 6], [4, 6, 7]]])
