"""Labels: pictures whose grey is the number of a pixel's building, or its class; 0 for none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import QueryFault
from lodbench.photos.pictures import decoded, encoded, has_too_many_pixels
from lodbench.storage.digest import read_content

# Folders of a split's label files: of buildings, and of classes of surfaces (1 roof, 2 wall).
INSTANCES_FOLDER, CLASSES_FOLDER = "instances", "classes"
_CLASS_VALUES = "0 = neither, 1 = roof, 2 = wall"
# More buildings in one photo than this are no buildings.
_MOST = 2000
# Values of all masks of a photo together: 1 GB.
_MOST_VALUES = 2**30


def read_labels(path: Path, what: str = INSTANCES_FOLDER) -> NDArray[np.uint16]:
    """Returns the (H, W) labels of a grey PNG of 8 or 16 bits; faults name ``what`` they are.

    Raises:
        QueryFault: The file is missing, is no such picture or has too many pixels, or has more than 2000
            different values: a photo.
    """
    try:
        content = read_content(path)
    except OSError as error:
        raise QueryFault(f"{what} {path.name} cannot be read: {error.strerror}") from error
    if has_too_many_pixels(content):
        raise QueryFault(f"{what} {path.name} has too many pixels")
    labels = decoded(content, as_stored=True)
    if labels is None or labels.ndim != 2 or labels.dtype not in (np.uint8, np.uint16):
        values = "0, then one per building" if what == INSTANCES_FOLDER else _CLASS_VALUES
        raise QueryFault(f"{what} {path.name} is not a grey image of 8 or 16 bits: {values}")
    seen = np.zeros(2**16, np.bool_)
    for row in labels:  # all at once it takes eight times the picture
        seen[row] = True
    count = int(seen[1:].sum())
    if count > _MOST:
        raise QueryFault(f"{what} {path.name} has {count} labels: is it a photo?")
    return labels.astype(np.uint16)


def read_classes(path: Path) -> NDArray[np.uint8]:
    """Returns the (H, W) classes of a grey PNG: 1 for roofs, 2 for walls, 0 for all else.

    Raises:
        QueryFault: As for ``read_labels``, or there is another value.
    """
    labels = read_labels(path, CLASSES_FOLDER)
    if labels.max(initial=0) > 2:
        raise QueryFault(f"classes {path.name} hold the value {labels.max()}", _CLASS_VALUES)
    return labels.astype(np.uint8)


def encoded_labels(labels: NDArray[np.uint16]) -> bytes:
    """Returns (H, W) labels as the bytes of a PNG of 16 bits."""
    return encoded(labels, ".png")


def masks_of_labels(labels: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Returns (N, H, W) bool, the mask of each label above 0 that occurs, ascending.

    Raises:
        QueryFault: They would take more than 1 GB.
    """
    found = np.unique(labels)
    found = found[found > 0]
    if len(found) * labels.size > _MOST_VALUES:
        raise QueryFault(
            f"instances: {len(found)} masks of {labels.shape[1]} x {labels.shape[0]} are too many"
        )
    return np.asarray(labels[None] == found[:, None, None])
