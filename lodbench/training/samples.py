"""The views a network learns from: found in training sets, read, and turned into arrays; photos as views.

Photos are traced by hand, without masks, or posed over a map. Without masks: those without buildings, and
those that a network labels. Self-training as in Lee's pseudo-labels (ICML 2013 workshop); where the teacher
is unsure, the label is grey and pulls neither way.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.cache import open_cached_city
from lodbench.citymodel.crs import is_same_plane
from lodbench.citymodel.scene import ROOF, WALL
from lodbench.datasets.faults import aspect_fault, mask_fault
from lodbench.datasets.folder import ABOUT_FILE, TRUTH_FILE, FolderParams, open_folder
from lodbench.datasets.inputs import read_classes, read_labels
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import ConfigError, DatasetError, LodbenchError, require_choice, require_within
from lodbench.execution import Progress
from lodbench.geometry import Camera, Pose
from lodbench.photos.files import PHOTO_SUFFIXES, traced_photos
from lodbench.photos.pictures import encoded, encoded_mask, picture_size, read_picture
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.segmentation.masks import read_mask, read_photo
from lodbench.segmentation.packaged import interiors
from lodbench.segmentation.photo_segmenter import PhotoSegmenter
from lodbench.segmentation.probability import resized_photo, working_size
from lodbench.storage import digest_of, make_folder, write_bytes
from lodbench.storage.digest import file_check

Photo = NDArray[np.uint8]
# What a network may learn: where buildings are; from their labels, what lies well within one of them; from
# those of surfaces, roofs and walls.
MASKS, INTERIORS, CLASSES = "masks", "interiors", "classes"
_FOLDERS = {MASKS: "masks", INTERIORS: "labels", CLASSES: "classes"}
SETTINGS = {INTERIORS: "labels", CLASSES: "classes"}
_READERS: dict[str, Callable[[Path], NDArray[Any]]] = {INTERIORS: read_labels, CLASSES: read_classes}
_HELD_OUT = 20
# Of views to validate on those with fewer buildings say little: one wrong shed halves their IoU.
LEAST_SHARE = 0.05


@dataclass(frozen=True, slots=True)
class Sample:
    """One picture and its mask."""

    key: str  # set, split and name: unique
    photo: Path  # the picture's file
    mask: Path  # the mask's file; that of the labels of single buildings, or surfaces, where these are learnt
    is_ground: bool = False  # whether it is a photo without buildings, whose ground may lie elsewhere as well
    # of a photo with a mask traced by hand: what brings it to the size a network works at. Crops are cut
    # from all of its pixels, at this times their own scale.
    working_scale: float | None = None
    # ``masks``, ``interiors`` or ``classes``
    learns: str = MASKS  # ``masks`` or ``interiors``

    def read(self, size: int, square: bool) -> tuple[Photo, NDArray[np.float32]]:
        """Returns the picture (H, W, 3) RGB uint8 and the mask (H, W) float32 in [0, 1].

        Where classes are learnt it is (H, W, 2): roofs and walls.

        Args:
            size: Long side to bring them to; 0 for as they are.
            square: Whether the other side becomes as long, whatever the aspect.

        Raises:
            DatasetError: One of them cannot be read, or their aspects differ.
        """
        try:
            photo = read_photo(self.photo)
            mask = _READERS.get(self.learns, read_mask)(self.mask)
        except LodbenchError as fault:
            raise DatasetError(f"{self.key}: {fault.message}") from fault
        height, width = photo.shape[:2]
        if fault_of_size := aspect_fault((mask.shape[1], mask.shape[0]), (width, height)):
            raise DatasetError(f"{self.key}: {fault_of_size}")
        if size:
            factor = size / max(height, width)
            height, width = max(1, round(height * factor)), max(1, round(width * factor))
            height, width = (size, size) if square else (height, width)
        photo = resized_photo(photo, width, height)
        if self.learns == INTERIORS:
            labels = cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST)
            return photo, interiors(labels).astype(np.float32)
        if self.learns == CLASSES:
            mask = np.stack([mask == ROOF, mask == WALL], axis=2).astype(np.float32)
        return photo, resized_photo(mask, width, height)


def find_samples(folder: Path, split: str, learns: str = MASKS) -> list[Sample]:
    """Returns the views of a split in a training set or in the sets below a folder, by name.

    Args:
        folder: Of one set, or of several.
        split: ``train``, ``val`` or ``test``.
        learns: ``masks``, or ``interiors`` of the labels of single buildings, or ``classes``.

    Raises:
        DatasetError: The folder is missing, or a picture cannot be read, has no mask, or no labels, or a mask
            of another aspect, or shares it with another picture.
    """
    if not folder.is_dir():
        raise DatasetError(f"There is no folder {folder}.", "lodbench generate-training-data makes one.")
    samples, without = [], []
    for images in sorted(path for path in folder.rglob("images") if path.parent.name == split):
        for photo in sorted(path for path in images.iterdir() if path.suffix.lower() in PHOTO_SUFFIXES):
            mask = images.parent / _FOLDERS[learns] / f"{photo.stem}.png"
            if mask.exists():
                key = (images.parent.relative_to(folder) / photo.stem).as_posix()
                samples.append(Sample(key, photo, mask, learns=learns))
            else:
                without.append(photo)
    if without:
        hint = "An unfinished set: give the generate-training-data command again, it goes on."
        if learns in SETTINGS:
            hint = f"generate-training-data `{SETTINGS[learns]}=true` writes them."
        lacking, first = _FOLDERS[learns], without[0].name
        raise DatasetError(
            f"{len(without)} pictures in {folder} have no {lacking}, the first is {first}.", hint
        )
    _require_fitting(samples)
    return samples


def _require_fitting(samples: list[Sample]) -> None:
    """Makes sure, by the headers of files, that each picture has a mask of its own and of its aspect."""
    photos: dict[Path, Path] = {}
    for sample in samples:
        other = photos.setdefault(sample.mask, sample.photo)
        if other != sample.photo:
            raise DatasetError(f"{other} and {sample.photo.name} share a name: their masks would be one.")
        size = picture_size(sample.photo)
        # OpenCV decodes some whose headers Pillow cannot read, as PNGs with a damaged comment.
        if size is None and read_picture(sample.photo) is None:
            raise DatasetError(
                f"The photo {sample.photo} cannot be read.", "Make it anew, or remove it and its mask."
            )
        fault = mask_fault(sample.mask, size) if size is not None else ""
        if fault:
            raise DatasetError(f"{sample.photo}: {fault}.", "Is it this picture's?")


def split_samples(
    train: list[Sample], val: list[Sample], val_data: Path | None, learns: str = MASKS
) -> tuple[list[Sample], list[Sample], str]:
    """Returns the views to train on, those to validate on, and what the latter are.

    Args:
        train: Views to train on.
        val: Views of the same data that are held out; where there are none, every 20th of ``train`` is.
        val_data: A set whose views validate instead.
        learns: As for ``find_samples``.

    Raises:
        DatasetError: There are none of one kind.
        ConfigError: Views of ``val_data`` are trained on.
    """
    if val_data is not None:
        val = [s for split in ("train", "val", "test") for s in find_samples(val_data, split, learns)]
        require_unseen([sample.photo for sample in train], [sample.photo for sample in val])
        source = f"views of {val_data.name}"
    else:
        source = "val views, of regions of their own"
        if not val:
            val, train = train[::_HELD_OUT], [s for k, s in enumerate(train) if k % _HELD_OUT]
            source = f"every {_HELD_OUT}th training view, held out: of the same regions"
    if not train or not val:
        if len(val) == 1 and val_data is None:
            raise DatasetError(
                "One view is too few: some are trained on, others validate.",
                "lodbench generate-training-data makes more, or `val_data=SET` names others to validate on.",
            )
        kind = "train on" if not train else "validate on"
        raise DatasetError(f"There are no views to {kind}.", "lodbench generate-training-data makes some.")
    return train, val, source


def require_unseen(train: list[Path], val: list[Path]) -> None:
    """Makes sure that no view that validates is trained on as well; both by their photos.

    Raises:
        ConfigError: One is: its IoU would be reported as that of views the network was never trained on.
    """
    learnt = {photo.resolve() for photo in train}
    both = [photo for photo in val if photo.resolve() in learnt]
    if both:
        raise ConfigError(
            f"{len(both)} of the {len(val)} views of val_data are trained on, the first is {both[0]}.",
            "`val_data=SET` of other views; without it the val views of data validate.",
        )


def samples_digest(samples: list[Sample]) -> str:
    """Returns a digest of the views: names and contents, each file read once however often it is learnt."""
    content = cache(file_check)
    return digest_of([[s.key, content(s.photo), content(s.mask)] for s in samples])


_CHOICES = {
    "weighting": ("paper", "released"),
    "precision": ("auto", "float32", "bfloat16"),
    "augment": ("full", "flips", "strong"),
    "optimizer": ("adamw", "muon"),
}
_BOUNDS = {
    "epochs": (1, 100_000),
    "lr": (1e-12, 10.0),
    "muon_lr": (1e-12, 10.0),
    "encoder_rate": (0.0, 10.0),
    "lr_end": (0.0, 10.0),
    "warmup": (0.0, 0.9),
    "weight_decay": (0.0, 10.0),
    "batch": (1, 4096),
    "one_band": (0.0, 1.0),
    "traced_share": (0.0, 0.95),
    "size": (0, 8192),
    "crop": (0, 8192),
    "scale": (0.1, 10.0),
    "val_every": (1, 100_000),
    "threads": (1, 1024),
}


@dataclass(frozen=True, slots=True)
class TrainParams:
    """How a network is trained, setting by setting as ``conf/train.yaml`` and ``conf/schedule`` say.

    The defaults are the paper's.

    Raises:
        ConfigError: A value is out of range; the message names it.
    """

    data: str
    val_data: str | None = None
    city: str | None = None
    unlabelled: tuple[str, ...] = ()
    negatives: tuple[str, ...] = ()
    traced: tuple[str, ...] = ()
    traced_share: float = 0.3
    out: str = "training"
    epochs: int = 20
    optimizer: str = "adamw"
    lr: float = 1e-3
    muon_lr: float = 0.02
    encoder_rate: float = 1.0
    lr_end: float = 1e-7
    warmup: float = 0.0
    weight_decay: float = 5e-4
    batch: int = 12
    size: int = 1024
    crop: int = 0
    scale: tuple[float, float] = (1.0, 1.0)
    augment: str = "flips"
    one_band: float = 0.0
    weighting: str = "paper"
    precision: str = "auto"
    device: str = "auto"
    threads: int | None = None
    seed: int = 0
    val_every: int = 1
    resume: bool = True
    init: str | None = None
    average: tuple[str, ...] = ()
    tensorboard: bool = False

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            require_choice(name, getattr(self, name), choices)
        for name, (low, high) in _BOUNDS.items():
            require_within(name, getattr(self, name), low, high)
        if self.scale[0] > self.scale[1]:
            raise ConfigError(
                f"scale=[{self.scale[0]:g},{self.scale[1]:g}] is no ascending range.", "`scale=[LOW,HIGH]`"
            )
        if self.unlabelled and self.init is None:
            raise ConfigError(
                "unlabelled photos need a network that labels them.", "`init=FILE.onnx`, or package."
            )
        if self.size == self.crop == 0:
            raise ConfigError("size and crop are both 0.", "Views differ in size: set one of them.")


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
