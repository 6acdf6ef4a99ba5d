"""What a method is shown of a query, and, in another type, what only the evaluator may see."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.options import ReadOptions
from lodbench.errors import QueryFault
from lodbench.findings import Finding, Findings
from lodbench.geometry import Camera, CameraSigmas, Pose
from lodbench.photos.measurements import Measurements


@dataclass(frozen=True, slots=True, eq=False)
class Query:
    """One query as a method sees it, in the scene's local frame.

    Attributes:
        name: Image file name.
        split: Name of the split it belongs to.
        camera: Pinhole of the full-size image.
        prior: The rough pose to start from.
        building_probability: (H, W) float32 in [0, 1], read-only, what the segmenter found; None for a
            method that requires no mask.
        image: The photo, or None where the dataset has none.
        hypotheses: All rough poses the dataset states, the prior first; may be empty.
        instances: (N, H, W) bool, read-only, a mask of each building, for a method that requires them.
        classes: (H, W) uint8, read-only, 1 for roofs, 2 for walls, 0 for all else, for a method that requires
            them.
        segment: Returns the mask that the segmenter makes, for a method that requires masks on demand; or
            the mask again, guided by the map from a better pose (scene frame), where the segmenter is one
            that looks at the map; None otherwise. Raises QueryFault.
        true_pixels: Returns where (N, 3) points of the scene are in the photo in truth, (N, 2) COLMAP
            pixels, NaN behind the camera: for a method that requires it, which is an oracle, declared as one.
        sequence: Name of the flight it was taken on, unique within its split; "" where nobody says.
        reconstructed: Its pose in a reconstruction of its flight (COLMAP and the like), whose frame is the
            scene's up to a similarity; None where there is none.
        lens_percent: Standard deviation of the camera's focal length by where that came from, percent; None
            where nobody says, or it was calibrated.
        camera_sigmas: Standard deviations of all of the camera's numbers; None: as of a calibrated one.
        measured: What was measured beside the photo, deviations of the prior among it; None for nothing.
        time_s: When it was taken, seconds from any moment of its sequence; None where nobody says.
    """

    name: str
    split: str
    camera: Camera
    prior: Pose
    building_probability: NDArray[np.float32] | None = None
    image: Path | None = None
    hypotheses: tuple[Pose, ...] = ()
    instances: NDArray[np.bool_] | None = None
    classes: NDArray[np.uint8] | None = None
    segment: Callable[[Pose], NDArray[np.float32]] | None = None
    true_pixels: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None
    sequence: str = ""
    reconstructed: Pose | None = None
    lens_percent: float | None = None
    camera_sigmas: CameraSigmas | None = None
    measured: Measurements | None = None
    time_s: float | None = None

    def __post_init__(self) -> None:
        # A method that writes into them would change what is stored, and what the next method is shown.
        for name in ("building_probability", "instances", "classes"):
            given = getattr(self, name)
            if isinstance(given, np.ndarray):
                shown = given.view()
                shown.flags.writeable = False
                object.__setattr__(self, name, shown)

    @property
    def mask(self) -> NDArray[np.float32]:
        """Returns ``building_probability``, for a method that cannot do without.

        Raises:
            QueryFault: There is none.
        """
        if self.building_probability is None:
            raise QueryFault("there is no mask")
        return self.building_probability


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """One query as a dataset stores it, in the dataset's frame; what is missing is None.

    Attributes:
        name: Image file name.
        split: Name of the split.
        camera: Intrinsics of the full-size image.
        prior: Rough pose.
        image: The photo.
        mask: A building mask made beforehand.
        hypotheses: All rough poses the dataset states, the prior first; may be empty.
        sequence: Name of the flight it was taken on, unique within its split; "" where nobody says.
        reconstructed: Its pose in a reconstruction of its flight, in a frame of that.
        instances: Labels of its buildings made beforehand, see ``lodbench.datasets.inputs``.
        classes: Classes of surfaces made beforehand, see ``lodbench.datasets.inputs``.
        lens_percent: As of ``Query``.
        camera_sigmas: Likewise.
        measured: Likewise.
        stored: The photo as its camera stored it, with its metadata, where ``image`` is a copy of it.
    """

    name: str
    split: str
    camera: Camera | None
    prior: Pose | None
    image: Path | None
    mask: Path | None
    hypotheses: tuple[Pose, ...] = ()
    sequence: str = ""
    reconstructed: Pose | None = None
    instances: Path | None = None
    classes: Path | None = None
    lens_percent: float | None = None
    camera_sigmas: CameraSigmas | None = None
    measured: Measurements | None = None
    stored: Path | None = None

    def with_prior(self, prior: Pose | None, hypotheses: tuple[Pose, ...]) -> Entry:
        """Returns the query with another prior, whose deviations nobody has stated."""
        measured = None if self.measured is None else self.measured.without_sigmas()
        return replace(self, prior=prior, hypotheses=hypotheses, measured=measured)

    @property
    def key(self) -> str:
        """Returns ``split/name``, unique within a dataset."""
        return f"{self.split}/{self.name}"


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """A picture of the place whose pose is known.

    Attributes:
        name: Of the picture, unique in its dataset.
        image: The file.
        camera: Its pinhole.
        pose: In the dataset's frame; in the scene's where a method is handed it.
    """

    name: str
    image: Path
    camera: Camera
    pose: Pose


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Dataset:
    """Queries, their truth, and the city they were taken in.

    Attributes:
        name: Public name, for example ``demo``.
        version: Version of the data, where it has one.
        root: Folder the data lives in.
        city_model: File of the city model, or None where only poses are scored.
        lod: Level of detail to localise against, or None for the lowest there is.
        splits: Names of the splits, in the order to report them.
        entries: All queries, in file order by split.
        truth: True pose by ``Entry.key``, in the dataset's frame; never handed to a method.
        notes: What the reader should know, for example names that occur in one file only.
        city_options: How to read the city model.
        roof_height: Rule by which an absent level 1 is derived, or None.
        default_splits: Splits to run where none is named; empty for all.
        city_hint: What to do where the city model is missing.
        findings: What was met while reading, one by one; ``notes`` count them.
        photo_crs: CRS of which the frame is a shift, where that is known apart from the city model.
        photo_origin: East, north and height of the frame's zero in ``photo_crs``, or None.
        segmenter: Segmenter to run where none is named; None for masks, or photos, as there are.
        references: Pictures of the place whose poses are known; no queries.
        textured_map: File or folder of a textured map, which ``CityMap.colour`` then shows; or None.
        on_demand: What is made only for a method that requires it, by the name of the ``Input``: a function
            that makes it, or finds it made, and returns the file or folder; textured map, references and
            instances.
        assumed: Of ``tilt`` and ``height``, what the priors only assume: methods that require it do not run.
        crs: Reference system of the poses as the data states it, or None.
        protocol: Name of the bins and metrics that its results are reported by, of
            ``lodbench.evaluation.metrics``.
        submission: Returns the text of a submission in the benchmark's own format, from poses by
            ``Entry.key``, None for no answer; None where there is no such format.
    """

    name: str
    version: str
    root: Path
    city_model: Path | None
    lod: str | None
    splits: tuple[str, ...]
    entries: tuple[Entry, ...]
    truth: dict[str, Pose]
    notes: tuple[str, ...] = ()
    city_options: ReadOptions = field(default_factory=ReadOptions)
    roof_height: str | None = None
    default_splits: tuple[str, ...] = ()
    city_hint: str = "Set `city=FILE`."
    findings: tuple[Finding, ...] = ()
    photo_crs: str | None = None
    photo_origin: tuple[float, ...] | None = None
    segmenter: str | None = None
    references: tuple[Reference, ...] = ()
    textured_map: Path | None = None
    on_demand: Mapping[str, Callable[[], Path]] = field(default_factory=dict)
    assumed: frozenset[str] = frozenset()
    crs: str | None = None
    protocol: str = "lodloc"
    submission: Callable[[Mapping[str, Pose | None]], str] | None = None

    def __repr__(self) -> str:
        splits = ", ".join(self.splits)
        return f"Dataset({self.name}, {len(self.entries)} queries in {splits}, {self.root})"


def repeated_keys(entries: Iterable[Entry]) -> list[str]:
    """Returns the keys that several entries have, sorted."""
    return sorted(key for key, count in Counter(entry.key for entry in entries).items() if count > 1)


def notes_of(findings: Findings) -> tuple[str, ...]:
    """Returns one line per kind of finding: how often, and the first of its details."""
    lines = []
    for name, count in findings.counts().items():
        first = next(item for item in findings.items if str(item.code) == name)
        detail = f": {first.detail}" if first.detail else ""
        lines.append(f"{count} x {name}, first {first.object_id}{detail}")
    return tuple(lines)
