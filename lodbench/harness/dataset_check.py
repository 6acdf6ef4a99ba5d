"""Is a dataset sound: its files, counts, poses, priors, photos and city model, looked at one by one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lodbench.citymodel.crs import is_same_plane
from lodbench.citymodel.scene import Scene
from lodbench.datasets import faults
from lodbench.datasets.published.catalogue import SPECS
from lodbench.datasets.published.layout import Download
from lodbench.datasets.query import Dataset, Entry, repeated_keys
from lodbench.errors import DatasetError, LodbenchError, Words
from lodbench.evaluation.pose_errors import PoseError, pose_error
from lodbench.findings import Findings
from lodbench.geometry import Pose
from lodbench.geometry.angles import off_nadir_deg
from lodbench.harness.city import FURTHEST_M, city_of_dataset, distance_outside_m
from lodbench.harness.contradictions import check_views
from lodbench.harness.runs.requirements import check_photos
from lodbench.photos.camera import camera_from_photo
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.metadata import PhotoMetadata, read_photo_metadata
from lodbench.storage import file_digest

# A focal length that differs by more from what a photo states is another one.
_SAME_FOCAL = 1.2
# So many true poses of a flight tell a plan by their heights and tilts to these: no drone flies so.
_LEAST_POSES, _SHARE, _PLAN_M, _PLAN_DEG = 8, 0.25, 0.001, 0.001
# The ground is the lowest corner within so many metres, or of the nearest few; it slopes by up to 3 m.
_NEARBY_M, _FEW, _GROUND_M, _MOST_HEIGHTS = 50.0, 8, 3.0, 20
# GPS without corrections is within this nearly always, metres.
_GPS_M = 15.0
# Medians of a file that is the paper's agree to rounding; of another draw of the same kind to this.
_SAME_MEDIAN = 0.10


def check_parts(dataset: Dataset, scene: Scene | None, findings: Findings) -> None:
    """Adds to findings where cameras, photos and poses contradict each other."""
    stated = {entry.key: _stated(entry) for entry in dataset.entries}
    for entry in dataset.entries:
        _check_camera(entry, stated[entry.key], findings)
    for split in dataset.splits:
        entries = [entry for entry in dataset.entries if entry.split == split and entry.key in dataset.truth]
        truths = [dataset.truth[entry.key] for entry in entries]
        if words := planned(truths):
            findings.add(faults.TRUTH_LIKE_PLAN, split, words)
        crs = dataset.crs or (None if scene is None else scene.crs)
        if crs and (words := _off_gps([(stated[e.key], dataset.truth[e.key]) for e in entries], crs)):
            findings.add(faults.TRUTH_OFF_GPS, split, words)


def planned(truths: Sequence[Pose]) -> str:
    """Returns in words that the heights and tilts of true poses are as regular as no flight's; "" if not."""
    if len(truths) < _LEAST_POSES:
        return ""
    heights = np.array([pose.center[2] for pose in truths])
    tilts = np.array([(pose.euler.pitch_deg, pose.euler.roll_deg) for pose in truths])
    distinct_m = len(np.unique(np.round(heights / _PLAN_M)))
    distinct_deg = len(np.unique(np.round(tilts / _PLAN_DEG), axis=0))
    if max(distinct_m, distinct_deg) > max(1, _SHARE * len(truths)):
        return ""
    return f"{len(truths)} poses have {distinct_m} heights and {distinct_deg} tilts"


def _stated(entry: Entry) -> PhotoMetadata | None:
    if entry.image is None:
        return None
    try:
        return read_photo_metadata(entry.image)
    except DatasetError:
        return None


def _check_camera(entry: Entry, photo: PhotoMetadata | None, findings: Findings) -> None:
    camera = entry.camera
    if camera is None:
        return
    for code, fault_of in (
        (faults.FIELD_OF_VIEW, faults.field_fault),
        (faults.PRINCIPAL_EXCHANGED, faults.exchange_fault),
        (faults.PRINCIPAL_POINT, faults.crop_doubt),
    ):
        if fault := fault_of(camera):
            findings.add(code, entry.key, fault)
    if photo is None or (photo.width, photo.height) != (camera.width, camera.height):
        return
    try:
        focal = camera_from_photo(photo).camera.fx
    except DatasetError:
        return
    if not 1 / _SAME_FOCAL < camera.fx / focal < _SAME_FOCAL:
        findings.add(faults.FOCAL_UNLIKE_PHOTO, entry.key, f"{focal:.0f} px, its camera has {camera.fx:.4g}")


def _off_gps(pairs: Sequence[tuple[PhotoMetadata | None, Pose]], crs: str) -> str:
    away = []
    try:
        frame = MapFrame(crs)
        for photo, pose in pairs:
            if photo is not None and photo.latitude_deg is not None and photo.longitude_deg is not None:
                place = frame.east_north(photo.latitude_deg, photo.longitude_deg)
                away.append(float(np.hypot(*(pose.center[:2] - place))))
    except LodbenchError:
        return ""
    middle = float(np.median(away)) if away else 0.0
    return f"{middle:.0f} m in the median of {len(away)}" if middle > _GPS_M else ""


@dataclass(frozen=True, slots=True)
class SplitReport:
    """What a split holds."""

    name: str  # its name
    queries: int  # number of queries
    expected: int | None  # the number the paper's percentages imply, or the card says; or None
    truths: int  # queries with a true pose
    priors: int  # queries with a prior
    photos: int  # queries with a photo
    masks: int  # queries with a mask
    prior: PoseError | None  # median errors of the priors, or None without any
    paper_prior: tuple[float, float] | None  # the paper's, or None
    # Lowest, median and highest camera above the city's lowest point; None without a city.
    height_m: tuple[float, float, float] | None
    # Least, median and largest angle of optical axes from straight down; None without true poses.
    off_nadir_deg: tuple[float, float, float] | None


@dataclass(frozen=True, slots=True)
class DatasetReport:
    """The outcome of a check."""

    dataset: Dataset  # the dataset
    splits: tuple[SplitReport, ...]  # one report each
    city: str  # what the city model is, in words
    findings: Findings  # those of reading it, and of the check


def check_dataset(
    dataset: Dataset, *, with_pixels: bool = True, counts: Mapping[str, int] | None = None
) -> DatasetReport:
    """Returns what is in a dataset and what is wrong with it.

    Args:
        dataset: As opened.
        with_pixels: Whether to decode every photo; their headers are read in any case.
        counts: Queries by split as a plug-in's card has them.

    Raises:
        CityModelError: The city model is there, but cannot be read.
    """
    findings = Findings(list(dataset.findings))
    for key in repeated_keys(dataset.entries):
        findings.add(faults.KEY_TWICE, key)
    scene = None
    if dataset.city_model is None:
        known = SPECS.get(dataset.name)
        wanted = f"none of {', '.join(known.city_files)}" if known else Words(dataset.city_hint)
        findings.add(faults.FILE_MISSING, "city model", wanted)
    else:
        scene = city_of_dataset(dataset).scene
        _check_place(dataset, scene, findings)
        _check_views(dataset, scene, findings)
        _check_heights(dataset, scene, findings)
    _check_downloads(dataset, findings)
    check_photos(dataset, with_pixels, findings)
    check_parts(dataset, scene, findings)
    check_views(dataset, scene, with_pixels, findings)
    splits = tuple(_report_split(dataset, split, scene, counts or {}) for split in dataset.splits)
    for split in splits:
        _compare_with_paper(split, findings)
    return DatasetReport(dataset, splits, _city_in_words(dataset, scene), findings)


def prior_errors_in_words(dataset: Dataset) -> dict[str, str]:
    """Returns the median errors of the priors by split."""
    words = {}
    for split in dataset.splits:
        median = prior_median(dataset, split)
        has_prior = any(entry.prior is not None for entry in dataset.entries if entry.split == split)
        if median is not None:
            words[split] = f"median {median.translation_m:.2f} m / {median.rotation_deg:.2f} deg"
        else:
            words[split] = "errors not known, for there is no truth" if has_prior else "no prior"
    return words


def prior_median(dataset: Dataset, split: str) -> PoseError | None:
    """Returns the medians of both errors over a split's queries that have a prior and a truth."""
    errors = [
        pose_error(entry.prior, dataset.truth[entry.key])
        for entry in dataset.entries
        if entry.split == split and entry.prior is not None and entry.key in dataset.truth
    ]
    return PoseError(*np.median(np.array(errors), axis=0).tolist()) if errors else None


def _report_split(
    dataset: Dataset, split: str, scene: Scene | None, counts: Mapping[str, int]
) -> SplitReport:
    entries = [entry for entry in dataset.entries if entry.split == split]
    truths = [dataset.truth[entry.key] for entry in entries if entry.key in dataset.truth]
    known = SPECS.get(dataset.name)
    spec = next((part for part in known.splits if part.name == split), None) if known else None
    heights = tilts = None
    if truths:
        tilts = _spread([off_nadir_deg(pose.rotation) for pose in truths])
    if truths and scene is not None:
        ground = float(scene.extent_m[0][2] + scene.origin[2])
        heights = _spread([float(pose.center[2]) - ground for pose in truths])
    return SplitReport(
        name=split,
        queries=len(entries),
        expected=spec.num_queries if spec else counts.get(split),
        truths=len(truths),
        priors=sum(entry.prior is not None for entry in entries),
        photos=sum(entry.image is not None for entry in entries),
        masks=sum(entry.mask is not None for entry in entries),
        prior=prior_median(dataset, split),
        paper_prior=spec.prior_median if spec else None,
        height_m=heights,
        off_nadir_deg=tilts,
    )


def _spread(values: list[float]) -> tuple[float, float, float]:
    return float(np.min(values)), float(np.median(values)), float(np.max(values))


def _compare_with_paper(split: SplitReport, findings: Findings) -> None:
    if split.expected is not None and split.truths != split.expected:
        findings.add(
            faults.COUNT_UNEXPECTED, split.name, f"{split.truths} with a true pose, not {split.expected}"
        )
    if split.paper_prior is None or split.prior is None:
        return
    ratios = [prior / paper for prior, paper in zip(split.prior, split.paper_prior, strict=True)]
    if any(abs(ratio - 1) > _SAME_MEDIAN for ratio in ratios):
        prior, paper = split.prior, split.paper_prior
        detail = f"{prior[0]:.2f} m / {prior[1]:.2f} deg, paper {paper[0]:g} / {paper[1]:g}"
        findings.add(faults.PRIORS_UNLIKE_PAPER, split.name, detail)


def _check_place(dataset: Dataset, scene: Scene, findings: Findings) -> None:
    """Looks whether the poses are in the city's coordinates, and the priors near it."""
    if dataset.crs is not None and scene.crs is not None and not is_same_plane(dataset.crs, scene.crs):
        findings.add(faults.CRS_DIFFERS, dataset.name, f"{dataset.crs}, city model {scene.crs}")
        return  # a distance between coordinates of two systems is none
    for entry in dataset.entries:
        away = 0.0 if entry.prior is None else distance_outside_m(entry.prior, scene)
        if away > FURTHEST_M:
            findings.add(faults.PRIOR_FAR, entry.key, f"{away / 1000:.1f} km")


def _check_views(dataset: Dataset, scene: Scene, findings: Findings) -> None:
    """Looks whether the city lies before the cameras, and above its ground."""
    corners, lowest = faults.sample_corners(scene), float(scene.extent_m[0][2] + scene.origin[2])
    for split in dataset.splits:
        entries = [entry for entry in dataset.entries if entry.split == split]
        sets = {
            "true poses": [(entry.camera, dataset.truth.get(entry.key)) for entry in entries],
            "priors": [(entry.camera, entry.prior) for entry in entries],
        }
        wrong = {what: faults.suspect_direction(pairs, corners, scene.origin) for what, pairs in sets.items()}
        for what, words in wrong.items():
            if words is not None:
                findings.add(faults.WRONG_DIRECTION, f"{split}: {what}", words)
        if wrong["true poses"] is not None:
            continue  # one finding says it; a line per pose would hide it
        for entry in entries:
            truth = dataset.truth.get(entry.key)
            if truth is not None and truth.center[2] < lowest:
                findings.add(faults.BELOW_CITY, entry.key, f"{lowest - truth.center[2]:.1f} m")
            if truth is not None and entry.camera is not None:
                if not faults.sees(entry.camera, truth.shifted(-scene.origin), corners):
                    findings.add(faults.CITY_NOT_IN_VIEW, entry.key)


def _check_heights(dataset: Dataset, scene: Scene, findings: Findings) -> None:
    """Compares the cameras' heights above the ground of buildings nearby with those that they can have."""
    known = SPECS.get(dataset.name)
    centres = [pose.center - scene.origin for pose in dataset.truth.values()]
    if known is None or known.camera_height_m is None or not centres:
        return
    corners = scene.vertices.astype(np.float64)
    above = []
    for centre in centres[:: max(1, len(centres) // _MOST_HEIGHTS)]:
        away = np.hypot(*(corners[:, :2] - centre[:2]).T)
        near = corners[away <= max(_NEARBY_M, float(np.sort(away)[:_FEW][-1]))]
        above.append(float(centre[2] - near[:, 2].min()))
    middle, (low, high) = float(np.median(above)), known.camera_height_m
    if not low - _GROUND_M <= middle <= high + _GROUND_M:
        findings.add(
            faults.HEIGHTS_UNLIKE, dataset.name, f"{middle:.1f} m in the median, not {low:g} to {high:g} m"
        )


def _check_downloads(dataset: Dataset, findings: Findings) -> None:
    """Compares files that have a published checksum with it."""
    known = SPECS.get(dataset.name)
    for download in known.downloads if known else ():
        for path in _named_as(download, dataset):
            if file_digest(path) != download.sha256:
                findings.add(faults.CHECKSUM_DIFFERS, str(path), f"published: {download.sha256}")


def _named_as(download: Download, dataset: Dataset) -> list[Path]:
    city = dataset.city_model
    return [city] if city is not None and city.name == Path(download.path).name else []


def _city_in_words(dataset: Dataset, scene: Scene | None) -> str:
    if scene is None or dataset.city_model is None:
        return "none"
    known = SPECS.get(dataset.name)
    lod = scene.lod or (f"{known.lod} by its publishers" if known else "not stated")
    low, high = scene.extent_m
    size = dataset.city_model.stat().st_size / 2**20 if dataset.city_model.is_file() else 0
    return (
        f"{dataset.city_model}{f', {size:.1f} MiB' if size else ''}, level of detail {lod}, "
        f"{scene.num_buildings} buildings, {high[0] - low[0]:.0f} x {high[1] - low[1]:.0f} m"
    )
