"""``segmenter=masks``: masks made beforehand, from the dataset's ``masks`` folder or another one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.inputs import Input
from lodbench.datasets.own import find_mask
from lodbench.datasets.query import Entry
from lodbench.errors import QueryFault
from lodbench.photos.pictures import decoded, has_too_many_pixels
from lodbench.storage import digest_of
from lodbench.storage.digest import content_digest, read_content
from lodbench.storage.paths import require_regular

# What a mask is.
_WHITE = "A mask is a grey picture, PNG for example: buildings are white, all else is black."


def read_mask(path: str | Path) -> NDArray[np.float32]:
    """Returns an 8 or 16 bit grey image as (H, W) float32 in [0, 1]: white is building.

    Grey may be stored as RGB or RGBA with equal channels and the same alpha everywhere.

    Raises:
        QueryFault: The file is missing, is no image or has too many pixels, its channels differ
            (colours or class labels, an overlay), or its largest value is 1 (labels 0 and 1).
        DatasetError: It is a pipe or a device.
    """
    require_regular(Path(path))
    try:
        content = read_content(Path(path))
    except OSError as error:
        raise QueryFault(
            f"mask {Path(path).name} cannot be read: {error.strerror}", "Check the path."
        ) from error
    if has_too_many_pixels(content):
        raise QueryFault(f"mask {Path(path).name} has too many pixels", "Scale it down.")
    image = decoded(content, as_stored=True)
    white = {"uint8": 255, "uint16": 65535}.get(str(image.dtype)) if image is not None else None
    if image is None or white is None:
        raise QueryFault(f"mask {Path(path).name} is not a readable 8 or 16 bit image", _WHITE)
    grey = _grey(image, Path(path).name)
    if grey.max() == 1:
        raise QueryFault(f"mask {Path(path).name}: its largest value is 1; {white} means building", _WHITE)
    return np.asarray(grey, dtype=np.float32) / np.float32(white)


def _grey(image: NDArray[Any], name: str) -> NDArray[Any]:
    """Returns the one channel of a decoded image.

    Raises:
        QueryFault: Its colour channels differ, or its alpha is not the same everywhere.
    """
    if image.ndim == 2:
        return image
    colours, alpha = image[:, :, :3], image[:, :, 3:]
    if image.shape[2] == 2:
        colours, alpha = image[:, :, :1], image[:, :, 1:]
    if (colours != colours[:, :, :1]).any():
        raise QueryFault(f"mask {name} is in colour: white means building, in a grey image", _WHITE)
    if (alpha != alpha[:1, :1]).any():
        raise QueryFault(f"mask {name} has an alpha channel that varies: white means building, without alpha")
    return colours[:, :, 0]


@dataclass(frozen=True, slots=True)
class MasksParams:
    """Settings of ``segmenter=masks``.

    Attributes:
        folder: Of masks named as the photos; None for the dataset's own.
    """

    name: str = "masks"
    folder: str | None = None


class MaskFiles:
    """Reads each query's mask from the dataset."""

    params_type = MasksParams
    name = "masks"
    requires = frozenset({Input.MASK})
    provides = frozenset({Input.MASK})

    def __init__(self, params: MasksParams) -> None:
        self.params = params

    def segment(self, entry: Entry) -> NDArray[np.float32]:
        """Returns the (H, W) float32 probability of building, in [0, 1].

        Raises:
            QueryFault: There is no mask for this query, or it cannot be read.
        """
        mask = self._file(entry)
        if mask is None:
            raise QueryFault(f"no mask in {self.params.folder or 'the masks folder'}")
        return read_mask(mask)

    def fingerprint(self, entries: tuple[Entry, ...]) -> str:
        """Returns a digest of the mask files' names and contents."""
        return digest_of([[entry.key, content_digest(self._file(entry))] for entry in entries])

    def _file(self, entry: Entry) -> Path | None:
        if self.params.folder is None:
            return entry.mask
        return find_mask(Path(self.params.folder).expanduser(), entry.name, entry.image)


@dataclass(frozen=True, slots=True)
class NoMaskParams:
    """Settings of ``segmenter=none``: none."""

    name: str = "none"


class NoMask:
    """Makes no mask."""

    params_type = NoMaskParams
    name = "none"
    requires: frozenset[Input] = frozenset()
    provides: frozenset[Input] = frozenset()

    def __init__(self, params: NoMaskParams) -> None:
        self.params = params

    def segment(self, entry: Entry) -> NDArray[np.float32]:
        """Never answers.

        Raises:
            QueryFault: Always.
        """
        raise QueryFault("segmenter=none makes no masks")

    def fingerprint(self, entries: tuple[Entry, ...]) -> str:
        """Returns nothing: there is nothing that answers could depend on."""
        return ""
