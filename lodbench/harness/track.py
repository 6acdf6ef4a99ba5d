"""A video or a folder of photos over a city: where each frame was, when it was lost, and how fast."""

from __future__ import annotations

import csv
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.exchange.geojson import camera_feature, nowhere_feature, write_geojson
from lodbench.datasets.exchange.lines import write_lines
from lodbench.datasets.own import require_some_mask
from lodbench.datasets.pose_text import FoundPose
from lodbench.datasets.query import Query
from lodbench.errors import ConfigError, DatasetError, LodbenchError
from lodbench.execution import Progress
from lodbench.geometry import Pose
from lodbench.harness.city import open_city, require_near_city
from lodbench.harness.photo.prepare import RoughRequest, rough_camera, rough_pose
from lodbench.harness.tracebacks import kept_when_stopped
from lodbench.harness.track_frames import Footage, Mask, MaskMaker, Shot, with_masks
from lodbench.methods.localize import localize_next
from lodbench.methods.protocol import Follower
from lodbench.methods.tracking import LOST, Tracking, TrackingParams, state_of
from lodbench.photos.camera import PhotoCamera, pinhole_of
from lodbench.photos.files import in_pose_lines
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.measurements import place_notes
from lodbench.photos.metadata import PhotoMetadata, find_subtitles, read_photo_metadata, stated_at_start
from lodbench.segmentation import notes_of
from lodbench.storage import hide_formula, make_folder, random_stream, write_text

TABLE_FILE, MAP_FILE, POSES_FILE = "track.csv", "track.geojson", "poses.txt"
# Frames of all videos have the same names: only this tells whose they are.
SOURCE_COLUMN = "source"
# The same whatever was found.
TABLE_COLUMNS = (
    "frame", "time_s", "state", "score", "reason", SOURCE_COLUMN, "sigma_m", "sigma_deg", "probability",
    "latitude_deg", "longitude_deg", "height_m", "heading_deg", "pitch_deg", "roll_deg", "crs",
    "east", "north", "up",
)  # fmt: skip


def source_word(source: Path) -> str:
    """Returns what stands in the table for a video or a folder of photos."""
    return hide_formula(str(source.resolve()))


def require_no_other(out: Path, source: Path, names: Iterable[str]) -> None:
    """Refuses a folder that holds a track of other frames, or files of somebody else's under its names.

    Args:
        out: The folder, which need not be there.
        source: The video or folder of photos whose track is to be written.
        names: Of its frames, in order; perhaps without end.

    Raises:
        DatasetError: It does.
    """
    files = [out / name for name in (TABLE_FILE, MAP_FILE, POSES_FILE)]
    there = [file for file in files if file.exists()]
    if there and not _is_track_of(out / TABLE_FILE, source, names):
        raise DatasetError(
            f"{there[0]} is not of these frames of {source} and would be written over.",
            "Name another folder: `--out OTHER`",
        )


def _is_track_of(table: Path, source: Path, names: Iterable[str]) -> bool:
    """Tells whether a table's rows are the first of these frames: what replaces it has a row for each."""
    try:
        with table.open(encoding="utf-8", newline="") as stream:
            rows = [(row["frame"], row[SOURCE_COLUMN]) for row in csv.DictReader(stream)]
        expected = [(hide_formula(name), source_word(source)) for name in islice(names, len(rows))]
        return bool(rows) and rows == expected
    except (OSError, ValueError, KeyError, csv.Error):
        return False  # somebody else's, or of a version that did not say


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackRequest(RoughRequest):
    """What to track, and where its first frame is."""

    footage: Footage  # the frames
    # Folder of masks named as the frames, or None for the segmenter, a network that looks at pixels.
    masks: Path | None = None
    params: TrackingParams = field(default_factory=TrackingParams)  # of the tracker


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFrame:
    """What became of a frame."""

    name: str  # of the frame
    time_s: float  # when it was taken, seconds
    state: str  # ``tracked``, ``found again`` or ``lost``
    pose: Pose | None  # in the city's coordinates, None where it was lost
    score: float  # IoU of silhouette and mask
    reason: str  # why there is no mask, or ""
    # Standard deviations of its place, over all three axes (metres), and of its angles (degrees).
    sigmas: tuple[float, float] | None = None
    probability: float = 0.0  # of being within (2 m, 2 deg), as far as one frame tells; 0 where it was lost


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """What became of all frames."""

    frames: tuple[TrackedFrame, ...]  # in the order they were taken
    # Wall time of all frames but the first, in total and by what was done: ``masks`` goes on beside
    # ``poses``.
    seconds: dict[str, float]
    cpu_s: float  # processor time of the same
    out: Path | None  # folder written; None where no frame was found and the folder keeps an earlier track
    notes: tuple[str, ...]  # what the reader should know

    @property
    def rate(self) -> float:
        """Returns frames per second from pixels to pose, the first, which is searched for, aside."""
        return (len(self.frames) - 1) / max(self.seconds["total"], 1e-9)

    def lost(self) -> list[tuple[TrackedFrame, TrackedFrame]]:
        """Returns the first and the last frame of each time that the camera was lost."""
        spans: list[tuple[TrackedFrame, TrackedFrame]] = []
        for number, frame in enumerate(self.frames):
            if frame.pose is None:
                goes_on = number > 0 and self.frames[number - 1].pose is None
                spans.append((spans.pop()[0] if goes_on else frame, frame))
        return spans


def track(request: TrackRequest) -> Track:
    """Returns where each frame was taken; writes a table, a map and the poses.

    Raises:
        LodbenchError: The frames, the city or what is known of the first cannot be read, or the folder to be
            written holds something else. What was tracked until then is written, as where it is stopped.
    """
    require_no_other(request.out, request.footage.source, request.footage.names())
    city = open_city(request.city, request.lod, request.options, request.roof_height)
    scene = city.scene
    frame = None if scene.crs is None else MapFrame(scene.crs)
    camera, start, stated = _start(request, frame)
    require_near_city("The first frame was taken", [start], scene)
    pinhole = pinhole_of(camera.camera)
    maker = MaskMaker(camera.camera, pinhole, request.masks, request.segmenter)
    prior = start.shifted(-scene.origin)
    first = Query("", "", pinhole, prior, lens_percent=camera.lens_percent)
    frames: list[TrackedFrame] = []

    def keep() -> str:
        if all(each.pose is None for each in frames):
            return ""
        _write(frames, request, frame)
        return f"{len(frames)} frames were tracked until then"

    with kept_when_stopped(request.out, TABLE_FILE, keep, (KeyboardInterrupt, LodbenchError)):
        seconds, cpu_s = _follow(request, maker, first, CityMap(scene), frames)
    if request.masks is not None:
        require_some_mask(request.masks, [each.name for each in frames])
    notes = city.notes() + (notes_of(request.segmenter) if request.masks is None else ())
    notes += place_notes(frame, stated, request.heights) + tuple(request.footage.notes)
    if all(each.pose is None for each in frames) and (request.out / TABLE_FILE).exists():
        notes += (f"no frame was found: the earlier track in {request.out} is left as it is",)
        return Track(tuple(frames), seconds, cpu_s, None, notes)
    _write(frames, request, frame)
    return Track(tuple(frames), seconds, cpu_s, request.out, notes)


def _follow(
    request: TrackRequest, maker: MaskMaker, first: Query, city_map: CityMap, frames: list[TrackedFrame]
) -> tuple[dict[str, float], float]:
    """Adds frame after frame; returns the wall times and the processor time, as ``Track`` has them."""
    poses_s = started = cpu = masks_s = 0.0
    follower = Tracking(request.params).begin(first, city_map)
    with Progress("frames", None) as progress:
        for shot, mask in with_masks(request.footage.shots(), maker):
            began = time.perf_counter()
            frames.append(_tracked(follower, first, city_map, shot, mask))
            poses_s += time.perf_counter() - began
            if len(frames) == 1:
                # The first is searched for: what it takes says nothing of the rate.
                started, cpu, masks_s, poses_s = time.perf_counter(), time.process_time(), maker.seconds, 0.0
            progress.advance()
    seconds = {"total": time.perf_counter() - started, "masks": maker.seconds - masks_s, "poses": poses_s}
    return seconds, time.process_time() - cpu


def _tracked(
    follower: Follower, first: Query, city_map: CityMap, shot: Shot, mask: Mask | str
) -> TrackedFrame:
    if isinstance(mask, str):
        return TrackedFrame(shot.name, shot.time_s, LOST, None, 0.0, mask)
    query = replace(first, name=shot.name, time_s=shot.time_s, building_probability=mask)
    estimate = localize_next(follower, query, city_map, partial(random_stream, 0, "track", shot.name))
    state = state_of(estimate)
    pose = None if state == LOST else estimate.pose.shifted(city_map.scene.origin)
    sigmas = None if estimate.covariance is None else _sigmas(estimate.covariance)
    reported = state, pose, estimate.score, "", sigmas, estimate.probability or 0.0
    return TrackedFrame(shot.name, shot.time_s, *reported)


def _sigmas(covariance: NDArray[np.float64]) -> tuple[float, float]:
    """Returns the standard deviations of a place (metres) and of angles (degrees), over three axes each."""
    variances = np.diagonal(covariance)
    return float(np.sqrt(variances[:3].sum())), float(np.sqrt(variances[3:].sum()))


def _start(
    request: TrackRequest, frame: MapFrame | None
) -> tuple[PhotoCamera, Pose, tuple[PhotoMetadata, ...]]:
    """Returns the camera, the rough pose of the first frame (city's coordinates), and whose height it has."""
    first = request.footage.first_photo()
    if first is None:
        size = request.footage.video_size()
        if request.camera is None:
            raise ConfigError(
                "A video does not say its camera.", "Give `--camera 'SIMPLE_PINHOLE W H FOCAL_PX CX CY'`."
            )
        size = size or (request.camera.width, request.camera.height)
        stated = PhotoMetadata(request.footage.source.name, *size)
        subtitles = find_subtitles(request.footage.source)
        if subtitles is not None and (beside := stated_at_start(subtitles, stated)) != stated:
            stated = beside
            request.footage.notes.append(f"what {subtitles.name} states of the start was used")
    else:
        stated = read_photo_metadata(first)
    camera = rough_camera(request, stated, is_video=first is None)
    try:
        pose = rough_pose(request, stated, frame)
    except DatasetError as fault:
        if request.center is not None:
            raise
        # What it names are options of track, too.
        hint = fault.hint.marked.replace("lodbench localize takes", "Give")
        raise DatasetError(fault.message, hint) from fault
    has_height = request.center is not None or request.given.height_m is not None
    return camera, pose, () if has_height else (stated,)


def _write(frames: Sequence[TrackedFrame], request: TrackRequest, frame: MapFrame | None) -> None:
    out = request.out
    make_folder(out)
    write_text(out / TABLE_FILE, _table(frames, frame, request.footage.source))
    placed = [FoundPose(in_pose_lines(f.name), "", f.pose) for f in frames if f.pose is not None]
    write_lines(placed, out / POSES_FILE)
    if frame is not None:
        write_geojson([_feature(each, frame) for each in frames], out / MAP_FILE)


def _feature(each: TrackedFrame, frame: MapFrame) -> dict[str, Any]:
    stated: dict[str, Any] = {
        "name": each.name, "time_s": round(each.time_s, 3), "state": each.state, "score": round(each.score, 4)
    }  # fmt: skip
    if each.sigmas is not None:
        stated |= {"sigma_m": round(each.sigmas[0], 3), "sigma_deg": round(each.sigmas[1], 3)}
        stated["probability"] = round(each.probability, 3)
    return nowhere_feature(stated) if each.pose is None else camera_feature(frame, each.pose, stated)


def _table(frames: Sequence[TrackedFrame], frame: MapFrame | None, source: Path) -> str:
    import pandas as pd

    rows = []
    for each in frames:
        row: dict[str, Any] = dict.fromkeys(TABLE_COLUMNS) | {
            "frame": hide_formula(each.name), "time_s": each.time_s, "state": each.state,
            "score": each.score, "reason": hide_formula(each.reason), SOURCE_COLUMN: source_word(source),
        }  # fmt: skip
        if each.sigmas is not None:
            row |= dict(zip(("sigma_m", "sigma_deg"), each.sigmas, strict=True))
            row["probability"] = each.probability
        if each.pose is not None:
            row |= {} if frame is None else {**frame.place_of(each.pose)._asdict(), "crs": frame.crs}
            row |= dict(zip(("east", "north", "up"), map(float, each.pose.center), strict=True))
        rows.append(row)
    return str(pd.DataFrame(rows, columns=list(TABLE_COLUMNS)).to_csv(index=False, lineterminator="\n"))
