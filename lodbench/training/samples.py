"""The views a network learns from: found in training sets, read, and turned into arrays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import ROOF, WALL
from lodbench.datasets.faults import aspect_fault, mask_fault
from lodbench.datasets.inputs import read_classes, read_labels
from lodbench.errors import ConfigError, DatasetError, LodbenchError, require_choice, require_within
from lodbench.photos.files import PHOTO_SUFFIXES
from lodbench.photos.pictures import picture_size, read_picture
from lodbench.segmentation.compact import interiors
from lodbench.segmentation.masks import read_mask, read_photo
from lodbench.segmentation.probability import resized_photo
from lodbench.storage import digest_of
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
    """One picture and its mask.

    Attributes:
        key: Set, split and name: unique.
        photo: The picture's file.
        mask: The mask's file; that of the labels of single buildings, or surfaces, where these are learnt.
        is_ground: Whether it is a photo without buildings, whose ground may lie elsewhere as well.
        working_scale: Of a photo with a mask traced by hand: what brings it to the size a network works at.
            Crops are cut from all of its pixels, at this times their own scale.
        learns: ``masks``, ``interiors`` or ``classes``.
    """

    key: str
    photo: Path
    mask: Path
    is_ground: bool = False
    working_scale: float | None = None
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
