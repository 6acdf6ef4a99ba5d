"""Masks of photos from polygons traced by hand, as `lodbench train traced=[OUT]` reads them.

Usage: python recipes/traced_masks.py PHOTOS OUT, with PHOTOS a folder per place of the photos that
recipes/traced names. White is building, grey is what could not be told.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np

TRACED = Path(__file__).parent / "traced"
VALUES = {"building": 255, "hole": 0, "unknown": 128}


def main(photos: Path, out: Path) -> None:
    """Writes OUT/PLACE/photos and OUT/PLACE/masks."""
    for labels in sorted(TRACED.glob("*/*.json")):  # a photo that is missing ends it
        traced = json.loads(labels.read_text(encoding="utf-8"))
        photo = photos / labels.parent.name / traced["imagePath"]
        mask = np.zeros((traced["imageHeight"], traced["imageWidth"]), np.uint8)
        for shape in traced["shapes"]:
            # LabelMe's points count from the first pixel's corner.
            points = np.rint((np.array(shape["points"]) - 0.5) * 16).astype(np.int32)
            cv2.fillPoly(mask, [points], VALUES[shape["label"]], shift=4)
        for kind in ("photos", "masks"):
            (out / labels.parent.name / kind).mkdir(parents=True, exist_ok=True)
        shutil.copy(photo, out / labels.parent.name / "photos" / f"{labels.stem}{photo.suffix}")
        cv2.imwrite(str(out / labels.parent.name / "masks" / f"{labels.stem}.png"), mask)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]))
