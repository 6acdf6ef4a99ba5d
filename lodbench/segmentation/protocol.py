"""What a segmenter is, how its answer becomes the mask that is compared, and segmenters by name."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lodbench.datasets.folder import select_splits
from lodbench.datasets.inputs import Input
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import DatasetError, QueryFault
from lodbench.geometry import Camera, Pose
from lodbench.params import to_params
from lodbench.plugins import blaming, load_plugin, of_kind
from lodbench.storage import digest_of

if TYPE_CHECKING:
    from lodbench.citymap import CityMap


# A pixel is building from here on (the paper's delta_s).
BUILDING_THRESHOLD = 0.5
# A mask may differ this much from the camera's aspect: sizes are rounded to whole pixels.
_ASPECT_TOLERANCE = 0.02
# Resizing in float32 may step out of [0, 1] by rounding.
_RANGE_TOLERANCE = 1e-6


class Segmenter(Protocol):
    """Says where the buildings are in a query.

    Attributes:
        name: As its entry point's.
        requires: What it needs of the dataset, of ``lodbench.datasets.inputs.Input``; nothing if it says
            nothing.
        provides: ``mask``, ``instances``, ``classes`` or several; a mask if it says nothing.
    """

    name: str

    @property
    def requires(self) -> Collection[str]:
        """Returns the names of what it needs; a class attribute will do."""
        ...

    @property
    def provides(self) -> Collection[str]:
        """Returns the names of what it makes; a class attribute will do."""
        ...

    def segment(self, entry: Entry) -> NDArray[np.float32]:
        """Returns the (H, W) float32 probability of building, in [0, 1].

        Raises:
            QueryFault: This query cannot be segmented; the reason becomes its row's.
        """
        ...

    def fingerprint(self, entries: tuple[Entry, ...]) -> str:
        """Returns a digest of all that the answers to these queries depend on."""
        ...


@runtime_checkable
class MapGuidedSegmenter(Protocol):
    """A segmenter that looks at the map too, from the prior or a better pose; it requires ``map``.

    Runs call this in place of ``segment``.
    """

    name: str

    def segment_from(self, entry: Entry, pose: Pose, city_map: CityMap) -> NDArray[np.float32]:
        """Returns the (H, W) float32 probability of building, in [0, 1].

        Args:
            entry: The query.
            pose: Where it may have been taken, scene frame.
            city_map: Draws the city; what is drawn while a method runs counts as the method's.

        Raises:
            QueryFault: This query cannot be segmented.
        """
        ...


@runtime_checkable
class InstanceSegmenter(Protocol):
    """A segmenter that separates buildings; it provides ``instances``."""

    name: str

    def segment_instances(self, entry: Entry) -> NDArray[np.bool_]:
        """Returns (N, H, W) bool, a mask of each building; any size of the photo's aspect.

        Raises:
            QueryFault: This query cannot be segmented.
        """
        ...


@runtime_checkable
class MapGuidedInstanceSegmenter(Protocol):
    """A segmenter that separates buildings by the map too; it requires ``map``, provides ``instances``.

    Runs call this in place of ``segment_instances``.
    """

    name: str

    def segment_instances_from(self, entry: Entry, pose: Pose, city_map: CityMap) -> NDArray[np.bool_]:
        """Returns (N, H, W) bool, a mask of each building; arguments as for ``segment_from``.

        Raises:
            QueryFault: This query cannot be segmented.
        """
        ...


@runtime_checkable
class ClassSegmenter(Protocol):
    """A segmenter that tells roofs, walls and all else apart; it provides ``classes``."""

    name: str

    def segment_classes(self, entry: Entry) -> NDArray[np.uint8]:
        """Returns (H, W) uint8, 1 for roofs, 2 for walls, 0 for all else; any size of the photo's aspect.

        Raises:
            QueryFault: This query cannot be segmented.
        """
        ...


def notes_of(segmenter: object) -> tuple[str, ...]:
    """Returns what a reader of results must know about a segmenter; none where it says nothing."""
    notes = getattr(segmenter, "notes", None)
    with blaming("segmenters", str(getattr(segmenter, "name", "")), "tell its notes"):
        stated = tuple(of_kind(note, str) for note in notes()) if notes is not None else ()
    if isinstance(segmenter, MapGuidedSegmenter):
        stated = (f"segmenter {segmenter.name}: guided by the map from the prior", *stated)
    return stated


def check_mask(mask: ArrayLike, camera: Camera) -> NDArray[np.float32]:
    """Returns a mask as (H, W) float32 probability of building in [0, 1].

    Args:
        mask: (H, W) bool, or numbers in [0, 1]; any size of the photo's aspect.
        camera: The camera of the full-size photo.

    Raises:
        QueryFault: It is not such an array, or its aspect is off by more than 2 % and than rounding.
    """
    try:
        given = np.asarray(mask)
    except ValueError as error:
        raise QueryFault("the mask is no array: its rows differ in length") from error
    if given.dtype.kind not in "buif":
        raise QueryFault(f"the mask holds {given.dtype} instead of numbers in [0, 1]")
    if given.ndim != 2:
        raise QueryFault(f"the mask has shape {given.shape} instead of (height, width)", "Give one channel.")
    if given.size == 0:
        raise QueryFault(f"the mask is empty: its shape is {given.shape}")
    _check_range(given)
    height, width = given.shape
    aspect = (width / height) / (camera.width / camera.height)
    # Sides are whole: of a photo a few pixels wide, rounding alone changes the aspect by more.
    rounding = 0.5 * max(1.0 / width, 1.0 / height)
    if abs(aspect - 1.0) > max(_ASPECT_TOLERANCE, rounding):
        raise QueryFault(
            f"the mask is {width} x {height}, the camera {camera.width} x {camera.height}: another aspect",
            "A mask shows all of its photo; it may be smaller or larger. Is it this photo's?",
        )
    return np.clip(given.astype(np.float32), np.float32(0), np.float32(1))


def check_instances(masks: ArrayLike, camera: Camera) -> NDArray[np.bool_]:
    """Returns masks of single buildings as (N, H, W) bool.

    Raises:
        QueryFault: They are not such an array, or their aspect is not the camera's.
    """
    given = np.asarray(masks)
    if given.ndim != 3 or given.dtype != np.bool_:
        raise QueryFault(f"instances are {given.dtype} of shape {given.shape}, not bool (N, height, width)")
    if len(given):
        check_mask(given[0], camera)
    return given


def check_classes(classes: ArrayLike, camera: Camera) -> NDArray[np.uint8]:
    """Returns classes of surfaces as (H, W) uint8.

    Raises:
        QueryFault: They are not such an array of 0, 1 and 2, or their aspect is not the camera's.
    """
    given = np.asarray(classes)
    if given.ndim != 2 or given.dtype != np.uint8 or given.max(initial=0) > 2:
        raise QueryFault(f"classes are {given.dtype} of shape {given.shape}, not 0, 1, 2 (height, width)")
    check_mask(given > 0, camera)
    return given


def resized_classes(classes: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """Returns the (height, width) classes: of each target pixel the one that takes most of its area."""
    if classes.shape == (height, width):
        return classes
    shares = [resized((classes == k).astype(np.float32), width, height) for k in range(3)]
    return np.asarray(np.argmax(shares, axis=0), dtype=np.uint8)


def _check_range(mask: NDArray[Any]) -> None:
    if not np.isfinite(mask).all():
        raise QueryFault("the mask has values that are not finite")
    least, largest = float(mask.min()), float(mask.max())
    if least < -_RANGE_TOLERANCE or largest > 1 + _RANGE_TOLERANCE:
        bytes_given = least >= 0 and (largest == 255 or (mask.dtype.kind in "ui" and largest < 255))
        hint = "Divide by 255." if bytes_given else ""
        raise QueryFault(
            f"the mask has values from {least:g} to {largest:g} instead of probabilities from 0 to 1", hint
        )


def resized(probability: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Returns the (height, width) probability: averaged over each target pixel's area."""
    import cv2

    if probability.shape == (height, width):
        return probability
    return np.asarray(cv2.resize(probability, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def no_wider(probability: NDArray[np.float32], width: int, camera: Camera) -> NDArray[np.float32]:
    """Returns the probability at most so wide, of the camera's aspect where it was wider."""
    if probability.shape[1] <= width:
        return probability
    return resized(probability, width, max(1, round(width * camera.height / camera.width)))


def binary_mask(probability: NDArray[np.float32], width: int, height: int) -> NDArray[np.bool_]:
    """Returns the (height, width) mask: averaged over each target pixel's area, then thresholded."""
    return np.asarray(resized(probability, width, height) >= BUILDING_THRESHOLD)


class TrainableSegmenter(Protocol):
    """Builds its network and stores its weights.

    Attributes:
        params: Its settings, a frozen dataclass.
        stride: Sides of pictures are padded to multiples of this.
        learns: Optional: ``masks``, which is meant where it is missing, ``interiors`` of single buildings,
            or ``classes``.
    """

    params: Any
    stride: int

    def build(self, init: str | None) -> Any:
        """Returns the network as a torch module, from a weights file or with random weights.

        It takes (B, 3, H, W) float32 RGB in [0, 1] and returns a tuple of logits (B, 1, H, W), or
        (B, 2, H, W) of roofs and walls, the answer first.

        Raises:
            LodbenchError: The file does not hold weights of this network.
        """
        ...

    def packaged_weights(self) -> Path | None:
        """Returns the weights in the package, or None where there are none."""
        ...

    def store(self, net: Any, folder: Path) -> Path:
        """Writes a network's weights as ``segment`` loads them and returns the file."""
        ...


def make_segmenter(name: str, settings: Mapping[str, Any] | None = None) -> tuple[Segmenter, Any]:
    """Returns the segmenter of a name, and its parameters; what is not set keeps its default.

    Raises:
        LodbenchError: There is no such segmenter, a setting is wrong, or it cannot be made.
    """
    part = load_plugin("segmenters", name)
    with blaming("segmenters", name, "be made"):
        params = to_params(settings or {}, part.params_type, "segmenter")
        return part(params), params


def fingerprint_of(segmenter: Segmenter, entries: tuple[Entry, ...]) -> str:
    """Returns a digest of all that a segmenter's answers to some queries depend on.

    Raises:
        LodbenchError: It has none.
    """
    with blaming("segmenters", segmenter.name, "tell its fingerprint"):
        return of_kind(segmenter.fingerprint(entries), str)


def masks_digest(segmenter: Segmenter, entries: tuple[Entry, ...]) -> str:
    """Returns a digest of what a segmenter's masks of some queries are made from: fingerprint and settings.

    The fingerprints of lodbench's own segmenters, where they say anything, are of the settings already.

    Raises:
        LodbenchError: It has no fingerprint.
    """
    stated = fingerprint_of(segmenter, entries)
    is_whole = stated != "" and type(segmenter).__module__.startswith("lodbench.")
    settings = {} if is_whole else _settings(segmenter)
    return digest_of([segmenter.name, settings, stated]) if settings else stated


def _settings(segmenter: Segmenter) -> dict[str, str]:
    """Returns a segmenter's settings as text, less its name and places of weights, which are no content."""
    params: Any = getattr(segmenter, "params", None)
    values = asdict(params) if is_dataclass(params) and not isinstance(params, type) else {}
    return {
        key: repr(value)
        for key, value in values.items()
        if key != "name" and not (key.endswith("weights") and isinstance(value, str | Path | None))
    }


AUTO = "auto"
# Looks at photos that nobody has drawn, where no other segmenter is named.
FOR_PHOTOS = "efficient_unet"


def chosen_segmenter(
    dataset: Dataset, wanted: Collection[Input] = frozenset({Input.MASK}), splits: tuple[str, ...] = ()
) -> tuple[str, str]:
    """Returns the name of the segmenter for a dataset, and the reason in words.

    Masks lie in a dataset because somebody made them for these photos, so they go before a network; unless
    the dataset says otherwise, as the demo does, whose masks are drawn.

    Args:
        dataset: What is to be segmented.
        wanted: What the method looks at of what a segmenter makes.
        splits: That are looked at; the dataset's default ones if none is named.

    Raises:
        DatasetError: Masks are needed, and the splits have neither masks nor photos.
        ConfigError: A split is not one of the dataset.
    """
    requested = select_splits(dataset, splits)
    entries = [entry for entry in dataset.entries if entry.split in requested]
    total = len(entries)
    if Input.INSTANCES in wanted:
        labelled = sum(entry.instances is not None for entry in entries)
        if labelled:
            return "instances", f"{labelled} of {total} queries have labels of single buildings"
        return (
            "compact_instances",
            "the method asks for single buildings, and the dataset has no labels of them",
        )
    if Input.CLASSES in wanted:
        labelled = sum(entry.classes is not None for entry in entries)
        if not labelled:
            raise DatasetError(
                f"The method needs masks of roofs and walls, and {dataset.name} has none.",
                "Name a segmenter that makes them: `segmenter=compact_classes segmenter.weights=FILE`.",
            )
        return "classes", f"{labelled} of {total} queries have labels of roofs and walls"
    if dataset.segmenter is not None:
        return dataset.segmenter, f"as {dataset.name} says"
    masks = sum(entry.mask is not None for entry in entries)
    if masks:
        return "masks", f"{masks} of {total} queries have masks made beforehand"
    if not wanted:
        return "none", "the dataset has no masks, and the method needs none"
    if any(entry.image is not None for entry in entries):
        return FOR_PHOTOS, "the dataset has photos and no masks"
    raise DatasetError(
        f"None of the {total} queries of {dataset.name} has a mask or a photo.",
        "Put building masks (255 = building) in masks, or photos in Query_image, named as in the poses.",
    )
