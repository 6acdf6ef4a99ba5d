"""Posed photos over a map as a training set: the silhouettes at the true poses are the labels."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

from lodbench.citymodel.cache import open_cached_city
from lodbench.citymodel.crs import is_same_plane
from lodbench.datasets.folder import TRUTH_FILE, FolderParams, open_folder
from lodbench.datasets.folder_about import ABOUT_FILE
from lodbench.datasets.pictures import encoded_mask
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import DatasetError, LodbenchError
from lodbench.execution import Progress
from lodbench.geometry import Camera, Pose
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.storage import make_folder, write_bytes
from lodbench.training.samples import Sample

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
    """Tells whether a folder is a dataset of posed photos, as ``dataset=folder`` has it."""
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
            dataset.city_hint.replace("Set city=FILE.", "city=FILE names one."),
        )
    posed = _posed(dataset)
    if not posed:
        raise DatasetError(f"{folder} holds no photo with a camera and a true pose.")
    scene = open_cached_city(dataset.city_model, lod=dataset.lod, options=dataset.city_options).scene
    if dataset.crs is not None and scene.crs is not None and not is_same_plane(dataset.crs, scene.crs):
        raise DatasetError(
            f"The poses of {folder} are in {dataset.crs}, its map {dataset.city_model} in {scene.crs}.",
            "city=FILE names the one it was made with.",
        )
    renderer, samples, shows_any = SilhouetteRenderer(scene, threads=1), [], False
    with Progress("silhouettes", len(posed)) as progress:
        for known in posed:
            mask = out / f"{known.entry.key}.png"
            size = min(_WIDTH, known.camera.width)
            camera = known.camera.scaled(size, max(1, round(size * known.camera.height / known.camera.width)))
            try:
                silhouette = renderer.render(camera, known.pose.shifted(-scene.origin))
            except LodbenchError as fault:
                raise DatasetError(f"{known.entry.key}: {fault.message}", fault.hint) from fault
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
