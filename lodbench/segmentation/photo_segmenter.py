"""What all segmenters share that look at photos: reading, working size, cache, fingerprint, notes."""

from __future__ import annotations

import hashlib
import io
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench import kernels
from lodbench.datasets.inputs import Input, declared_inputs
from lodbench.datasets.query import Entry
from lodbench.errors import ConfigError, QueryFault
from lodbench.geometry import Camera
from lodbench.segmentation.masks import photo_of, read_photo
from lodbench.segmentation.probability import probability_of
from lodbench.segmentation.protocol import Segmenter, check_mask
from lodbench.segmentation.registry import FOR_PHOTOS
from lodbench.storage import digest_of, make_folder, write_bytes
from lodbench.storage.digest import content_digest, digest_of_code, read_content
from lodbench.storage.paths import cache_root

_LOGGER = logging.getLogger(__name__)
Probability = NDArray[np.float32]
_FOLDER = "segmentations"
# What runs networks, and brings photos to their size; those of extras need not be there.
_LIBRARIES = ("numpy", "opencv-python-headless", "torch", "transformers")


def cached_probability(photo: Path, identity: str, compute: Callable[[bytes], Probability]) -> Probability:
    """Returns the probability of a photo: from the cache, or computed and put there.

    What is computed passes through the cache's 16 bits as well, so that a second run gives the same
    bytes as the first; a cache that cannot be written is no fault.

    Args:
        photo: The photo's file; its content counts, not its name.
        identity: Digest of all else it follows from, but our code: network, weights, size, normalisation.
        compute: Returns (H, W) float32 in [0, 1] of the content of the photo's file.

    Raises:
        OSError: The photo cannot be read.
        InputChanged: It is not what it was when the work began.
    """
    photo_content = read_content(photo)
    name = digest_of([hashlib.sha256(photo_content).hexdigest(), identity, _code_digest()], length=32)
    path = cache_root() / _FOLDER / f"{name}.npz"
    stored = _read(path)
    if stored is None:
        stored = np.rint(compute(photo_content) * 65535.0).astype(np.uint16)
        content = io.BytesIO()
        np.savez_compressed(content, probability=stored)
        try:
            make_folder(path.parent)
            write_bytes(path, content.getvalue())
        except OSError:
            pass  # a read-only cache or a full disk costs time, not the answer
    return stored.astype(np.float32) / np.float32(65535)


def _read(path: Path) -> NDArray[np.uint16] | None:
    """Returns what is stored, or None where there is nothing that can be read."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            stored = archive["probability"]
    except FileNotFoundError:
        return None
    except Exception as error:  # numpy, zipfile and zlib raise anything over a damaged file
        _LOGGER.warning("The mask kept in %s is damaged (%s): it is made anew.", path, error)
        return None
    return np.asarray(stored) if stored.dtype == np.uint16 and stored.ndim == 2 else None


@cache
def _code_digest() -> str:
    """Returns a digest of the code that makes masks: other code makes its own."""
    files = [*sorted(Path(__file__).parent.rglob("*.py")), Path(kernels.__file__).with_name("estimation.py")]
    return digest_of_code(files, _LIBRARIES)


# A change of how photos are read or brought to size makes another answer.
_VERSION = 1


class PhotoSegmenter(ABC):
    """Segments a query's photo with a network.

    Args:
        params: Settings of the segmenter, a frozen dataclass with ``name`` and ``normalise``.
    """

    requires = frozenset({Input.IMAGE})
    provides = frozenset({Input.MASK})

    def __init__(self, params: Any) -> None:
        self.params = params
        self.name: str = params.name

    @property
    @abstractmethod
    def weights_digest(self) -> str:
        """Returns the SHA-256 of the weights, or ``random``."""

    @abstractmethod
    def logits(self, photo: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Returns (h, w) logits of a (H, W, 3) uint8 RGB photo, at the working size.

        Raises:
            QueryFault: This photo cannot be segmented.
        """

    def notes(self) -> tuple[str, ...]:
        """Returns what a reader of the results must know about the network."""
        return ()

    def segment(self, entry: Entry) -> NDArray[np.float32]:
        """Returns the (h, w) float32 probability of building, in [0, 1], at the working size.

        Raises:
            QueryFault: The query has no photo, or it cannot be read.
        """
        return self.cached(entry, self.probability)

    def cached(
        self,
        entry: Entry,
        compute: Callable[[NDArray[np.uint8]], NDArray[np.float32]],
        idle: Collection[str] = (),
    ) -> NDArray[np.float32]:
        """Returns what is computed of a query's (H, W, 3) RGB photo, or was in an earlier run.

        Args:
            entry: The query.
            compute: Returns (h, w) float32 in [0, 1] of the photo.
            idle: Settings that make no difference to it.

        Raises:
            QueryFault: The query has no photo, or it cannot be read.
        """
        if entry.image is None:
            raise QueryFault("no photo to segment")
        name = entry.image.name
        try:
            return cached_probability(
                entry.image, self._identity(idle), lambda content: compute(photo_of(content, name))
            )
        except OSError as error:
            raise QueryFault(f"photo {name} cannot be read: {error.strerror}") from error

    def probability(self, photo: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Returns the (h, w) float32 probability of building of a (H, W, 3) RGB photo."""
        return probability_of(self.logits(photo), self.params.normalise)

    def fingerprint(self, entries: tuple[Entry, ...]) -> str:
        """Returns a digest of the photos' contents, the settings and the weights."""
        return digest_of([self._identity(), [[entry.key, content_digest(entry.image)] for entry in entries]])

    def _identity(self, idle: Collection[str] = ()) -> str:
        settings = {k: v for k, v in asdict(self.params).items() if k not in ("weights", *idle)}
        return digest_of([_VERSION, settings, self.weights_digest], length=32)


def require_photo_segmenter(segmenter: Segmenter) -> Segmenter:
    """Returns a segmenter that looks at a photo and at nothing else, a plug-in's perhaps.

    Raises:
        ConfigError: It looks at something else.
    """
    if declared_inputs(segmenter, "requires") != {Input.IMAGE}:
        hint = f"`--segmenter {FOR_PHOTOS}` does, and any other that requires the image alone."
        raise ConfigError(f"segmenter {segmenter.name} looks at no photo alone.", hint)
    return segmenter


def photo_probability(segmenter: Segmenter, photo: Path) -> NDArray[np.float32]:
    """Returns the (h, w) probability of building that a segmenter finds in a photo; not from our cache.

    Raises:
        QueryFault: The photo cannot be read, or the answer is no such array of its aspect.
    """
    pixels = read_photo(photo)
    if isinstance(segmenter, PhotoSegmenter):
        return segmenter.probability(pixels)
    height, width = pixels.shape[:2]
    camera = Camera(width, height, width, width, width / 2, height / 2)  # of which the size alone is used
    return check_mask(segmenter.segment(Entry(photo.name, "", camera, None, photo, None)), camera)
