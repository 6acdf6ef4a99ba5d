"""A drawn flight over a few blocks: photos, a COLMAP model in a frame of its own, tracings, the known map."""

from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from lodbench.datasets.exchange.colmap import write_colmap
from lodbench.datasets.pose_text import FoundPose, format_pose, lines_to_text
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.geometry.similarity import Similarity
from lodbench.harness.tracing.outputs import write_tracing
from lodbench.harness.tracing.roofs import Traced
from tests.town import BOXES, box_obj

CAMERA = Camera(960, 720, 800.0, 800.0, 480.0, 360.0)
# From the map to the model: a unit is seven metres, and its axes are tilted.
TO_MODEL = Similarity(1 / 7, Rotation.from_euler("xyz", [160, 12, 40], degrees=True).as_matrix(), np.ones(3))
# Level ground of 20 m between two marks, traced as a known length.
LENGTH = np.array([[-30.0, -65.0, 0.0], [-10.0, -65.0, 0.0]])


def roofs() -> dict[str, np.ndarray]:
    """Returns the (4, 3) roof corners of each block."""
    return {
        f"block {number}": np.array([[w, s, top], [e, s, top], [e, n, top], [w, n, top]], float)
        for number, (w, s, e, n, _, top) in enumerate(BOXES, start=1)
    }


def poses() -> dict[str, Pose]:
    """Returns twelve views from all sides by name, 140 m up."""
    turns = np.arange(12) * 30.0
    places = [
        (65 * np.sin(np.radians(t)), -65 * np.cos(np.radians(t)), 130.0 + 20 * (t % 60 > 0)) for t in turns
    ]
    return {
        f"view_{number:02d}.jpg": Pose.from_euler(EulerAngles(25.0, 0.0, float(turn)), place)
        for number, (turn, place) in enumerate(zip(turns, places, strict=True))
    }


def drawn(pose: Pose, seed: int) -> np.ndarray:
    """Returns a photo, (H, W, 3) BGR: blocks from the furthest to the nearest, each face of one colour."""
    # Four times as large: OpenCV fills half a pixel beyond each edge.
    picture = np.full((4 * CAMERA.height, 4 * CAMERA.width, 3), (70, 120, 90), np.uint8)
    colours = np.random.default_rng(7).integers(90, 220, size=(len(BOXES), 3))

    def fill(points: np.ndarray, colour: np.ndarray) -> None:
        pixels = 4 * CAMERA.project(points @ pose.rotation.T + pose.translation) - 0.5
        cv2.fillPoly(picture, [np.rint(pixels).astype(np.int32)], colour.tolist())

    order = sorted(
        range(len(BOXES)),
        key=lambda k: -np.hypot(*(np.add(BOXES[k][:2], BOXES[k][2:4]) / 2 - pose.center[:2])),
    )
    for number in order:
        roof = roofs()[f"block {number + 1}"]
        floor = roof * [1, 1, 0] + [0, 0, BOXES[number][4]]
        for side in range(4):
            a, b = side, (side + 1) % 4
            outward = np.array([roof[b, 1] - roof[a, 1], roof[a, 0] - roof[b, 0]])
            if outward @ (pose.center[:2] - roof[a, :2]) > 0:
                fill(np.stack([floor[a], floor[b], roof[b], roof[a]]), colours[number] * (0.35 + 0.1 * side))
        fill(roof, colours[number])
    picture = cv2.resize(picture, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(seed).normal(0, 4, picture.shape)
    return np.clip(cv2.GaussianBlur(picture, (0, 0), 0.7) + noise, 0, 255).astype(np.uint8)


def sparse_points() -> np.ndarray:
    """Returns (N, 3) points of the map: ground, roofs, and trees over a third of the ground."""
    generator = np.random.default_rng(3)
    ground = np.column_stack([generator.uniform(-110, 110, (3000, 2)), generator.normal(0, 0.05, 3000)])
    trees = ground[:1000] + np.column_stack([np.zeros((1000, 2)), generator.uniform(3, 8, 1000)])
    return np.concatenate([ground, trees, *roofs().values()])


def traced_by_hand(pixels: float, seed: int, names: tuple[str, ...] = ()) -> list[Traced]:
    """Returns roofs as traced in two views opposite each other, each corner some pixels off; and a length."""
    generator, views = np.random.default_rng(seed), poses()
    pair = ("view_01.jpg", "view_07.jpg")
    found = []
    for name, corners in {**roofs(), "marks": LENGTH}.items():
        if names and name not in (*names, "marks"):
            continue
        drawn_in = {}
        for photo in pair:
            exact = CAMERA.project(corners @ views[photo].rotation.T + views[photo].translation)
            off = 0.0 if name == "marks" else pixels
            drawn_in[photo] = exact + generator.normal(0, 1, exact.shape) * off
        kind, metres = ("length", 20.0) if name == "marks" else ("roof", None)
        found.append(Traced(kind, name, drawn_in, metres))
    return found


def write_case(folder: Path) -> None:
    """Writes ``photos``, ``sparse/0``, ``traced.json``, ``again.json``, ``rough.txt`` and ``known.obj``."""
    (folder / "photos").mkdir(parents=True)
    images = []
    for seed, (name, pose) in enumerate(poses().items()):
        cv2.imwrite(str(folder / "photos" / name), drawn(pose, seed), [cv2.IMWRITE_JPEG_QUALITY, 95])
        images.append(FoundPose(name, "", TO_MODEL.pose(pose), CAMERA))
    write_colmap(images, folder / "sparse" / "0")
    points = TO_MODEL.points(sparse_points())
    lines = [f"{number} {x} {y} {z} 0 0 0 0.5" for number, (x, y, z) in enumerate(points.tolist(), start=1)]
    (folder / "sparse" / "0" / "points3D.txt").write_text(lines_to_text(lines))
    write_tracing(traced_by_hand(3.0, 1), folder / "traced.json")
    write_tracing(traced_by_hand(3.0, 2), folder / "again.json")
    (folder / "rough.txt").write_text(lines_to_text(format_pose(n, p) for n, p in poses().items()))
    (folder / "known.obj").write_text(box_obj())
