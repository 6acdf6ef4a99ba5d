"""Photos as training views: traced by hand, without masks, or posed over a map.

Photos without masks as training views: those without buildings, and those that a network labels. Self-
training as in Lee's pseudo-labels (ICML 2013 workshop); where the teacher is unsure, the label is grey and
pulls neither way.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.cache import open_cached_city
from lodbench.citymodel.crs import is_same_plane
from lodbench.datasets.folder import ABOUT_FILE, TRUTH_FILE, FolderParams, open_folder
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import DatasetError, LodbenchError
from lodbench.execution import Progress
from lodbench.geometry import Camera, Pose
from lodbench.photos.files import PHOTO_SUFFIXES, traced_photos
from lodbench.photos.pictures import encoded, encoded_mask
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.segmentation.masks import read_mask, read_photo
from lodbench.segmentation.photo_segmenter import PhotoSegmenter
from lodbench.segmentation.probability import resized_photo, working_size
from lodbench.storage import make_folder, write_bytes
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


_LOGGER = logging.getLogger(__name__)
# Silhouettes are drawn at most so wide: networks look at less.
_WIDTH = 1024


@dataclass(frozen=True, slots=True)
class _Posed:
    """A photo that can be learnt from."""

    entry: Entry
    photo: Path
    camera: Camera
    pose: Pose


def is_posed(folder: Path) -> bool:
    """Returns whether a folder is a dataset of posed photos, as ``dataset=folder`` has it."""
    return any(
        (place / name).is_file()
        for place in (folder, *(child for child in folder.glob("*") if child.is_dir()))
        for name in (TRUTH_FILE, ABOUT_FILE)
    )


def posed_samples(folder: Path, out: Path, city: str | None = None) -> list[Sample]:
    """Returns the photos of a dataset that have a truth, each with the map's silhouette there as its mask.

    The map is taken at its finest level. A mask is as good as the photo's pose and as the map: what was built
    or torn down since is learnt wrong.

    Args:
        folder: As for ``open_folder``.
        out: Folder for the silhouettes, one PNG a photo.
        city: City model; None for the one that ``dataset.json`` names.

    Raises:
        LodbenchError: The dataset is missing or broken, has no city model, no photo with camera and true
            pose, or a camera with lens distortion; or the map lies elsewhere, so that all would be taught
            to be empty.
    """
    dataset = open_folder(FolderParams(root=str(folder), city_model=city, lod="finest"))
    if dataset.city_model is None:
        raise DatasetError(
            f"{folder} has no city model: there is nothing to make labels of.",
            dataset.city_hint.replace("Set `city=FILE`.", "`city=FILE` names one."),
        )
    posed = _posed(dataset)
    if not posed:
        raise DatasetError(f"{folder} holds no photo with a camera and a true pose.")
    scene = open_cached_city(dataset.city_model, lod=dataset.lod, options=dataset.city_options).scene
    if dataset.crs is not None and scene.crs is not None and not is_same_plane(dataset.crs, scene.crs):
        raise DatasetError(
            f"The poses of {folder} are in {dataset.crs}, its map {dataset.city_model} in {scene.crs}.",
            "`city=FILE` names the one it was made with.",
        )
    renderer, samples, shows_any = SilhouetteRenderer(scene, threads=1), [], False
    with Progress("silhouettes", len(posed)) as progress:
        for known in posed:
            mask = out / f"{known.entry.key}.png"
            size = min(_WIDTH, known.camera.width)
            camera = known.camera.scaled_to_width(size)
            try:
                silhouette = renderer.render(camera, known.pose.shifted(-scene.origin))
            except LodbenchError as fault:
                raise DatasetError(f"{known.entry.key}: {fault.message.marked}", fault.hint) from fault
            shows_any |= bool(silhouette.any())
            make_folder(mask.parent)
            write_bytes(mask, encoded_mask(silhouette, bilevel=True))
            samples.append(Sample(known.entry.key, known.photo, mask))
            progress.advance()
    if not shows_any:
        raise DatasetError(
            f"The map {dataset.city_model} shows no building from any true pose of {folder}.",
            "Is it the right tile, and its reference system right? lodbench city info says where it is.",
        )
    return samples


def _posed(dataset: Dataset) -> list[_Posed]:
    """Returns the entries that have all that a label takes; says of how many something is missing."""
    posed, lacking = [], []
    for entry in dataset.entries:
        pose = dataset.truth.get(entry.key)
        if entry.image is None or entry.camera is None or pose is None:
            lacks = {"photo": entry.image, "camera": entry.camera, "true pose": pose}
            named = " and ".join(f"no {what}" for what, value in lacks.items() if value is None)
            lacking.append(f"{entry.key} has {named}")
        else:
            posed.append(_Posed(entry, entry.image, entry.camera, pose))
    if posed and lacking:
        what = f"{len(lacking)} of {len(dataset.entries)} photos of {dataset.root} cannot be learnt from"
        _LOGGER.warning("%s: %s%s", what, lacking[0], ", ..." if len(lacking) > 1 else "")
    return posed
