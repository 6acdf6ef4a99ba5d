"""Masks kept by content: same photo, weights, code and size, and the mask is read, not computed."""

from __future__ import annotations

import hashlib
import io
import logging
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.storage import digest_of, make_folder, write_bytes
from lodbench.storage.contents import read_content
from lodbench.storage.digest import digest_of_code
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
    return digest_of_code(sorted(Path(__file__).parent.rglob("*.py")), _LIBRARIES)
