"""``segmenter=masks``: masks made beforehand, read from the dataset's ``masks`` folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.query import Entry
from lodbench.errors import QueryFault
from lodbench.storage import digest_of, file_digest


def read_mask(path: str | Path) -> NDArray[np.float32]:
    """Returns an 8 or 16 bit grey image as (H, W) float32 in [0, 1]: white is building.

    Raises:
        QueryFault: The file is missing or is no image.
    """
    import cv2

    # Read through numpy: OpenCV's own file call cannot open every path on every system.
    try:
        content = np.frombuffer(Path(path).read_bytes(), dtype=np.uint8)
    except OSError as error:
        raise QueryFault(f"mask {Path(path).name} cannot be read: {error.strerror}") from error
    image = cv2.imdecode(content, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH) if len(content) else None
    white = {"uint8": 255, "uint16": 65535}.get(str(image.dtype)) if image is not None else None
    if image is None or white is None:
        raise QueryFault(f"mask {Path(path).name} is not a readable 8 or 16 bit image")
    return np.asarray(np.asarray(image, dtype=np.float32) / np.float32(white), dtype=np.float32)


@dataclass(frozen=True, slots=True)
class MasksParams:
    """Settings of ``segmenter=masks``: none."""

    name: str = "masks"


class MaskFiles:
    """Reads each query's mask from the dataset."""

    params_type = MasksParams
    name = "masks"

    def __init__(self, params: MasksParams) -> None:
        self.params = params

    def segment(self, entry: Entry) -> NDArray[np.float32]:
        """Returns the (H, W) float32 probability of building, in [0, 1].

        Raises:
            QueryFault: There is no mask for this query, or it cannot be read.
        """
        if entry.mask is None:
            raise QueryFault("no mask in the masks folder")
        return read_mask(entry.mask)

    def fingerprint(self, entries: tuple[Entry, ...]) -> str:
        """Returns a digest of the mask files' names and contents."""
        return digest_of([[entry.key, file_digest(entry.mask) if entry.mask else None] for entry in entries])
