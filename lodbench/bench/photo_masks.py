"""How good are a segmenter's masks of real photos? IoU by place, and what is found where there is nothing."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

from lodbench.bench import Figure, Progress, no_progress
from lodbench.bench.mask_quality import (
    SHEET_FILE,
    draw_all,
    name_and_weights,
    one_core,
    predicted_mask,
    tinted,
)
from lodbench.citymodel.scene import Scene, build_scene
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import ConfigError, DatasetError
from lodbench.evaluation.pose_errors import Interval, bootstrap_means
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.photos.files import traced_mask, traced_photos
from lodbench.reporting.aligned_text import format_columns
from lodbench.reporting.overlays import write_picture
from lodbench.segmentation import Segmenter, notes_of
from lodbench.segmentation.masks import polygons_of, read_mask, read_photo
from lodbench.storage import random_stream, write_bytes

Mask = NDArray[np.bool_]
_WIDTH = 900
# Of masks traced by hand: white is building, grey is what could not be decided.
_BUILDING, _NOTHING = 0.75, 0.25
Points = NDArray[np.float64]
# How high photos hang, and what the widest side of each shows: a usual drone.
HEIGHT_M, SIDE_M = 100.0, 120.0
# Nothing of one photo is viewed from another.
_APART_M = 2000.0
# Share of the buildings that a wrong map lacks, and of what a photo shows of them at most: a map of one shed
# is of another place.
_MISSING, _MOST_MISSING = 0.08, 0.25
# How far roofs go on beyond the photo's edge, of its widest side.
_BEYOND = 0.1
# Smaller outlines are specks of a tracing.
_LEAST_M2 = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class PhotoMask:
    """One photo measured."""

    place: str  # folder of the place
    photo: Path  # its file
    truth: Mask  # (H, W) the true mask
    predicted: Mask  # (H, W) the segmenter's
    seconds: float  # CPU time from the file to the mask

    @property
    def is_empty(self) -> bool:
        """Returns whether the photo shows no building."""
        return not self.truth.any()

    @property
    def iou(self) -> float:
        """Returns intersection over union, which says nothing of an empty photo."""
        return float((self.truth & self.predicted).sum() / max(1, int((self.truth | self.predicted).sum())))

    @property
    def building_share(self) -> float:
        """Returns the share of the photo that was found to be building."""
        return float(self.predicted.mean())


@dataclass(frozen=True, slots=True, eq=False)
class PhotoMaskReport:
    """What was measured."""

    segmenter: str  # its name and the start of its weights' digest
    data: str  # name of the folder
    photos: tuple[PhotoMask, ...]  # by place and name
    notes: tuple[str, ...] = ()  # what the segmenter says of itself: on which photos it learnt, above all

    def by_place(self) -> dict[str, list[float]]:
        """Returns the IoUs of each place that shows buildings."""
        places: dict[str, list[float]] = {}
        for photo in self.photos:
            if not photo.is_empty:
                places.setdefault(photo.place, []).append(photo.iou)
        return places

    def empty(self) -> list[float]:
        """Returns the shares found in photos without buildings."""
        return [photo.building_share for photo in self.photos if photo.is_empty]

    def figures(self) -> list[Figure]:
        """Returns means over photos and over places, each place's, and the shares found in empty photos."""
        places, empty = self.by_place(), self.empty()
        figures = [Figure(f"IoU of {place}", float(np.mean(ious)), "") for place, ious in places.items()]
        if places:
            over_photos = [iou for ious in places.values() for iou in ious]
            over_places = [float(np.mean(ious)) for ious in places.values()]
            figures.append(Figure("IoU, mean over photos", float(np.mean(over_photos)), ""))
            figures.append(Figure("IoU, mean over places", float(np.mean(over_places)), ""))
        if empty:
            figures.append(Figure("share found in photos without buildings", float(np.mean(empty)), ""))
        seconds = float(np.median([photo.seconds for photo in self.photos]))
        return [*figures, Figure("CPU seconds per photo", seconds, "s")]

    def to_text(self) -> str:
        """Returns a table of photos and one of places, with 95 % intervals over photos."""
        photos = [["place", "photo", "IoU", "share found", "true share"]]
        for p in self.photos:
            iou = "-" if p.is_empty else f"{p.iou:.3f}"
            photos.append([p.place, p.photo.name, iou, f"{p.building_share:.3f}", f"{p.truth.mean():.3f}"])
        places = self.by_place()
        rows = [["", "photos", "mean IoU", "(95 %)"]]
        rows += [[place, str(len(ious)), *mean_and_interval(ious)] for place, ious in places.items()]
        if places:
            every = [iou for ious in places.values() for iou in ious]
            rows.append(["all photos", str(len(every)), *mean_and_interval(every)])
            rows.append(
                [
                    "all places",
                    str(len(places)),
                    *mean_and_interval([float(np.mean(i)) for i in places.values()]),
                ]
            )
        if self.empty():
            rows.append(
                ["share found where nothing is", str(len(self.empty())), *mean_and_interval(self.empty())]
            )
        tables = [format_columns(photos), "", format_columns(rows)]
        return "\n".join([f"{self.segmenter} on {self.data}", *tables, *self.notes])

    def write_pictures(self, folder: Path) -> None:
        """Writes an overlay per photo, see ``write_overlay``, and a sheet of all: ``masks.png``."""
        views = []
        for photo in self.photos:
            write_overlay(photo, folder)
            measured = (
                f"{100 * photo.building_share:.1f} % found" if photo.is_empty else f"IoU {photo.iou:.3f}"
            )
            picture = np.ascontiguousarray(read_photo(photo.photo)[..., ::-1])
            views.append(
                (f"{measured}  {photo.place}/{photo.photo.stem}", picture, photo.predicted, photo.truth)
            )
        write_bytes(folder / SHEET_FILE, draw_all(views, self.segmenter))


def write_overlay(photo: PhotoMask, folder: Path) -> None:
    """Writes a photo with the true outline white, what was wrongly found orange, what was missed violet."""
    # Traced masks are of their photo's size.
    canvas = tinted(read_photo(photo.photo)[..., ::-1], photo.predicted, photo.truth, 2)
    scale = min(1.0, _WIDTH / canvas.shape[1])
    small = cv2.resize(canvas, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    (folder / photo.place).mkdir(parents=True, exist_ok=True)
    write_picture(folder / photo.place / f"{photo.photo.stem}.png", np.asarray(small, dtype=np.uint8))


def labelled_photos(folder: Path) -> list[tuple[Path, Mask]]:
    """Returns the photos of a folder with their traced masks, (H, W) bool of the photo's size.

    What could not be decided counts as no building.

    Raises:
        DatasetError: There are no photos, or one has no mask or one of another size.
        QueryFault: A photo or a mask cannot be read.
    """
    labelled = []
    for photo, path in traced_photos(folder):
        truth = np.asarray(read_mask(path) > _BUILDING)
        if truth.shape != read_photo(photo).shape[:2]:
            raise DatasetError(f"{path} is not of its photo's size.")
        labelled.append((photo, truth))
    return labelled


def _unknown(photo: Path) -> Mask:
    """Returns where a photo's tracer could not tell: what is found there is neither right nor wrong."""
    traced = read_mask(traced_mask(photo))
    return np.asarray((traced > _NOTHING) & (traced <= _BUILDING))


def measure_photo_masks(
    segmenter: Segmenter, folder: Path, progress: Progress = no_progress
) -> PhotoMaskReport:
    """Returns how well a segmenter's masks of real photos agree with traced ones, where these know.

    Raises:
        DatasetError: There are no photos, or one has no mask or one of another size.
        QueryFault: A photo or a mask cannot be read.
    """
    labelled = labelled_photos(folder)
    measured = []
    with one_core():
        for number, (photo, truth) in enumerate(labelled, start=1):
            started = time.process_time()
            predicted = predicted_mask(segmenter, photo, truth.shape)
            seconds = time.process_time() - started
            predicted &= ~_unknown(photo)
            measured.append(PhotoMask(photo.parent.parent.name, photo, truth, predicted, seconds))
            progress(number, len(labelled))
    return PhotoMaskReport(name_and_weights(segmenter), folder.name, tuple(measured), notes_of(segmenter))


def mean_and_interval(values: list[float]) -> list[str]:
    """Returns a mean and its 95 % interval by bootstrap, as two cells; one value has no interval."""
    if len(values) == 1:
        return [f"{values[0]:.3f}", "-"]
    interval: Interval = bootstrap_means(np.array(values)[:, None])[0]
    return [f"{np.mean(values):.3f}", f"({interval[0]:.3f} to {interval[1]:.3f})"]


@dataclass(frozen=True, slots=True)
class TracedOptions:
    """How wrong the maps are."""

    # Outlines are simplified by so much, buildings moved by half of it and raised by it (standard
    # deviations), and one in twelve is missing, but at most a quarter of what a photo shows; 0 for the
    # outlines as traced.
    map_error_m: float = 0.5
    seed: int = 0  # of these errors

    def __post_init__(self) -> None:
        if not 0 <= self.map_error_m <= 10:
            raise ConfigError(f"--map-error {self.map_error_m} is not within 0 and 10 metres.")


def open_traced_photos(folder: Path, options: TracedOptions) -> tuple[Dataset, Scene]:
    """Returns the photos that show buildings as a dataset, a split per place, and their maps as one scene.

    Traced masks are their masks: by these a method shows what it makes of perfect ones.

    Raises:
        DatasetError: As ``labelled_photos``, or no photo shows a building.
        QueryFault: A photo or a mask cannot be read.
    """
    entries, truth = [], {}
    points, triangles, owners = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], []
    shown = [(photo, mask) for photo, mask in labelled_photos(folder) if mask.any()]
    for number, (photo, mask) in enumerate(shown):
        height, width = mask.shape
        focal = HEIGHT_M * max(width, height) / SIDE_M
        camera = Camera(width, height, focal, focal, width / 2, height / 2)
        place = photo.parent.parent.name
        generator = random_stream(options.seed, "traced photo", place, photo.name)
        above = np.array([number * _APART_M, 0.0, HEIGHT_M])
        for corners, faces in _plates(*_beyond(mask, camera), options.map_error_m, generator):
            triangles.append(faces + sum(map(len, points)))
            points.append(corners + above * (1.0, 1.0, 0.0))
            owners.append(len(faces))
        pose = Pose.from_euler(EulerAngles(0.0, 0.0, 0.0), above)
        entries.append(Entry(photo.name, place, camera, pose, photo, traced_mask(photo)))
        truth[entries[-1].key] = pose
    if not owners:
        raise DatasetError(f"No photo of {folder} shows a building.")
    names = tuple(f"outline {k}" for k in range(1, len(owners) + 1))
    building = np.repeat(np.arange(len(owners), dtype=np.int32), owners)
    scene = build_scene(np.concatenate(points), np.concatenate(triangles), building, names)
    places = tuple(dict.fromkeys(entry.split for entry in entries))
    return Dataset(folder.name, "", folder, None, None, places, tuple(entries), truth), scene


def _beyond(mask: NDArray[np.bool_], camera: Camera) -> tuple[NDArray[np.bool_], Camera]:
    """Returns a mask whose roofs go on beyond the photo's edges, as a map's do, and its camera.

    Ending there, they would tell how high the photo was taken.
    """
    margin = round(_BEYOND * max(mask.shape))
    return np.pad(mask, margin, mode="edge"), camera.with_margins(margin, margin)


def _plates(
    mask: NDArray[np.bool_], camera: Camera, map_error_m: float, generator: np.random.Generator
) -> Iterator[tuple[Points, NDArray[np.int64]]]:
    """Yields the corners, (N, 3) metres around the photo's middle, and triangles of each flat roof."""
    from shapely import MultiPolygon, Polygon
    from shapely.affinity import affine_transform, translate

    scale = HEIGHT_M / camera.fx
    # Pixels to metres, rows counted downwards; outlines run around pixels, not through their middles.
    to_metres = (scale, 0.0, 0.0, -scale, scale * (0.5 - camera.cx), -scale * (0.5 - camera.cy))
    may_miss = _MOST_MISSING * float(mask.sum()) * scale**2
    for part in polygons_of(mask):
        if len(part.outer) < 3:
            continue
        pixels = Polygon(part.outer, [hole for hole in part.holes if len(hole) > 2])
        roof = affine_transform(pixels.buffer(0.5, join_style="mitre"), to_metres)
        east, north, up = generator.normal(0.0, map_error_m, 3) * (0.5, 0.5, 1.0)
        is_missing = generator.random() < _MISSING and map_error_m > 0 and roof.area <= may_miss
        may_miss -= is_missing * roof.area
        if map_error_m > 0:
            roof = translate(roof.simplify(map_error_m), east, north)
        if roof.area < _LEAST_M2 or is_missing:
            continue
        for polygon in roof.geoms if isinstance(roof, MultiPolygon) else [roof]:
            rings = [np.asarray(ring.coords[:-1]) for ring in (polygon.exterior, *polygon.interiors)]
            plane = np.concatenate(rings)
            ends = np.cumsum([len(ring) for ring in rings]).astype(np.uint32)
            faces = mapbox_earcut.triangulate_float64(plane, ends).astype(np.int64).reshape(-1, 3)
            yield np.column_stack([plane, np.full(len(plane), up)]), faces
