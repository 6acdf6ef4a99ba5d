"""Do the parts of a dataset contradict each other: cameras, masks, photos and true poses, by the city?

A silhouette drawn at a true pose says what the mask should show, and where the photo should have outlines.
What fits badly, and well once it is turned, exchanged or seen by another camera, is that mistake.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.datasets import faults
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import LodbenchError
from lodbench.evaluation.pose_errors import pose_error
from lodbench.execution import Progress
from lodbench.findings import FindingCode, Findings
from lodbench.geometry import Camera, Pose
from lodbench.photos.pictures import read_picture
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.segmentation import binary_mask
from lodbench.segmentation.masks import read_mask
from lodbench.storage import file_digest

Mask = NDArray[np.bool_]
Photo = NDArray[np.uint8]

# Views are compared at this width, pixels.
_WIDTH = 160
# Shares of a picture that a silhouette must have to tell anything.
_LEAST, _MOST = 0.02, 0.95
# IoU below which a mask is doubted, below which it hardly fits, and what another reading must have and gain.
_DOUBTFUL, _HARDLY, _FITS, _GAIN = 0.6, 0.3, 0.5, 0.2
# What focal lengths are mistaken by: other units, halves, a digital zoom.
_FACTORS = (0.25, 1 / 3, 0.5, 2 / 3, 0.8, 1.25, 1.5, 2.0, 3.0, 4.0)
# The mean rank of a photo's gradients on outlines is 0.5 where they are not its own. Below the first it is
# doubted: others' outlines must have the second, gain the third, by so many deviations of all others'. Below
# the next in the median the true poses are off the photos, if there are so many.
_NO_OUTLINES, _OUTLINES, _MORE, _DEVIATIONS, _RANDOM, _SEVERAL = 0.55, 0.57, 0.05, 5.0, 0.52, 8
_MOST_COMPARED = 2000
# Copies of a picture differ by less than this in the mean, of 255.
_SAME_GREY = 2.0
# Poses of one photo differ by less.
_SAME_M, _SAME_DEG = 0.5, 0.5

# Where one of them is said of a query, its photo has nothing to add.
_SAID = (faults.PHOTO_TWICE, faults.CAMERA_UNLIKE_VIEW, faults.MASK_UNLIKE_CITY)

_TURNS: dict[str, Callable[[Mask], Mask]] = {
    "mirrored": lambda mask: mask[:, ::-1],
    "upside down and mirrored": lambda mask: mask[::-1],
    "turned by 180 degrees": lambda mask: mask[::-1, ::-1],
    "turned by 90 degrees": lambda mask: np.rot90(mask),
    "turned by 270 degrees": lambda mask: np.rot90(mask, 3),
    "inverted": lambda mask: ~mask,
}


class Reading(NamedTuple):
    """How else a mask may be meant: the kind of mistake, in words what it is then, and its IoU."""

    code: FindingCode
    words: str
    iou: float


@dataclass(slots=True, eq=False)
class View:
    """A query as it should look by the city."""

    entry: Entry  # the query
    camera: Camera  # pinhole, ``_WIDTH`` pixels wide
    pose: Pose  # the true one, scene frame
    silhouette: Mask  # (H, W) of the city
    mask: Mask | None  # (H, W), the query's; None without one that can be read
    iou: float = 1.0  # of the two; 1 where there is no mask


class Views:
    """The queries of a dataset whose true view shows both buildings and something else."""

    def __init__(self, dataset: Dataset, entries: Sequence[Entry], scene: Scene) -> None:
        self._dataset, self._entries, self._scene = dataset, entries, scene
        self._renderer = SilhouetteRenderer(scene, threads=1)

    @cached_property
    def views(self) -> list[View]:
        """Returns them, drawn and with their masks."""
        with Progress("masks", len(self._entries)) as progress:
            views = []
            for entry in self._entries:
                view = self._view(entry)
                views += [view] if view is not None else []
                progress.advance()
        return views

    def _view(self, entry: Entry) -> View | None:
        truth, given = self._dataset.truth.get(entry.key), entry.camera
        if truth is None or given is None or given.distortion:
            return None
        width = min(_WIDTH, given.width)
        camera = given.scaled_to_width(width)
        pose = truth.shifted(-self._scene.origin)
        silhouette = self._renderer.render(camera, pose)
        if not _LEAST < silhouette.mean() < _MOST:
            return None
        view = View(entry, camera, pose, silhouette, _mask_of(entry, camera))
        view.iou = 1.0 if view.mask is None else _iou(silhouette, view.mask)
        return view

    def masked(self) -> list[View]:
        """Returns those with a mask."""
        return [view for view in self.views if view.mask is not None]

    def wrong_masks(self) -> Iterator[tuple[View, Reading]]:
        """Yields the views whose mask contradicts camera, pose or city, and how it is meant."""
        doubtful = [view for view in self.masked() if view.iou < _DOUBTFUL]
        for view in doubtful:
            best = max(self._readings(view, doubtful), key=lambda reading: reading.iou)
            if best.iou >= _FITS and best.iou >= view.iou + _GAIN:
                yield view, best
            elif view.iou < _HARDLY:
                yield view, Reading(faults.MASK_UNLIKE_CITY, "", view.iou)

    def _readings(self, view: View, doubtful: Sequence[View]) -> Iterator[Reading]:
        mask, silhouette = view.mask, view.silhouette
        assert mask is not None  # noqa: S101 - the caller has looked
        for words, turn in _TURNS.items():
            if (turned := turn(mask)).shape == silhouette.shape:
                yield Reading(faults.MASK_TURNED, words, _iou(silhouette, turned))
        for words, camera in _other_cameras(view.camera, view.entry):
            yield Reading(
                faults.CAMERA_UNLIKE_VIEW, words, _iou(self._renderer.render(camera, view.pose), mask)
            )
        for other in self.masked():
            if other is view or other.mask is None or other.mask.shape != mask.shape:
                continue
            # The mask is the other's, or a copy of it; a neighbour's view may fit better than a poor mask.
            is_exchanged = other in doubtful and _iou(other.silhouette, mask) >= _FITS
            if is_exchanged or np.array_equal(other.mask, mask):
                yield Reading(
                    faults.MASK_EXCHANGED, f"that of {other.entry.key}", _iou(other.silhouette, mask)
                )

    def wrong_photos(self) -> Iterator[tuple[FindingCode, str, str]]:
        """Yields photos without outlines where they should be: code, key (of all: the split), words."""
        shown = [view for view in self.views if view.entry.image is not None]
        own: dict[str, list[float]] = {split: [] for split in self._dataset.splits}
        with Progress("outlines", len(shown)) as progress:
            # Photos are compared with those of the same size, so many at a time, for memory.
            for size in {view.silhouette.shape for view in shown}:
                alike = [view for view in shown if view.silhouette.shape == size]
                for start in range(0, len(alike), _MOST_COMPARED):
                    pairs = []
                    for view in alike[start : start + _MOST_COMPARED]:
                        photo = _small_photo(view)
                        pairs += [] if photo is None else [(view, photo)]
                        progress.advance()
                    scores = _outline_scores(pairs)
                    for (view, _), score in zip(pairs, np.diag(scores), strict=True):
                        own[view.entry.split].append(float(score))
                    yield from self._photo_readings(pairs, scores)
        for split, mean_ranks in own.items():
            if len(mean_ranks) >= _SEVERAL and np.median(mean_ranks) < _RANDOM:
                words = f"mean rank of gradients there {np.median(mean_ranks):.2f}, 0.5 anywhere"
                yield faults.PHOTO_UNLIKE_CITY, split, words

    def _photo_readings(
        self, pairs: Sequence[tuple[View, Photo]], scores: NDArray[np.float64]
    ) -> Iterator[tuple[FindingCode, str, str]]:
        """Yields what photos are whose outlines are elsewhere: copies, others', of another camera."""
        own = np.diag(scores)
        others = np.where(np.eye(len(own), dtype=bool), np.nan, scores)
        least = np.maximum(_OUTLINES, own + _MORE)
        is_doubtful = own < _NO_OUTLINES
        if len(own) > 1:
            is_doubtful |= np.nanmax(others, axis=1) >= least
        if len(own) > _SEVERAL:
            least = np.maximum(least, np.nanmedian(others, axis=1) + _DEVIATIONS * _spread(others))
        for number in np.flatnonzero(is_doubtful).tolist():
            view, photo = pairs[number]
            copied = [other for other, picture in pairs if other is not view and _is_copy(photo, picture)]
            copied = [o for o in copied if not _is_same_place(self._dataset, view.entry, o.entry)]
            best = int(np.argmax(np.where(is_doubtful, np.nan_to_num(others[number]), 0.0)))
            score, words = self._best_camera(view, photo)
            if copied:
                yield faults.PHOTO_TWICE, view.entry.key, f"that of {copied[0].entry.key}"
            elif others[number, best] >= max(least[number], score):
                yield faults.PHOTO_EXCHANGED, view.entry.key, f"it is that of {pairs[best][0].entry.key}"
            elif score >= max(_OUTLINES, own[number] + _MORE):
                yield faults.CAMERA_UNLIKE_VIEW, view.entry.key, f"the photo's outlines are {words}"

    def _best_camera(self, view: View, photo: Photo) -> tuple[float, str]:
        """Returns the score of the other camera whose outlines a photo has best, and its words."""
        ranks = _gradient_ranks(photo)
        candidates = [(0.0, "")]
        for words, camera in _other_cameras(view.camera, view.entry):
            edges = _outline(self._renderer.render(camera, view.pose))
            candidates += [(float(ranks[edges].mean()), words)] if edges.any() else []
        return max(candidates)


def check_views(dataset: Dataset, scene: Scene | None, with_pixels: bool, findings: Findings) -> None:
    """Adds to findings where masks and photos contradict what the city looks like from the true poses.

    Args:
        dataset: As opened.
        scene: Its city; None without one.
        with_pixels: Whether masks and photos may be decoded; without, only copied files are found.
        findings: Receives them, under the queries' names.
    """
    pairs = same_photos(dataset, dataset.entries)
    for first, second in pairs:
        findings.add(faults.PHOTO_TWICE, second.key, f"that of {first.key}")
    if scene is None or not with_pixels:
        return
    views = Views(dataset, dataset.entries, scene)
    for view, reading in views.wrong_masks():
        findings.add(reading.code, view.entry.key, meaning_of(view, reading))
    known = {item.object_id for item in findings.items if item.code in _SAID}
    for code, key, words in views.wrong_photos():
        if key not in known:
            findings.add(code, key, words)


def same_photos(dataset: Dataset, entries: Iterable[Entry]) -> list[tuple[Entry, Entry]]:
    """Returns pairs of queries with different poses whose photos are the same file: the first and a copy."""
    by_size: dict[int, list[Entry]] = defaultdict(list)
    for entry in entries:
        if entry.image is not None and entry.image.is_file():
            by_size[entry.image.stat().st_size].append(entry)
    pairs = []
    for alike in by_size.values():
        first: dict[str, Entry] = {}
        for entry in alike if len(alike) > 1 else ():
            assert entry.image is not None  # noqa: S101 - the filter has looked
            known = first.setdefault(file_digest(entry.image), entry)
            if known is not entry and not _is_same_place(dataset, known, entry):
                pairs.append((known, entry))
    return pairs


def meaning_of(view: View, reading: Reading) -> str:
    """Returns in words how a mask is meant."""
    if not reading.words:
        return f"IoU {view.iou:.2f}"
    return f"IoU {view.iou:.2f}; {reading.iou:.2f} if it is {reading.words}"


def _is_same_place(dataset: Dataset, first: Entry, second: Entry) -> bool:
    """Tells whether two queries have one pose, the true one where both have it; without poses they do not."""
    poses = [dataset.truth.get(entry.key) for entry in (first, second)]
    if None in poses:
        poses = [entry.prior for entry in (first, second)]
    if poses[0] is None or poses[1] is None:
        return False
    apart = pose_error(poses[0], poses[1])
    return apart.translation_m < _SAME_M and apart.rotation_deg < _SAME_DEG


def _mask_of(entry: Entry, camera: Camera) -> Mask | None:
    if entry.mask is None:
        return None
    try:
        return binary_mask(read_mask(entry.mask), camera.width, camera.height)
    except LodbenchError:
        return None


def _other_cameras(camera: Camera, entry: Entry) -> Iterator[tuple[str, Camera]]:
    """Yields cameras that a camera may be meant as, in words and full-size pixels."""
    given = entry.camera
    assert given is not None  # noqa: S101 - a view has one
    for factor in _FACTORS:
        words = f"of a focal length of {given.fx * factor:.0f} px instead of {given.fx:.4g}"
        yield words, replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)
    scale = camera.width / given.width
    for words, cx, cy in (
        ("of a camera with cx and cy exchanged", given.cy * scale, given.cx * scale),
        ("of a camera with cx and cy in the middle", camera.width / 2, camera.height / 2),
    ):
        yield words, replace(camera, cx=cx, cy=cy)


def _iou(first: Mask, second: Mask) -> float:
    either = np.count_nonzero(first | second)
    return np.count_nonzero(first & second) / either if either else 1.0


def _outline(silhouette: Mask) -> Mask:
    edge = cv2.morphologyEx(silhouette.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
    return np.asarray(edge > 0)


def _small_photo(view: View) -> Photo | None:
    """Returns a view's photo, (H, W, 3) BGR as small as its camera; None if it is blank or cannot be read."""
    picture = None if view.entry.image is None else read_picture(view.entry.image)
    if picture is None:
        return None
    size = (view.camera.width, view.camera.height)
    small = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
    return small if small.std(axis=(0, 1)).max() > _SAME_GREY else None


def _is_copy(first: Photo, second: Photo) -> bool:
    """Tells whether two pictures differ by no more than their compression."""
    return float(cv2.absdiff(first, second).mean()) < _SAME_GREY


def _outline_scores(pairs: Sequence[tuple[View, Photo]]) -> NDArray[np.float64]:
    """Returns (N, N): the mean rank of each photo's gradients on each view's outlines."""
    if not pairs:
        return np.zeros((0, 0))
    edges = np.stack([_outline(view.silhouette).ravel() for view, _ in pairs]).astype(np.float32)
    edges /= np.maximum(edges.sum(axis=1, keepdims=True), 1)
    scores = [edges @ _gradient_ranks(photo).ravel().astype(np.float32) for _, photo in pairs]
    return np.array(scores, np.float64)


def _spread(others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the standard deviation of each row by its quartiles, which one outlier leaves alone."""
    low, high = np.nanpercentile(others, (25, 75), axis=1)
    return np.asarray((high - low) / 1.35)


def _gradient_ranks(small: Photo) -> NDArray[np.float64]:
    """Returns (H, W) how strong a picture's gradients are, as ranks from 0 to 1."""
    lab = cv2.GaussianBlur(cv2.cvtColor(small, cv2.COLOR_BGR2LAB).astype(np.float32), (0, 0), 1.0)
    strength = (cv2.Sobel(lab, cv2.CV_32F, 1, 0) ** 2 + cv2.Sobel(lab, cv2.CV_32F, 0, 1) ** 2).sum(axis=2)
    return np.asarray(scipy.stats.rankdata(strength).reshape(strength.shape) / strength.size)
