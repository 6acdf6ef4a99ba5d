"""Do the parts of a dataset contradict each other by themselves: cameras, photos' metadata and poses?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lodbench.citymodel.scene import Scene
from lodbench.datasets.camera_faults import crop_doubt, exchange_fault, field_fault
from lodbench.datasets.codes import (
    FIELD_OF_VIEW,
    FOCAL_UNLIKE_PHOTO,
    PRINCIPAL_EXCHANGED,
    PRINCIPAL_POINT,
    TRUTH_LIKE_PLAN,
    TRUTH_OFF_GPS,
)
from lodbench.datasets.map_frame import MapFrame
from lodbench.datasets.photo_camera import camera_from_photo
from lodbench.datasets.photo_metadata import PhotoMetadata, read_photo_metadata
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import DatasetError, LodbenchError
from lodbench.findings import Findings
from lodbench.geometry import Pose

# A focal length that differs by more from what a photo states is another one.
_SAME_FOCAL = 1.2
# So many true poses of a flight tell a plan by their heights and tilts to these: no drone flies so.
_LEAST_POSES, _SHARE, _PLAN_M, _PLAN_DEG = 8, 0.25, 0.001, 0.001
# GPS without corrections is within this nearly always, metres.
_GPS_M = 15.0


def check_parts(dataset: Dataset, scene: Scene | None, findings: Findings) -> None:
    """Adds to findings where cameras, photos and poses contradict each other.

    Args:
        dataset: As opened.
        scene: Its city, for its reference system; None without one.
        findings: Receives them, under the queries' names.
    """
    stated = {entry.key: _stated(entry) for entry in dataset.entries}
    for entry in dataset.entries:
        _check_camera(entry, stated[entry.key], findings)
    for split in dataset.splits:
        entries = [entry for entry in dataset.entries if entry.split == split and entry.key in dataset.truth]
        truths = [dataset.truth[entry.key] for entry in entries]
        if words := planned(truths):
            findings.add(TRUTH_LIKE_PLAN, split, words)
        crs = dataset.crs or (None if scene is None else scene.crs)
        if crs and (words := _off_gps([(stated[e.key], dataset.truth[e.key]) for e in entries], crs)):
            findings.add(TRUTH_OFF_GPS, split, words)


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
        (FIELD_OF_VIEW, field_fault),
        (PRINCIPAL_EXCHANGED, exchange_fault),
        (PRINCIPAL_POINT, crop_doubt),
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
        findings.add(FOCAL_UNLIKE_PHOTO, entry.key, f"{focal:.0f} px, its camera has {camera.fx:.4g}")


def _off_gps(pairs: Sequence[tuple[PhotoMetadata | None, Pose]], crs: str) -> str:
    """Returns in words how far true poses are from their photos' GPS; "" if near, or not known."""
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
