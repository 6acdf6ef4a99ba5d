"""Pictures of red squares on green ground: something a network learns in seconds."""

from pathlib import Path

import cv2
import numpy as np

from lodbench.cli import main
from lodbench.storage import random_stream


def write_views(root: Path) -> Path:
    """Writes ten pictures to train on and two to validate on, with their masks; returns the folder."""
    for split, count in (("train", 10), ("val", 2)):
        for kind in ("images", "masks"):
            (root / split / kind).mkdir(parents=True)
        for number in range(count):
            generator = random_stream(1, split, number)
            picture = generator.integers(0, 60, (64, 96, 3), dtype=np.uint8)
            picture[..., 1] += 100
            mask = np.zeros((64, 96), np.uint8)
            top, left = int(generator.integers(4, 30)), int(generator.integers(4, 60))
            mask[top : top + 28, left : left + 30] = 255
            picture[mask > 0] = picture[mask > 0] // 2 + np.array([0, 0, 180], np.uint8)
            cv2.imwrite(str(root / split / "images" / f"{number}.png"), picture)
            cv2.imwrite(str(root / split / "masks" / f"{number}.png"), mask)
    return root


def train(views, out, *words):
    schedule = ["schedule.batch=4", "schedule.crop=64", "schedule.val_every=1", "threads=1"]
    return main(["train", f"data={views}", f"out={out}", "schedule.epochs=3", *schedule, *words])
