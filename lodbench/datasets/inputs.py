"""What a method or a segmenter may need of a dataset, what is missing, posed pictures, and label files.

Labels are pictures whose grey is the number of a pixel's building, or its class; 0 for none.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.pose_text import read_cameras, read_poses
from lodbench.datasets.query import Dataset, Entry, Reference
from lodbench.errors import ConfigError, DatasetError, QueryFault, nearest_names
from lodbench.photos.pictures import decoded, encoded, has_too_many_pixels
from lodbench.storage.digest import read_content


class Input(StrEnum):
    """What may be needed besides the camera, the prior and the city.

    Attributes:
        MASK: Probability of building at each pixel. Of a dataset: masks made beforehand.
        INSTANCES: A mask of each building in the photo. Of a dataset: labels made beforehand.
        CLASSES: Roof, wall or neither at each pixel. Of a dataset: labels made beforehand.
        MASK_ON_DEMAND: Such a mask where the method calls ``Query.segment``, and only then.
        IMAGE: The photo.
        REFERENCES: Posed pictures of the place.
        TEXTURED_MAP: A city model with photographed surfaces.
        TILT: Pitch and roll of the prior, measured and not just assumed.
        HEIGHT: The prior's height, likewise.
        RECONSTRUCTION: The photo's pose in a reconstruction of its flight; one that has it needs no mask.
        TRUE_PIXELS: Where points are in the photo in truth: what bounds of methods are made from.
        MAP: Of a segmenter: the city and the query's prior, beside the photo.
    """

    MASK = "mask"
    INSTANCES = "instances"
    CLASSES = "classes"
    MASK_ON_DEMAND = "mask_on_demand"
    IMAGE = "image"
    REFERENCES = "references"
    TEXTURED_MAP = "textured_map"
    TILT = "tilt"
    HEIGHT = "height"
    RECONSTRUCTION = "reconstruction"
    TRUE_PIXELS = "true_pixels"
    MAP = "map"


# What each is called, and how to give it.
_WORDS = {
    Input.MASK: ("masks", "Put them in each split's folder masks (255 = building), named as the photos."),
    Input.INSTANCES: (
        "a mask of each building",
        "Put labels (0 = none, one value per building) in each split's folder instances, or name a segmenter "
        "that makes them: `segmenter=NAME`.",
    ),
    Input.CLASSES: (
        "masks of roofs and walls",
        "Put labels (0 = neither, 1 = roof, 2 = wall) in each split's folder classes, or name a segmenter "
        "that makes them: `segmenter=NAME`.",
    ),
    Input.MASK_ON_DEMAND: ("what makes masks", "Name a segmenter that makes them: `segmenter=NAME`."),
    Input.IMAGE: (
        "photos",
        "Put them in Query_image; "
        "`method=contour_alignment` needs none with `segmenter=masks` or `segmenter=oracle`.",
    ),
    Input.REFERENCES: ("posed pictures of the place", "Set `dataset.references=FOLDER`."),
    Input.TEXTURED_MAP: ("a textured map", "Set `dataset.textured_map=FILE`."),
    Input.TILT: ("a measured pitch and roll of the priors", "Take a method that finds them."),
    Input.HEIGHT: ("a measured height of the priors", "Take a method that finds it."),
    Input.RECONSTRUCTION: (
        "poses of its photos in a reconstruction",
        "Put a COLMAP model of the photos, under their names, in each split's folder reconstruction (of "
        "several flights: reconstruction/SEQUENCE), or set `dataset.reconstruction=true` of real_flights, "
        "`dataset.reconstruct=true` of flights.",
    ),
    Input.TRUE_PIXELS: ("true poses", "Take another matcher than the oracle."),
    Input.MAP: ("a city model", "Set `city=FILE`."),
}


def declared_inputs(part: object, attribute: str, default: Collection[str] = ()) -> frozenset[Input]:
    """Returns the inputs that a plug-in's class declares in ``requires`` or ``provides``.

    Args:
        part: A method or a segmenter, or its class.
        attribute: ``requires`` or ``provides``.
        default: What one that declares nothing is taken to declare.

    Raises:
        ConfigError: It declares something that is no input.
    """
    stated = getattr(part, attribute, default)
    known, name = [item.value for item in Input], getattr(part, "name", part)
    if not isinstance(stated, Collection):
        raise ConfigError(
            f"{name} says {attribute} {stated!r}, which are no inputs.", f"It is a set of {', '.join(known)}."
        )
    for word in stated:
        if word not in known:
            raise ConfigError(
                f"{name} says {attribute} {word!r}, which is no input.", nearest_names(str(word), known)
            )
    return frozenset(Input(word) for word in stated)


def inputs_of(dataset: Dataset, entries: Sequence[Entry]) -> frozenset[Input]:
    """Returns what a dataset has for at least one of some of its queries."""
    has = {
        Input.MASK: any(entry.mask is not None for entry in entries),
        Input.INSTANCES: any(entry.instances is not None for entry in entries),
        Input.CLASSES: any(entry.classes is not None for entry in entries),
        Input.IMAGE: any(entry.image is not None for entry in entries),
        Input.REFERENCES: bool(dataset.references),
        Input.TEXTURED_MAP: dataset.textured_map is not None,
        Input.TILT: Input.TILT not in dataset.assumed,
        Input.HEIGHT: Input.HEIGHT not in dataset.assumed,
        Input.RECONSTRUCTION: any(entry.reconstructed is not None for entry in entries),
        Input.TRUE_PIXELS: bool(dataset.truth),
        Input.MAP: dataset.city_model is not None,
    }
    return frozenset(kind for kind, is_there in has.items() if is_there or kind in dataset.on_demand)


def require_inputs(who: str, requires: Collection[Input], has: Collection[Input], lacking: str) -> None:
    """Makes sure that all that is needed is there.

    Args:
        who: What needs it, as typed: ``method=lodlocv2``.
        requires: What it needs.
        has: What there is.
        lacking: What is stated of the rest: ``the dataset has none``.

    Raises:
        DatasetError: Something is missing; the hint says how to give it.
    """
    missing = [kind for kind in Input if kind in requires and kind not in has]
    if missing:
        words = " and ".join(_WORDS[kind][0] for kind in missing)
        raise DatasetError(f"{who} needs {words}, and {lacking}.", _WORDS[missing[0]][1])


_POSE_FILES = ("poses.txt", "GT_pose.txt")
_IMAGE_FOLDERS = ("images", "Query_image", ".")
_HINT = "References are a folder of poses.txt, intrinsic.txt and images/, pictures named as the poses."


def read_references(folder: Path) -> tuple[Reference, ...]:
    """Returns the posed pictures of a folder, in the order of the poses; no picture is opened.

    Args:
        folder: Holds ``poses.txt`` or ``GT_pose.txt`` (world to camera, in the city's coordinates),
            ``intrinsic.txt``, and the pictures in ``images`` or ``Query_image`` or beside the poses.

    Raises:
        DatasetError: There are no poses, one has no camera or no picture, or its lens distorts.
    """
    if not folder.is_dir():
        raise DatasetError(f"{folder} is not a folder.", "Set `dataset.references=FOLDER`.")
    file = next((folder / name for name in _POSE_FILES if (folder / name).is_file()), None)
    poses = {} if file is None else read_poses(file)
    if not poses:
        raise DatasetError(f"The references in {folder} have no poses.", _HINT)
    cameras = read_cameras(folder / "intrinsic.txt")
    references = []
    for name, pose in poses.items():
        candidates = (folder / images / name for images in _IMAGE_FOLDERS)
        image = next((path for path in candidates if path.is_file()), None)
        if name not in cameras or image is None:
            lacking = "no camera in intrinsic.txt" if name not in cameras else "no picture"
            raise DatasetError(f"The reference {name} in {folder} has {lacking}.", _HINT)
        if cameras[name].distortion:
            raise DatasetError(
                f"The reference {name} in {folder} has a camera with lens distortion.",
                "Undistort the pictures first: lodbench dataset init does.",
            )
        references.append(Reference(name, image, cameras[name], pose))
    return tuple(references)


def with_inputs(dataset: Dataset, requires: Collection[str]) -> Dataset:
    """Returns a dataset with what a method requires of it made, where the dataset makes it on demand.

    Raises:
        LodbenchError: It cannot be made.
    """
    if Input.TEXTURED_MAP in requires and Input.TEXTURED_MAP in dataset.on_demand:
        dataset = replace(dataset, textured_map=dataset.on_demand[Input.TEXTURED_MAP]())
    if Input.REFERENCES in requires and Input.REFERENCES in dataset.on_demand:
        dataset = replace(dataset, references=read_references(dataset.on_demand[Input.REFERENCES]()))
    if Input.INSTANCES in requires and Input.INSTANCES in dataset.on_demand:
        folder = dataset.on_demand[Input.INSTANCES]()
        labels = [(each, folder / each.split / f"{Path(each.name).stem}.png") for each in dataset.entries]
        labelled = [replace(each, instances=file) if file.is_file() else each for each, file in labels]
        dataset = replace(dataset, entries=tuple(labelled))
    return dataset


# Folders of a split's label files: of buildings, and of classes of surfaces (1 roof, 2 wall).
INSTANCES_FOLDER, CLASSES_FOLDER = "instances", "classes"
_CLASS_VALUES = "0 = neither, 1 = roof, 2 = wall"
# More buildings in one photo than this are no buildings.
_MOST = 2000
# Values of all masks of a photo together: 1 GB.
_MOST_VALUES = 2**30


def read_labels(path: Path, what: str = INSTANCES_FOLDER) -> NDArray[np.uint16]:
    """Returns the (H, W) labels of a grey PNG of 8 or 16 bits; faults name ``what`` they are.

    Raises:
        QueryFault: The file is missing, is no such picture or has too many pixels, or has more than 2000
            different values: a photo.
    """
    try:
        content = read_content(path)
    except OSError as error:
        raise QueryFault(f"{what} {path.name} cannot be read: {error.strerror}") from error
    if has_too_many_pixels(content):
        raise QueryFault(f"{what} {path.name} has too many pixels")
    labels = decoded(content, as_stored=True)
    if labels is None or labels.ndim != 2 or labels.dtype not in (np.uint8, np.uint16):
        values = "0, then one per building" if what == INSTANCES_FOLDER else _CLASS_VALUES
        raise QueryFault(f"{what} {path.name} is not a grey image of 8 or 16 bits: {values}")
    is_present = np.zeros(2**16, np.bool_)
    for row in labels:  # all at once it takes eight times the picture
        is_present[row] = True
    count = int(is_present[1:].sum())
    if count > _MOST:
        raise QueryFault(f"{what} {path.name} has {count} labels: is it a photo?")
    return labels.astype(np.uint16)


def read_classes(path: Path) -> NDArray[np.uint8]:
    """Returns the (H, W) classes of a grey PNG: 1 for roofs, 2 for walls, 0 for all else.

    Raises:
        QueryFault: As for ``read_labels``, or there is another value.
    """
    labels = read_labels(path, CLASSES_FOLDER)
    if labels.max(initial=0) > 2:
        raise QueryFault(f"classes {path.name} hold the value {labels.max()}", _CLASS_VALUES)
    return labels.astype(np.uint8)


def encoded_labels(labels: NDArray[np.uint16]) -> bytes:
    """Returns (H, W) labels as the bytes of a PNG of 16 bits."""
    return encoded(labels, ".png")


def masks_of_labels(labels: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Returns (N, H, W) bool, the mask of each label above 0 that occurs, ascending.

    Raises:
        QueryFault: They would take more than 1 GB.
    """
    unique = np.unique(labels)
    unique = unique[unique > 0]
    if len(unique) * labels.size > _MOST_VALUES:
        raise QueryFault(
            f"instances: {len(unique)} masks of {labels.shape[1]} x {labels.shape[0]} are too many"
        )
    return np.asarray(labels[None] == unique[:, None, None])
