"""What stands in pictures: triangles with classes and colours, their builder, shapes of trees and cars."""

from __future__ import annotations

import io
import zipfile
import zlib
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import RenderingError
from lodbench.kernels.looks import SurfaceClass
from lodbench.storage.disk import write_bytes

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


_TRUNK = palette("5c4c3c")
_LEAVES = palette("465c2c 546832 3c522a 626e38 4e643e")
_NEEDLES = palette("30462e 384e34 2a3e2c")
_PAINTS = palette("e8e8e8 3c3e42 96989c 222428 962824 2e4676 c4beb2")
_GLASS = palette("343c44")
_SIZES_M = ((3.8, 4.9), (1.7, 1.9), (1.4, 1.75))  # of cars: length, width and height
# Rings of four corners, from the ground up: back and front end, half the width, height; of a unit car.
_RINGS = ((-0.5, 0.5, 0.5, 0.14), (-0.5, 0.5, 0.5, 0.55), (-0.42, 0.24, 0.46, 0.60), (-0.30, 0.10, 0.38, 1.0))


def add_trees(
    builder: MeshBuilder,
    bases: Points,
    chances: np.random.Generator,
    broadleaf: float,
    room_m: Points | None = None,
    *,
    is_far: bool = False,
) -> None:
    """Adds a tree at each foot, (N, 3) metres, a share of them broadleaved.

    ``room_m``, (N,), is the greatest radius of each crown; None where nothing is near. Trees viewed from afar
    only are of fewer triangles and without trunks.
    """
    count = len(bases)
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
    points += bases[:, None, :] + np.stack([0 * half, 0 * half, trunk_m + half], axis=1)[:, None, :]
    leaf = np.where(is_broad[:, None], _drawn(_LEAVES, count, chances), _drawn(_NEEDLES, count, chances))
    shade = chances.normal(1.0, 0.07, (count, len(faces), 1))
    trees = builder.add_copies(SurfaceClass.FOLIAGE, points, faces, leaf[:, None, :] * shade)
    if not is_far:
        size = np.stack([0.06 * radius + 0.07, 0.06 * radius + 0.07, trunk_m + 0.4 * half], axis=1)
        post, sides = _post()
        trunks = post[None] * size[:, None, :] + bases[:, None, :]
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
    builder: MeshBuilder, bases: Points, ways: Points, slope: Points, chances: np.random.Generator
) -> None:
    """Adds a car over each foot, (N, 3) metres, that points along a way, (N, 2) unit directions.

    ``slope``, (N,), is by how much the ground rises per metre ahead.
    """
    count = len(bases)
    lengths, widths, heights = (chances.uniform(*bounds, count) for bounds in _SIZES_M)
    shape, faces, is_glass = _unit_car()
    ahead, left, up = np.moveaxis(shape[None] * np.stack([lengths, widths, heights], axis=1)[:, None], 2, 0)
    points = np.empty((count, len(shape), 3))
    points[..., 0] = bases[:, None, 0] + ahead * ways[:, None, 0] + left * -ways[:, None, 1]
    points[..., 1] = bases[:, None, 1] + ahead * ways[:, None, 1] + left * ways[:, None, 0]
    points[..., 2] = bases[:, None, 2] + up + ahead * slope[:, None]
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


@dataclass(frozen=True, slots=True, eq=False)
class SceneProps:
    """Triangles to be seen, in the local metric frame of a city's scenes (x east, y north, z up)."""

    # (V, 3) float32, metres; ``vertices + origin`` are coordinates in the city's CRS.
    vertices: NDArray[np.float32]
    # (T, 3) int32 indices into ``vertices``, counter-clockwise viewed from outside.
    triangles: NDArray[np.int32]
    surface: NDArray[np.uint8]  # (T,) uint8 ``SurfaceClass``
    # (T,) int32 number of the object a triangle is part of: below ``num_buildings`` the index of the building
    # in the city file's order (``Scene.building_ids``), above one number for each tree, car or street. For
    # instance labels, and for one random tint per object.
    objects: NDArray[np.int32]
    # (T, 3) uint8 RGB, the base colour in white light, before texture, noise and shading.
    tint: NDArray[np.uint8]
    num_buildings: int  # buildings of the city file
    origin: NDArray[np.float64]  # (3,) float64

    def __len__(self) -> int:
        return len(self.triangles)

    @property
    def has_buildings(self) -> bool:
        """Whether the buildings themselves are among the triangles."""
        return bool((self.surface == SurfaceClass.WALL).any())

    def part(self, chosen: NDArray[np.bool_]) -> SceneProps:
        """Returns some of the triangles, chosen by a (T,) mask, and the vertices they use."""
        used, inverse = np.unique(self.triangles[chosen], return_inverse=True)
        return replace(
            self,
            vertices=self.vertices[used],
            triangles=inverse.reshape(-1, 3).astype(np.int32),
            surface=self.surface[chosen],
            objects=self.objects[chosen],
            tint=self.tint[chosen],
        )

    def in_frame(self, origin: NDArray[np.float64]) -> SceneProps:
        """Returns the same in the local frame of another origin, for example that of a ``Scene``."""
        shift = (self.origin - origin).astype(np.float32)
        return replace(self, vertices=self.vertices + shift, origin=np.asarray(origin, dtype=np.float64))


_FIELDS = tuple(field.name for field in fields(SceneProps))


def write_props(props: SceneProps, path: Path) -> None:
    """Writes props as a compressed ``.npz``, which appears whole or not at all.

    Raises:
        OSError: The folder is missing or not writable.
    """
    content = io.BytesIO()
    arrays: dict[str, Any] = {name: np.asarray(getattr(props, name)) for name in _FIELDS}
    np.savez_compressed(content, **arrays)
    write_bytes(path, content.getvalue())


def read_props(path: Path) -> SceneProps:
    """Returns props that ``write_props`` wrote.

    Raises:
        RenderingError: The file is missing, damaged, or no such file.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            values = {name: arrays[name] for name in _FIELDS}
        return SceneProps(**{**values, "num_buildings": int(values["num_buildings"])})
    except (OSError, ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        reason = (isinstance(error, OSError) and error.strerror) or "damaged, or another file"
        raise RenderingError(
            f"{path} holds no scene props ({reason}).",
            "props=FILE names what lodbench made; without it surroundings are made up.",
        ) from None
