"""A tiny city and dataset written by the tests: a few boxes as OBJ, and queries that look at them."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from lodbench.citymodel import open_scene
from lodbench.datasets.pose_text import format_camera, format_pose, lines_to_text
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.rendering.silhouette import SilhouetteRenderer

if TYPE_CHECKING:
    from lodbench.synthesis.town.town import Town

CAMERA = Camera(320, 240, 230.0, 228.0, 161.0, 118.5)
# West, south, east, north, base, top of each building, metres: nothing repeats, so poses are unique.
BOXES = [
    (-60, -50, -25, -20, 0, 18),
    (-10, -55, 12, -38, 2, 30),
    (30, -40, 70, -5, 1, 12),
    (-55, 5, -30, 50, 0, 25),
    (-5, 0, 22, 30, 3, 40),
    (40, 20, 58, 64, 0, 15),
    (-80, 60, -10, 75, 1, 9),
]


@cache
def town_gml() -> str:
    """Returns the demo's town as CityGML with LoD1 and LoD2, made once per process."""
    from lodbench.synthesis.town.build import citygml_text

    return citygml_text(town_of(0))


@cache
def town_of(seed: int) -> Town:
    """Returns the drawn town of a seed, grown once per process: it takes seconds."""
    from lodbench.synthesis.town.town import grow_town

    return grow_town(seed)


def box_obj(boxes: list[tuple[int, ...]] = BOXES) -> str:
    """Returns open boxes (walls and roof, no floor) as Wavefront OBJ."""
    lines = []
    for number, (west, south, east, north, base, top) in enumerate(boxes):
        for z in (base, top):
            lines += [
                f"v {x} {y} {z}" for x, y in ((west, south), (east, south), (east, north), (west, north))
            ]
        first = 8 * number + 1
        for i in range(4):
            j = (i + 1) % 4
            lines.append(f"f {first + i} {first + j} {first + 4 + j} {first + 4 + i}")
        lines.append(f"f {first + 4} {first + 5} {first + 6} {first + 7}")
    return lines_to_text(lines)


def true_poses(count: int) -> dict[str, Pose]:
    """Returns poses above the boxes by image name."""
    generator = np.random.default_rng(7)
    return {
        f"view_{i:02d}.png": Pose.from_euler(
            EulerAngles(20 + 5 * (i % 4), 0.4, -70 + 45 * i), [*generator.uniform(-12, 12, 2), 120 + 6 * i]
        )
        for i in range(count)
    }


def write_dataset(folder: Path, count: int = 3) -> tuple[Path, Path]:
    """Writes a folder dataset with exact masks and shifted priors; returns its root and its city."""
    city = folder / "city.obj"
    folder.mkdir(parents=True, exist_ok=True)
    city.write_text(box_obj())
    renderer = SilhouetteRenderer(open_scene(city), threads=1)
    root = folder / "data"
    (root / "masks").mkdir(parents=True)
    truth = true_poses(count)
    for name, pose in truth.items():
        cv2.imwrite(str(root / "masks" / name), renderer.render(CAMERA, pose).astype(np.uint8) * 255)
    priors = {name: prior_of(pose) for name, pose in truth.items()}
    (root / "GT_pose.txt").write_text(lines_to_text(format_pose(*item) for item in truth.items()))
    (root / "GPS_pose.txt").write_text(lines_to_text(format_pose(*item) for item in priors.items()))
    (root / "intrinsic.txt").write_text(lines_to_text(format_camera(name, CAMERA) for name in truth))
    return root, city


def prior_of(pose: Pose) -> Pose:
    """Returns a prior with the true tilt, about 9 m and 3 degrees off."""
    pitch, roll, yaw = pose.euler
    return Pose.from_euler(EulerAngles(pitch, roll, yaw + 3.0), pose.center + np.array([5.0, -4.0, 6.0]))
