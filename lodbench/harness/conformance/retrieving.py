"""Rules of what describes whole pictures."""

from __future__ import annotations

import numpy as np

from lodbench.harness.conformance.trial import Rules, Tried, require
from lodbench.segmentation.photos import read_photo


def retrieval_rules(tried: Tried) -> Rules:
    """Returns the rules of a retrieval."""
    photos = np.stack([read_photo(entry.image) for entry in tried.entries if entry.image is not None])

    def described() -> str:
        given = photos.copy()
        found = tried.make().describe(given)
        require(
            isinstance(found, np.ndarray) and found.dtype == np.float32, "describe returns float32 arrays"
        )
        require(found.ndim == 2 and len(found) == len(photos), f"{len(photos)} pictures give {found.shape}")
        lengths = np.linalg.norm(found, axis=1)
        require(np.allclose(lengths, 1.0, atol=1e-3), f"descriptors have lengths {lengths.round(3).tolist()}")
        require(np.array_equal(given, photos), "the pictures were written to", "Work on a copy.")
        return f"{found.shape[1]} numbers, of length 1"

    def same_again() -> str:
        found = tried.make().describe(photos)
        require(np.array_equal(found, tried.make().describe(photos)), "another descriptor the second time")
        alone = np.concatenate([tried.make().describe(photo[None]) for photo in photos])
        require(np.allclose(alone, found, atol=1e-4), "another descriptor beside other pictures")
        return "made anew, and picture by picture"

    def found_again() -> str:
        found = tried.make().describe(photos)
        darker = tried.make().describe((0.8 * photos).astype(np.uint8))
        nearest = np.argmax(darker @ found.T, axis=1)
        require(
            np.array_equal(nearest, np.arange(len(photos))), "a darker picture resembles another one more"
        )
        return "a darker picture resembles itself most"

    return [("describe", described), ("same again", same_again), ("found again", found_again)]
