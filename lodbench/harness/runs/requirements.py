"""Before any work: whether a run has what its method and its segmenter need.

At the door, before any work: do a run's city, priors, photos and masks belong together? What is wrong with
all queries ends the run in one line. What is wrong with some is theirs, and counted.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from lodbench.citymodel.crs import is_same_plane
from lodbench.citymodel.scene import Scene
from lodbench.datasets import faults
from lodbench.datasets.inputs import (
    Input,
    declared_inputs,
    inputs_of,
    read_classes,
    read_labels,
    require_inputs,
)
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import ConfigError, DatasetError, QueryFault, nearest_names
from lodbench.execution import Progress
from lodbench.findings import Findings
from lodbench.geometry import Pose
from lodbench.harness.city import FURTHEST_M, distance_outside_m
from lodbench.harness.contradictions import Views, meaning_of, same_photos
from lodbench.methods import Method
from lodbench.methods.protocol import SupportsFlights, SupportsSequences
from lodbench.photos.metadata import read_photo_metadata
from lodbench.photos.pictures import picture_size
from lodbench.reporting.aligned_text import count_of
from lodbench.segmentation import Segmenter
from lodbench.segmentation.masks import MaskFiles, read_mask
from lodbench.segmentation.oracle import Oracle

# What segmenters make, from whatever they themselves need.
SEGMENTED = frozenset({Input.MASK, Input.INSTANCES, Input.CLASSES, Input.MASK_ON_DEMAND})
_LACKING = "the dataset has none"
_LOG = logging.getLogger(__name__)
# Share of a map's area below which it has no surfaces of a class.
_LEAST_AREA = 0.01
# Masks that a run looks at before it begins.
_FEW = 24
_TILE_HINT = "Is it the right tile, and its reference system right? lodbench city info says where it is."
TILTS = ("prior", "truth")


def needs_segmenter(method: object) -> bool:
    """Tells whether a method looks at what a segmenter makes."""
    return bool(segmented_inputs(method))


def segmented_inputs(method: object) -> frozenset[Input]:
    """Returns what a method needs of a segmenter; one that declares nothing looks at masks."""
    return declared_inputs(method, "requires", {Input.MASK}) & SEGMENTED


def made_inputs(method: object) -> frozenset[Input]:
    """Returns what queries have for a method alone: of the segmenter, of a reconstruction, of the truth."""
    others = declared_inputs(method, "requires", {Input.MASK}) & {Input.RECONSTRUCTION, Input.TRUE_PIXELS}
    return segmented_inputs(method) | others


def is_oracle(method: Method, segmenter: Segmenter) -> bool:
    """Tells whether a method is shown the truth, by itself or by what makes its masks."""
    return Input.TRUE_PIXELS in made_inputs(method) or (
        needs_segmenter(method) and isinstance(segmenter, Oracle)
    )


def required_inputs(method: Method, segmenter: Segmenter) -> frozenset[Input]:
    """Returns what a run needs of its dataset: for its method, and its segmenter if it needs one."""
    requires = declared_inputs(method, "requires", {Input.MASK}) - SEGMENTED
    return requires | declared_inputs(segmenter, "requires") if needs_segmenter(method) else requires


def require_run_inputs(
    method: Method, segmenter: Segmenter, dataset: Dataset, entries: Sequence[Entry]
) -> None:
    """Makes sure that a method and, if it is needed, the segmenter have what they need.

    What single queries lack is no matter of this: it is theirs, and counted.

    Raises:
        ConfigError: The method or the segmenter declares something that is no input.
        DatasetError: Something is missing; the hint says how to give it.
    """
    requires = declared_inputs(method, "requires", {Input.MASK})
    has = inputs_of(dataset, entries)
    made = frozenset[Input]()
    if needs_segmenter(method):
        made = declared_inputs(segmenter, "provides", {Input.MASK})
        made |= {Input.MASK_ON_DEMAND} if Input.MASK in made else set()
        name = f"segmenter={segmenter.name}"
        require_inputs(f"method={method.name}", requires & SEGMENTED, made, f"{name} makes none")
        require_inputs(name, declared_inputs(segmenter, "requires"), has, _LACKING)
    require_inputs(f"method={method.name}", requires - SEGMENTED, has, _LACKING)


def looks_at_photos(method: Method, segmenter: Segmenter) -> bool:
    """Tells whether a run's method, or the segmenter if it has one, looks at the photos."""
    is_used = needs_segmenter(method)
    by_segmenter = is_used and Input.IMAGE in declared_inputs(segmenter, "requires")
    return by_segmenter or Input.IMAGE in declared_inputs(method, "requires", {Input.MASK})


def require_same_place(dataset: Dataset, entries: Sequence[Entry], scene: Scene) -> None:
    """Makes sure that the poses of a dataset are in the city's coordinates, and near it.

    Raises:
        DatasetError: The dataset states another reference system than the city, or all its priors lie
            outside the city model.
    """
    if dataset.crs is not None and scene.crs is not None and not is_same_plane(dataset.crs, scene.crs):
        raise DatasetError(
            f"The poses of {dataset.root} are in {dataset.crs}, the city model {dataset.city_model} is in "
            f"{scene.crs}.",
            "Take the city model it was made with, or make it again: lodbench dataset init.",
        )
    away = [(distance_outside_m(e.prior, scene), e.key) for e in entries if e.prior is not None]
    if away and min(away)[0] > FURTHEST_M:
        nearest, key = min(away)
        raise DatasetError(
            f"All priors lie outside the city model {dataset.city_model}; the nearest, {key}, is "
            f"{nearest / 1000:.1f} km off.",
            _TILE_HINT,
        )


def require_surfaces(method: Method, scene: Scene) -> None:
    """Makes sure that a map has roofs and walls apart, where a method compares them.

    Raises:
        DatasetError: One of them takes less than a hundredth of its area: footprints, roofs without walls.
    """
    if Input.CLASSES not in segmented_inputs(method):
        return
    areas = np.bincount(scene.surface_classes(), scene.areas_m2(), minlength=3)[1:]
    for name, area in zip(("roofs", "walls"), areas, strict=True):
        if area < _LEAST_AREA * areas.sum():
            raise DatasetError(
                f"method={method.name} compares roofs and walls, and the map has no {name}.",
                "Take a map with both, or compare silhouettes: leave `method.fit` out.",
            )


def require_near(prior: Pose, scene: Scene) -> None:
    """Makes sure that one query's prior is near the city.

    Raises:
        QueryFault: It is kilometres away.
    """
    distance = distance_outside_m(prior, scene)
    if distance > FURTHEST_M:
        raise QueryFault(f"the prior lies {distance / 1000:.1f} km outside the city model")


def require_photo(entry: Entry) -> None:
    """Makes sure that one query's photo, if it has one, can be read and is of its camera's size.

    Raises:
        QueryFault: It is not.
    """
    fault = faults.photo_fault(entry)
    if fault:
        raise QueryFault(fault)


def require_pictures(
    dataset: Dataset, entries: Sequence[Entry], method: Method, segmenter: Segmenter
) -> None:
    """Makes sure that not all photos or masks that a run looks at are unfit for their cameras.

    Masks of another size but the photo's aspect are scaled, and said to be.

    Raises:
        DatasetError: All photos are unreadable or of another size than the intrinsics, or all masks have
            another aspect.
    """
    if looks_at_photos(method, segmenter):
        hint = "intrinsic.txt must be of the photos as they are stored; lodbench dataset check lists all."
        _require_some([entry for entry in entries if entry.image is not None], faults.photo_fault, hint)
    if needs_segmenter(method) and isinstance(segmenter, MaskFiles):
        masked = [entry for entry in entries if entry.mask is not None and entry.camera is not None]
        hint = "A mask shows what its photo shows, in any size."
        _require_some(masked, _mask_fault, hint)
        _warn_of_scaled(masked)


def require_cameras(entries: Sequence[Entry]) -> None:
    """Makes sure that some camera may be a photo's; of others, the queries fail.

    Raises:
        DatasetError: None may.
    """
    hint = "intrinsic.txt has pixels: fx, fy, cx, cy of PINHOLE."
    _require_some([entry for entry in entries if entry.camera is not None], _camera_fault, hint)


def doubts_of(
    dataset: Dataset, entries: Sequence[Entry], scene: Scene, method: Method, segmenter: Segmenter
) -> tuple[str, ...]:
    """Returns what a few masks contradict, and photos that several queries have, as notes.

    Raises:
        DatasetError: All the masks that were looked at contradict camera, pose or city in the same way.
    """
    notes = [f"{copy.key} has the photo of {first.key}" for first, copy in same_photos(dataset, entries)]
    if needs_segmenter(method) and isinstance(segmenter, MaskFiles):
        masked = [entry for entry in entries if entry.mask is not None and entry.key in dataset.truth]
        views = Views(dataset, masked[:: -(-len(masked) // _FEW) or 1], scene)
        wrong = [(view, reading) for view, reading in views.wrong_masks() if reading.words]
        if wrong and len(wrong) == len(views.masked()):
            view, reading = wrong[0]
            raise DatasetError(
                f"The masks contradict the city, the cameras or the true poses; {view.entry.key}: "
                f"{meaning_of(view, reading)}.",
                "lodbench dataset check lists all.",
            )
        notes += [f"the mask of {view.entry.key}: {meaning_of(view, reading)}" for view, reading in wrong]
    for note in notes:
        _LOG.warning("%s", note)
    return tuple(notes)


def warn_of_flights(method: Method, entries: Sequence[Entry]) -> None:
    """Says which photos are taken for one flight because nothing names theirs: they may not be one.

    Raises:
        DatasetError: The method finds each photo from the one before.
    """
    unnamed = Counter(entry.split for entry in entries if not entry.sequence)
    if isinstance(method, SupportsFlights) and max(unnamed.values(), default=0) > 1:
        listed = ", ".join(f"{count_of(count, 'photos')} of {split}" for split, count in unnamed.items())
        if isinstance(method, SupportsSequences):
            raise DatasetError(
                f"method={method.name} finds each photo of a flight from the one before, and nothing names "
                f"the flights of {listed}.",
                "Name them in sequences.txt, or localise single photos: `method=contour_alignment`.",
            )
        _LOG.warning("nothing names the flights (sequences.txt): taken for one flight each: %s", listed)


def _require_some(entries: Sequence[Entry], fault_of: Callable[[Entry], str], hint: str) -> None:
    """Refuses queries that all have a fault; one sound query is enough, the others fail by themselves."""
    first = ""
    for entry in entries:
        fault = fault_of(entry)
        if not fault:
            return
        first = first or f"{entry.key}: {fault}"
    if first:
        count = f"None of {len(entries)} queries can be used" if len(entries) > 1 else "No query can be used"
        raise DatasetError(f"{count}; {first}.", hint)


def _camera_fault(entry: Entry) -> str:
    assert entry.camera is not None  # noqa: S101 - the caller has looked
    return faults.camera_fault(entry.camera)


def _mask_fault(entry: Entry) -> str:
    assert entry.mask is not None  # noqa: S101 - the caller has looked
    assert entry.camera is not None  # noqa: S101 - likewise
    return faults.mask_fault(entry.mask, (entry.camera.width, entry.camera.height))


def _warn_of_scaled(entries: Sequence[Entry]) -> None:
    other = [
        (entry, size)
        for entry in entries
        if entry.mask is not None
        and entry.camera is not None
        and (size := picture_size(entry.mask)) not in (None, (entry.camera.width, entry.camera.height))
    ]
    if other:
        entry, size = other[0]
        assert entry.camera is not None and size is not None  # noqa: S101, PT018 - the filter has looked
        # Drawn views have no photos, but cameras of such.
        whose = "camera" if entry.image is None else "photo"
        _LOG.warning(
            "%d of %d masks are of another size than their %ss and are scaled; the first, %s, is %d x %d, "
            "its %s %d x %d",
            len(other), len(entries), whose, entry.key, *size, whose, entry.camera.width, entry.camera.height,
        )  # fmt: skip


def check_photos(dataset: Dataset, with_pixels: bool, findings: Findings) -> None:
    """Adds what is wrong with a dataset's photos and masks to findings.

    Args:
        dataset: As opened.
        with_pixels: Whether to decode every photo and mask; their headers are read in any case.
        findings: Receives them, under the queries' names.
    """
    for entry in dataset.entries:
        for fault in _mask_files_faults(entry, with_pixels):
            findings.add(faults.MASK_UNFIT, entry.key, fault)
    entries = [entry for entry in dataset.entries if entry.image is not None]
    with Progress("photos", len(entries)) as progress:
        for entry in entries:
            _check_photo(entry, with_pixels, findings)
            progress.advance()


def _mask_files_faults(entry: Entry, with_pixels: bool) -> Iterator[str]:
    """Yields what is wrong with a query's mask, and with its labels of single buildings and of surfaces."""
    readers: tuple[tuple[Path | None, Callable[[Path], object]], ...] = (
        (entry.mask, read_mask),
        (entry.instances, read_labels),
        (entry.classes, read_classes),
    )
    for file, read in readers:
        if file is None:
            continue
        size = None if entry.camera is None else (entry.camera.width, entry.camera.height)
        fault = "" if size is None else faults.mask_fault(file, size)
        if not fault and with_pixels:
            try:
                read(file)
            except QueryFault as error:
                fault = error.message
        if fault:
            yield fault


def _check_photo(entry: Entry, with_pixels: bool, findings: Findings) -> None:
    """Looks at one photo, its header first: pixels are decoded only if their number is sane."""
    assert entry.image is not None  # noqa: S101 - the caller has looked
    try:
        header = read_photo_metadata(entry.image)
    except DatasetError as error:
        findings.add(faults.IMAGE_UNREADABLE, entry.key, error.message)
        return
    if header.has_position:
        findings.add(faults.GPS_IN_IMAGE, entry.key)
    camera = entry.camera
    if camera is not None and (header.width, header.height) != (camera.width, camera.height):
        detail = f"{header.width} x {header.height}, intrinsics {camera.width} x {camera.height}"
        findings.add(faults.IMAGE_SIZE, entry.key, detail)
    if with_pixels and not faults.is_decodable(entry.image):
        findings.add(faults.IMAGE_UNREADABLE, entry.key, f"{entry.image} is damaged or cut off")


def require_choices(tilt: str, limit: int | None = None) -> None:
    """Makes sure of what can be checked of a run's settings before any dataset is opened, or built.

    Raises:
        ConfigError: A tilt is none of ``TILTS``, or no query is requested.
    """
    if tilt not in TILTS:
        raise ConfigError(f"tilt={tilt} is not known.", nearest_names(tilt, TILTS))
    if limit is not None and limit < 1:
        raise ConfigError(f"limit={limit} is not a number of queries.")


def require_tilt(tilt: str, dataset: Dataset) -> None:
    """Makes sure that a tilt is one of ``TILTS``, and that a dataset has it.

    Raises:
        ConfigError: It is not, or the true one is requested and there is no truth.
    """
    require_choices(tilt)
    if tilt == "truth" and not dataset.truth:
        raise ConfigError("tilt=truth needs a truth, and the dataset has none.", "Leave it out.")
