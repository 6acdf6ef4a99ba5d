"""Photos with masks traced by hand, as training views among drawn ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from lodbench.datasets.traced_photos import traced_photos
from lodbench.errors import DatasetError, LodbenchError
from lodbench.segmentation.masks import read_mask
from lodbench.segmentation.photos import read_photo
from lodbench.training.samples import Sample


def traced_samples(size: int, folders: Sequence[Path]) -> list[Sample]:
    """Returns the photos of some folders with their masks; what a mask shows grey is learnt as undecided.

    Args:
        size: Long side that a network works at, pixels.
        folders: As of ``traced_photos``.

    Raises:
        DatasetError: A folder holds no photos, or one has no mask, one of another size or none to be read.
    """
    samples = []
    for number, folder in enumerate(folders):
        for photo, mask in traced_photos(folder):
            key = f"traced{number}/{photo.parent.parent.name}/{photo.name}"
            try:
                shape = read_mask(mask).shape
                fits = shape == read_photo(photo).shape[:2]
            except LodbenchError as fault:
                raise DatasetError(f"{key}: {fault.message}") from fault
            if not fits:
                raise DatasetError(f"{mask} is not of its photo's size.", "Trace the photo as it is stored.")
            samples.append(Sample(key, photo, mask, working_scale=size / max(shape)))
    return samples


def repeated(samples: list[Sample], share: float, others: int) -> list[Sample]:
    """Returns few views so often, at least once each, that they are a share of an epoch with so many others.

    Each time they are cropped and changed another way.
    """
    if not samples:
        return []
    times = max(1, round(share / (1 - share) * others / len(samples)))
    return [replace(sample, key=f"{sample.key}#{time}") for time in range(times) for sample in samples]
