"""What a flight is wrong about: the drone, in all photos alike and in each by itself, and the map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.building_boxes import BuildingBoxes, building_boxes
from lodbench.citymodel.scene import Scene, build_scene
from lodbench.geometry import EulerAngles, Pose

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SensorErrors:
    """Half widths of uniform errors, either a flight's or a photo's own."""

    horizontal_m: float  # east and north, metres
    height_m: float  # up, metres
    tilt_deg: float  # pitch and roll, degrees
    yaw_deg: float  # yaw, degrees

    def draw(self, generator: np.random.Generator) -> Floats:
        """Returns (6,) errors of x, y, z (metres), pitch, roll and yaw (degrees)."""
        place = (self.horizontal_m, self.horizontal_m, self.height_m)
        widths = np.array([*place, self.tilt_deg, self.tilt_deg, self.yaw_deg])
        return np.asarray(generator.uniform(-1.0, 1.0, size=6) * widths)


def moved(pose: Pose, error: Floats) -> Pose:
    """Returns a pose whose centre and angles are off by (6,) metres and degrees."""
    angles = np.array(pose.euler) + error[3:]
    return Pose.from_euler(EulerAngles(*map(float, angles)), pose.center + error[:3])


# By how much heights are changed, metres, and how high a building stays at least.
_CHANGE_M, _LOWEST_M = (1.5, 5.0), 2.5
# How far from its original a building that is too many is put, metres, and how often a place is looked for.
_AWAY_M, _TRIES = (25.0, 80.0), 50


@dataclass(frozen=True, slots=True)
class MapErrors:
    """Which share of the map's buildings is wrong; no building is wrong in two ways."""

    heights: float = 0.0  # share whose height is changed by 1.5 to 5 m
    missing: float = 0.0  # share that the map lacks
    extra: float = 0.0  # share that the map has twice, once where there is nothing

    def __bool__(self) -> bool:
        return self.heights + self.missing + self.extra > 0


def change_map(
    scene: Scene, errors: MapErrors, generator: np.random.Generator
) -> tuple[Scene, dict[str, Any]]:
    """Returns a scene that is wrong, and how.

    Returns:
        The scene; and ``heights`` (metres that a building is higher in the map than it was, by id),
        ``missing`` and ``extra`` (ids).
    """
    boxes = building_boxes(scene)
    order = boxes.building[generator.permutation(len(boxes.building))]
    counts = [round(share * len(order)) for share in (errors.heights, errors.missing, errors.extra)]
    other_height, gone, twice = np.split(order, np.cumsum(counts))[:3]
    vertices = scene.vertices.astype(np.float64)
    heights = {}
    for building in other_height:
        part = slice(scene.vertex_starts[building], scene.vertex_starts[building + 1])
        heights[scene.building_ids[building]] = _raise(vertices[part], generator)
    ids, missing = scene.building_ids, set(gone.tolist())
    kept = [(ids[b], b, np.zeros(3)) for b in range(scene.num_buildings) if b not in missing]
    places = [(b, _free_place(boxes, b, generator)) for b in twice.tolist()]
    extra = [(f"{ids[b]}-extra", b, shift) for b, shift in places if shift is not None]
    told = {"missing": sorted(ids[b] for b in missing), "extra": sorted(name for name, *_ in extra)}
    return _assembled(scene, vertices, [*kept, *extra]), {"heights": heights, **told}


def _raise(points: NDArray[np.float64], generator: np.random.Generator) -> float:
    """Makes a building's points, (V, 3), higher or lower in place; returns by how many metres."""
    floor = points[:, 2].min()
    rise = points[:, 2].max() - floor
    change = float(generator.uniform(*_CHANGE_M)) * (1.0 if generator.random() < 0.5 else -1.0)
    change = -change if rise + change < _LOWEST_M else change
    points[:, 2] = floor + (points[:, 2] - floor) * (1.0 + change / max(rise, 1e-6))
    return change


def _free_place(
    boxes: BuildingBoxes, building: int, generator: np.random.Generator
) -> NDArray[np.float64] | None:
    """Returns (3,) metres to a place nearby where a building stands on no other; None if none is found."""
    row = int(np.flatnonzero(boxes.building == building)[0])
    for _ in range(_TRIES):
        angle, away = generator.uniform(0.0, 2.0 * np.pi), generator.uniform(*_AWAY_M)
        shift = np.array([away * np.cos(angle), away * np.sin(angle), 0.0])
        low, high = boxes.low[row] + shift, boxes.high[row] + shift
        overlaps = (boxes.low[:, :2] < high[:2]).all(axis=1) & (boxes.high[:, :2] > low[:2]).all(axis=1)
        if not overlaps.any():
            return shift
    return None


def _assembled(
    scene: Scene, vertices: NDArray[np.float64], parts: list[tuple[str, int, NDArray[np.float64]]]
) -> Scene:
    corners, owners = [], []
    for number, (_, building, shift) in enumerate(parts):
        faces = scene.triangles[scene.triangle_starts[building] : scene.triangle_starts[building + 1]]
        corners.append(vertices[faces].reshape(-1, 3) + shift)
        owners.append(np.full(len(faces), number))
    points = np.concatenate(corners)
    return build_scene(
        points,
        np.arange(len(points)).reshape(-1, 3),
        np.concatenate(owners),
        tuple(name for name, _, _ in parts),
        lod=scene.lod,
        crs=scene.crs,
        origin=scene.origin,
        pitched=None if scene.pitched is None else scene.pitched[[building for _, building, _ in parts]],
    )
