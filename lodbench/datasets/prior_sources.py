"""Where priors come from, as a protocol: ``prior=file | sensor | uniform | basin``.

What a source makes depends on the dataset, its own settings and the seed, never on the order of work.
A set of priors has a digest, and a file that states how it was made; ``prior=file`` reads it back.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import ClassVar, Protocol, cast

import numpy as np

from lodbench.citymodel.cache import open_cached_scene
from lodbench.datasets.exchange.lines import Fix, read_fixes, read_lines
from lodbench.datasets.faults import NO_PRIOR
from lodbench.datasets.pose_text import format_pose, lines_to_text
from lodbench.datasets.query import Dataset, Entry, notes_of
from lodbench.errors import ConfigError, DatasetError, Option, Words, require_numbers
from lodbench.findings import Findings
from lodbench.geometry import EulerAngles, Pose
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.measurements import Measurements, measured_of
from lodbench.photos.metadata import PhotoMetadata, read_photo_metadata
from lodbench.photos.pose import HeightOptions, HeightSource, RoughPlace, pose_from_photo
from lodbench.storage import digest_of, random_stream

_NO_TRUTH_HINT = "Take the photos' own, `prior=sensor`, or those of a file: `prior=file` `prior.path=FILE`."


@dataclass(frozen=True, slots=True)
class UniformPrior:
    """Independent uniform errors around the truth, each within plus or minus its half width.

    The defaults are those of the published Swiss-EPFL priors: 17 m and 3.8 degrees in the median.
    Angles are errors of the datasets' pitch, roll and yaw, not turns about camera axes.

    Attributes:
        x_m: East, metres.
        y_m: North, metres.
        z_m: Up, metres.
        yaw_deg: Yaw, degrees.
        pitch_deg: Pitch, degrees.
        roll_deg: Roll, degrees.

    Raises:
        ConfigError: A half width is negative or not finite.
    """

    name: ClassVar[str] = "uniform"
    x_m: float = 10.0
    y_m: float = 10.0
    z_m: float = 30.0
    yaw_deg: float = 7.5
    pitch_deg: float = 1.0
    roll_deg: float = 1.0

    def __post_init__(self) -> None:
        require_numbers(self, "prior", (field.name for field in fields(self)), 0)

    def apply(self, dataset: Dataset, seed: int) -> Dataset:
        """Returns the dataset with priors drawn around the truth, see ``with_uniform_priors``."""
        return with_uniform_priors(dataset, self, seed)

    def draw(self, truth: Pose, generator: np.random.Generator) -> Pose:
        """Returns a prior around the truth; always six draws, so a width of 0 changes no other axis."""
        x, y, z, yaw, pitch, roll = generator.uniform(-1.0, 1.0, size=6)
        turns = (pitch * self.pitch_deg, roll * self.roll_deg, yaw * self.yaw_deg)
        wrong = EulerAngles(*(angle + turn for angle, turn in zip(truth.euler, turns, strict=True)))
        offset = np.array([x * self.x_m, y * self.y_m, z * self.z_m])
        return Pose.from_euler(wrong, truth.center + offset)

    def describe(self) -> str:
        """Returns the half widths in words, as a protocol prints them."""
        return (
            f"uniform around the truth: +-{self.x_m:g}/{self.y_m:g}/{self.z_m:g} m in x/y/z, "
            f"+-{self.yaw_deg:g} deg yaw, +-{self.pitch_deg:g}/{self.roll_deg:g} deg pitch/roll"
        )


def with_uniform_priors(dataset: Dataset, prior: UniformPrior, seed: int) -> Dataset:
    """Returns a dataset whose priors are drawn around the truth, one random stream per query.

    The stream does not know the widths: a wider prior errs in the same direction, only further. A
    query without a truth has none then: its own is no such draw.

    Raises:
        DatasetError: No query has a truth.
    """
    if not any(entry.key in dataset.truth for entry in dataset.entries):
        raise DatasetError(f"{dataset.name} has no true pose to draw priors around.", _NO_TRUTH_HINT)
    entries = []
    for entry in dataset.entries:
        if (truth := dataset.truth.get(entry.key)) is None:
            entries.append(entry.with_prior(None, ()))
        else:
            drawn = prior.draw(truth, random_stream(seed, dataset.name, entry.key, "prior"))
            entries.append(entry.with_prior(drawn, (drawn,)))
    return replace(dataset, entries=tuple(entries))


def photo_frame(dataset: Dataset) -> tuple[MapFrame, tuple[float, ...]]:
    """Returns the map frame of a dataset, and where its zero lies in it (east, north, up, metres).

    Raises:
        DatasetError: Nobody knows where it lies on Earth.
    """
    if dataset.photo_crs is not None:
        if dataset.photo_origin is None:
            raise DatasetError(
                f"Where {dataset.name} lies on Earth is withheld by its publishers.",
                f"Set `dataset.origin='[EAST,NORTH,HEIGHT]'` in {dataset.photo_crs}, or use `prior=file`.",
            )
        return MapFrame(dataset.photo_crs), dataset.photo_origin
    crs = None
    if dataset.city_model is not None:
        crs = open_cached_scene(
            dataset.city_model, lod=dataset.lod, options=dataset.city_options, roof_height=dataset.roof_height
        ).crs
    if crs is None:
        raise DatasetError(
            f"Where {dataset.name} lies on Earth is not known: its city model names no reference system.",
            "Set `dataset.crs=EPSG:CODE`, or use `prior=file`.",
        )
    return MapFrame(crs), (0.0, 0.0, 0.0)


_HEIGHTS = {"takeoff": "takeoff_m", "geoid": "geoid_m", "height_offset": "offset_m", "heights": "heights"}


def in_settings(text: Words) -> str:
    """Returns a message about heights of photos, in flags, with the settings of ``prior=sensor``.

    Example:
        >>> in_settings(Words("Leave `--takeoff` or `--heights sea_level` out."))
        'Leave `prior.takeoff_m` or `prior.heights=sea_level` out.'
    """

    def setting(option: Option) -> str:
        if option.name not in _HEIGHTS:
            return option.words
        return f"prior.{_HEIGHTS[option.name]}" + (f"={option.value}" if option.value else "")

    return text.rewritten(setting).marked


# How a file of priors begins.
_HEAD = "# priors "


class Priors(Protocol):
    """Gives each query of a dataset its prior; a frozen dataclass of settings."""

    name: ClassVar[str]

    def apply(self, dataset: Dataset, seed: int) -> Dataset:
        """Returns the dataset with these priors.

        Raises:
            LodbenchError: They cannot be had.
        """
        ...

    def describe(self) -> str:
        """Returns the protocol in words, as tables print it."""
        ...


@dataclass(frozen=True, slots=True)
class FilePrior:
    """The dataset's own priors, or those of a file.

    Attributes:
        path: A file of lines ``split/name qw qx qy qz tx ty tz`` as `lodbench dataset prior` writes; the
            split may be left out where names are unique. None for the dataset's own.
    """

    name: ClassVar[str] = "file"
    path: str | None = None

    def apply(self, dataset: Dataset, seed: int) -> Dataset:
        """Returns the dataset with these priors; a query the file lacks has none.

        Raises:
            DatasetError: The file is malformed, or a name in it means no query or several.
        """
        if self.path is None:
            return dataset
        poses = _by_key(Path(self.path).expanduser(), dataset.entries)
        return _with_priors(dataset, [poses.get(entry.key, ()) for entry in dataset.entries], Findings())

    def describe(self) -> str:
        """Returns the protocol in words."""
        return "file" if self.path is None else "of another file"


@dataclass(frozen=True, slots=True)
class SensorPrior:
    """What the photos themselves state: GPS position and gimbal angles.

    The steps are those of ``lodbench.photos.pose``: datum, projection, grid convergence, heights, the
    roll about the optical axis.

    Attributes:
        heights: ``auto``, ``sea_level``, ``ellipsoid`` or ``takeoff``; see ``HeightOptions``.
        takeoff_m: Height of the take-off point in the city's heights.
        geoid_m: Height of the city's zero above the ellipsoid.
        offset_m: Added in the end.
        fixes: A file of raw GNSS fixes by photo name (``read_fixes``), which go before photos' own places;
            angles stay the photos', or where they state none those of the dataset's own prior.
        fix_sigma_m: Standard deviation of fixes along each axis where the file states none.

    Raises:
        ConfigError: A height is not finite, or settings contradict each other.
    """

    name: ClassVar[str] = "sensor"
    heights: str = "auto"
    takeoff_m: float | None = None
    geoid_m: float | None = None
    offset_m: float = 0.0
    fixes: str | None = None
    fix_sigma_m: float | None = None

    def __post_init__(self) -> None:
        require_numbers(self, "prior", ("fix_sigma_m",), 0, ends="(]")
        require_numbers(self, "prior", ("takeoff_m", "geoid_m", "offset_m"), -math.inf)
        self._heights()

    def _heights(self) -> HeightOptions:
        try:
            kind = cast("HeightSource", self.heights)
            return HeightOptions(kind, self.takeoff_m, self.geoid_m, self.offset_m)
        except ConfigError as fault:
            raise ConfigError(in_settings(fault.message), in_settings(fault.hint)) from fault

    def apply(self, dataset: Dataset, seed: int) -> Dataset:
        """Returns the dataset with these priors; a photo that does not state all gives none, and is counted.

        Raises:
            DatasetError: The dataset's coordinates are not known on Earth, or no photo states its place.
        """
        frame, origin = photo_frame(dataset)
        heights = self._heights()
        fixes = None if self.fixes is None else read_fixes(Path(self.fixes).expanduser())
        priors, findings, reason = [], Findings(), DatasetError("no query has a photo")
        measured = list[Measurements | None]()
        for entry in dataset.entries:
            poses, stated = tuple[Pose, ...](), None
            try:
                stated = _stated(entry) if fixes is None else self._at_fix(entry, fixes)
                poses = (_pose_of(entry, stated, frame, heights).shifted([-value for value in origin]),)
            except DatasetError as error:
                reason = error
                findings.add(NO_PRIOR, entry.key, reason.message.rstrip("."))
            priors.append(poses)
            measured.append(None if stated is None else measured_of(stated, heights))
        if not any(priors):
            hint = in_settings(reason.hint) if "geoid" in reason.hint else "Use `prior=file`."
            raise DatasetError(f"No photo of {dataset.name} states a prior: {reason}", hint)
        updated = _with_priors(dataset, priors, findings)
        pairs = zip(updated.entries, measured, strict=True)
        return replace(updated, entries=tuple(replace(entry, measured=own) for entry, own in pairs))

    def _at_fix(self, entry: Entry, fixes: Mapping[str, Fix]) -> PhotoMetadata:
        """Returns what a photo states, with the place of its fix."""
        fix = fixes.get(entry.name)
        if fix is None:
            raise DatasetError(f"{self.fixes} has no fix of {entry.name}")
        width, height = (1, 1) if entry.camera is None else (entry.camera.width, entry.camera.height)
        own = PhotoMetadata(entry.name, width, height) if entry.image is None else _stated(entry)
        known = [self.fix_sigma_m if sigma is None else sigma for sigma in fix.sigmas]
        if fix.height_m is None:
            known[2] = own.sigmas[2]
        return replace(
            own,
            latitude_deg=fix.latitude_deg,
            longitude_deg=fix.longitude_deg,
            altitude_m=own.altitude_m if fix.height_m is None else fix.height_m,
            has_rtk=own.has_rtk and fix.height_m is None,
            sigmas=(*known, *own.sigmas[3:]),
        )

    def describe(self) -> str:
        """Returns the protocol in words."""
        extra = "" if self.offset_m == 0 else f" {self.offset_m:+g} m"
        source = "the photos' EXIF and XMP" if self.fixes is None else "raw fixes"
        return f"of {source}, heights {self.heights}{extra}"


def _stated(entry: Entry) -> PhotoMetadata:
    if (photo := entry.stored or entry.image) is None:
        raise DatasetError("there is no photo")
    return read_photo_metadata(photo)


def _pose_of(entry: Entry, stated: PhotoMetadata, frame: MapFrame, heights: HeightOptions) -> Pose:
    """Returns the pose that a photo states, turned as the query's own prior where it states no angles."""
    if stated.gimbal_yaw_deg is not None or entry.prior is None:
        return pose_from_photo(stated, frame, heights)
    at_place = pose_from_photo(stated, frame, heights, RoughPlace(heading_deg=0.0, pitch_deg=-90.0))
    return Pose.from_center(entry.prior.rotation, at_place.center)


@dataclass(frozen=True, slots=True)
class BasinPrior:
    """Errors of the convergence basin: one half width for x, y and z, the published ones in attitude.

    Attributes:
        range_m: Half width in x, y and z, metres; the paper takes 30, 50, 100 and 200.
        yaw_deg: Half width in yaw, degrees.
        tilt_deg: Half width in pitch and in roll, degrees; ``tilt=truth`` takes it away.

    Raises:
        ConfigError: A half width is negative or not finite.
    """

    name: ClassVar[str] = "basin"
    range_m: float = 30.0
    yaw_deg: float = 7.5
    tilt_deg: float = 1.0

    def __post_init__(self) -> None:
        require_numbers(self, "prior", ("range_m", "yaw_deg", "tilt_deg"), 0)

    @property
    def widths(self) -> UniformPrior:
        """Returns the half widths of all six."""
        return UniformPrior(*(self.range_m,) * 3, self.yaw_deg, self.tilt_deg, self.tilt_deg)

    def apply(self, dataset: Dataset, seed: int) -> Dataset:
        """Returns the dataset with priors drawn around the truth, see ``with_uniform_priors``."""
        return with_uniform_priors(dataset, self.widths, seed)

    def describe(self) -> str:
        """Returns the protocol in words."""
        return self.widths.describe()


def is_prior_text(file: Path) -> bool:
    """Tells whether a file begins as ``prior_text`` does."""
    with file.open("rb") as stream:
        return stream.read(len(_HEAD)) == _HEAD.encode()


def prior_text(entries: Sequence[Entry], describe: str, seed: int) -> str:
    """Returns priors as the text of a file, with how they were made and their digest in its head.

    A query with several hypotheses has a line for each, its prior first, as it is read back.
    """
    head = [f"{_HEAD}{describe}; seed {seed}; digest {prior_digest(entries)}"]
    lines = [
        format_pose(entry.key, pose)
        for entry in entries
        if entry.prior is not None
        for pose in entry.hypotheses or (entry.prior,)
    ]
    return lines_to_text([*head, *lines])


def prior_digest(entries: Sequence[Entry]) -> str:
    """Returns a digest of where a method starts."""
    return digest_of([[e.key, _numbers(e.prior), *map(_numbers, e.hypotheses[1:])] for e in entries])


def _numbers(pose: Pose | None) -> list[float] | None:
    return None if pose is None else pose.cam_from_world[:3].ravel().tolist()


def _by_key(path: Path, entries: Sequence[Entry]) -> dict[str, tuple[Pose, ...]]:
    keys, poses = dict[str, list[str]](), dict[str, tuple[Pose, ...]]()
    for entry in entries:
        for word in {entry.key, entry.name}:
            keys.setdefault(word, []).append(entry.key)
    for line in read_lines(path):
        owners = keys.get(line.name, [])
        if len(owners) != 1:
            meaning = f"may be any of {', '.join(owners)}" if owners else "is not a query of the dataset"
            raise DatasetError(f"{line.where}: {line.name} {meaning}.", "Write split/name.")
        poses[owners[0]] = (*poses.get(owners[0], ()), line.pose)
    return poses


def _with_priors(dataset: Dataset, priors: Sequence[Sequence[Pose]], findings: Findings) -> Dataset:
    """Returns a dataset with other priors, several per query or none."""
    entries = tuple(
        entry.with_prior(poses[0] if poses else None, tuple(poses))
        for entry, poses in zip(dataset.entries, priors, strict=True)
    )
    return replace(
        dataset,
        entries=entries,
        notes=dataset.notes + notes_of(findings),
        findings=dataset.findings + tuple(findings.items),
    )
