"""Photos without masks as training views: those without buildings, and those that a network labels.

Self-training as in Lee's pseudo-labels (ICML 2013 workshop); where the teacher is unsure, the label is grey
and pulls neither way.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.photo_files import PHOTO_SUFFIXES
from lodbench.datasets.pictures import encoded
from lodbench.errors import DatasetError
from lodbench.execution import Progress
from lodbench.segmentation.photo_segmenter import PhotoSegmenter
from lodbench.segmentation.photos import read_photo
from lodbench.segmentation.working_size import resized_photo, working_size
from lodbench.storage import make_folder, write_bytes
from lodbench.training.samples import Sample

Photo = NDArray[np.uint8]
# Of the working size: at which empty ground is learnt.
_GROUND_SCALES = (1.0, 1.5)


def pseudo_samples(segmenter: PhotoSegmenter, folders: Sequence[Path], out: Path) -> list[Sample]:
    """Returns the photos below some folders, at the segmenter's working size, with what it finds as masks.

    Args:
        segmenter: The teacher; its settings have ``size``.
        folders: Of photos; all below them count.
        out: Folder for the reduced photos and the masks, grey where the teacher is unsure.

    Raises:
        LodbenchError: A folder holds no photos, one cannot be read, or the teacher has no weights.
    """

    def labelled(photo: Photo, scale: float) -> tuple[Photo, Photo]:
        small = _reduced(photo, segmenter.params.size)
        label = segmenter.probability(photo)
        return small, np.rint(255 * label).astype(np.uint8)

    return _written(folders, out, (1.0,), labelled)


def ground_samples(size: int, folders: Sequence[Path], out: Path) -> list[Sample]:
    """Returns the photos below some folders as views without any building, each at two sizes.

    Args:
        size: Long side that a network works at, pixels.
        folders: Of photos without buildings; all below them count.
        out: Folder for the reduced photos and their black masks.

    Raises:
        LodbenchError: A folder holds no photos, or one cannot be read.
    """

    def empty(photo: Photo, scale: float) -> tuple[Photo, Photo]:
        small = _reduced(photo, round(scale * size))
        return small, np.zeros(small.shape[:2], np.uint8)

    return [replace(sample, is_ground=True) for sample in _written(folders, out, _GROUND_SCALES, empty)]


def _reduced(photo: Photo, size: int) -> Photo:
    return resized_photo(photo, *working_size(photo.shape[1], photo.shape[0], size))


def _names(folders: Sequence[Path]) -> list[str]:
    """Returns a name of its own for each folder."""
    names = [folder.resolve().name for folder in folders]
    return [name if names.count(name) == 1 else f"{name}~{k}" for k, name in enumerate(names)]


def _written(
    folders: Sequence[Path],
    out: Path,
    scales: Sequence[float],
    view: Callable[[Photo, float], tuple[Photo, Photo]],
) -> list[Sample]:
    """Returns the views made of each photo below some folders, their pictures and masks written."""
    samples = []
    for folder, name in zip(folders, _names(folders), strict=True):
        photos = sorted(path for path in folder.rglob("*") if path.suffix.lower() in PHOTO_SUFFIXES)
        if not photos:
            raise DatasetError(f"{folder} holds no photos to learn from.", "Name a folder of photos.")
        with Progress(f"photos of {folder.name}", len(photos)) as progress:
            for path in photos:
                for number, scale in enumerate(scales):
                    key = f"{name}/{path.relative_to(folder)}_{number}"
                    picture, mask = view(read_photo(path), scale)
                    files = [out / kind / f"{key}.png" for kind in ("images", "masks")]
                    for file, image in zip(files, (picture[..., ::-1], mask), strict=True):
                        make_folder(file.parent)
                        write_bytes(file, encoded(image, ".png"))
                    samples.append(Sample(f"{out.name}/{key}", files[0], files[1]))
                progress.advance()
    return samples
