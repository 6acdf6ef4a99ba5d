"""How good are masks of real photos that a silhouette a little off has guided? By place, beside GrabCut."""

from __future__ import annotations

import sys
from argparse import ArgumentTypeError
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from experiments.command import run
from experiments.guided_masks.silhouettes import REFERENCE_PX, Disturbance, disturbed
from lodbench.bench import Figure, Progress, Report, no_progress
from lodbench.bench.mask_quality import one_core
from lodbench.bench.photo_masks import PhotoMask, labelled_photos, mean_and_interval, write_overlay
from lodbench.cli.options import segmenter_of
from lodbench.errors import ConfigError, DatasetError
from lodbench.params import flag
from lodbench.rendering.masks import signed_distance
from lodbench.reporting.aligned_text import format_columns
from lodbench.segmentation.map_guided import MapGuided, guided_mask, without_map
from lodbench.segmentation.masks import read_photo
from lodbench.synthesis.mask_degradation import mask_iou

Mask = NDArray[np.bool_]

# GrabCut's working size and rounds; it is reported how far off the silhouette is, and trusts it beyond.
_GRABCUT_PX, _GRABCUT_ROUNDS, _SURE = 600, 5, 1.5


@dataclass(frozen=True, slots=True)
class GuidedOptions:
    """What to measure.

    Attributes:
        disturbances: One line of the report each.
        draws: Silhouettes drawn for each photo.
        seed: Of the draws.
        has_grabcut: Whether OpenCV's GrabCut, seeded by the same silhouettes, is measured too.
    """

    disturbances: tuple[Disturbance, ...]
    draws: int = 4
    seed: int = 0
    has_grabcut: bool = False

    def __post_init__(self) -> None:
        if not 1 <= self.draws <= 1000:
            raise ConfigError(f"--draws {self.draws} is not within 1 to 1000.")


class GuidedPhoto(NamedTuple):
    """What became of one photo's silhouettes: IoUs with the traced mask, one of each draw.

    Attributes:
        place: Folder of the place.
        name: Of the photo.
        guide: Of the silhouettes.
        found: Of the segmenter's masks.
        grabcut: Of GrabCut's; empty where it was not requested.
        seconds: CPU time per mask.
    """

    place: str
    name: str
    guide: tuple[float, ...]
    found: tuple[float, ...]
    grabcut: tuple[float, ...]
    seconds: float


@dataclass(frozen=True, slots=True, eq=False)
class GuidedMaskReport:
    """What was measured.

    Attributes:
        segmenter: Its name.
        data: Name of the folder.
        draws: Silhouettes of each photo.
        photos: By disturbance.
        num_empty: Photos without buildings, which no silhouette can guide.
    """

    segmenter: str
    data: str
    draws: int
    photos: dict[Disturbance, list[GuidedPhoto]]
    num_empty: int

    def figures(self) -> list[Figure]:
        """Returns the mean IoU over photos and over places of each disturbance, GrabCut's beside it."""
        figures = []
        for disturbance, photos in self.photos.items():
            for words, means in (
                ("photos", _means(photos, "found")),
                ("places", _place_means(photos, "found")),
            ):
                peer = _means(photos, "grabcut") if words == "photos" else _place_means(photos, "grabcut")
                peer_value = float(np.mean(peer)) if peer else None
                name = f"IoU guided by {disturbance}, mean over {words}"
                figures.append(Figure(name, float(np.mean(means)), "", "GrabCut" if peer else "", peer_value))
        seconds = [photo.seconds for photos in self.photos.values() for photo in photos]
        return [*figures, Figure("CPU seconds per photo", float(np.median(seconds)), "s")]

    def to_text(self) -> str:
        """Returns a table of photos and one of disturbances, with 95 % intervals."""
        rows = [["guided by", "place", "photo", "silhouette", "worst", "mean IoU"]]
        sums = [["guided by", "silhouette", "GrabCut", "over photos", "(95 %)", "over places", "(95 %)"]]
        for disturbance, photos in self.photos.items():
            for p in photos:
                values = (float(np.mean(p.guide)), min(p.found), float(np.mean(p.found)))
                rows.append([str(disturbance), p.place, p.name, *(f"{v:.3f}" for v in values)])
            peer = _means(photos, "grabcut")
            sums.append(
                [
                    str(disturbance),
                    f"{np.mean(_means(photos, 'guide')):.3f}",
                    f"{np.mean(peer):.3f}" if peer else "-",
                    *mean_and_interval(_means(photos, "found")),
                    *mean_and_interval(_place_means(photos, "found")),
                ]
            )
        head = f"{self.segmenter} on {self.data}, {self.draws} silhouettes of each photo"
        if self.num_empty:
            head += f"; {self.num_empty} photos without buildings left out"
        return "\n".join([head, format_columns(rows), "", format_columns(sums)])


def measure_guided_masks(
    segmenter: MapGuided,
    folder: Path,
    options: GuidedOptions,
    progress: Progress = no_progress,
    pictures: Path | None = None,
) -> GuidedMaskReport:
    """Returns how well masks agree with traced ones if guided by silhouettes off by a known amount.

    A silhouette is the traced mask itself, moved and turned: what leaves the photo is lost.

    Raises:
        DatasetError: There are no photos with buildings, or one has no mask or one of another size.
        QueryFault: A photo or a mask cannot be read.
    """
    labelled = list(labelled_photos(folder))
    shown = [item for item in labelled if item[1].any()]
    if not shown:
        raise DatasetError(f"No photo of {folder} shows a building: there is no silhouette to be guided by.")
    report = GuidedMaskReport(
        segmenter.name,
        folder.name,
        options.draws,
        {d: [] for d in options.disturbances},
        len(labelled) - len(shown),
    )
    done = 0
    with one_core():
        for path, truth in shown:
            photo = read_photo(path)
            for disturbance, photos in report.photos.items():
                photos.append(_measured(segmenter, path, photo, truth, disturbance, options, pictures))
                done += 1
                progress(done, len(shown) * len(options.disturbances))
    return report


def _measured(
    segmenter: MapGuided,
    path: Path,
    photo: NDArray[np.uint8],
    truth: Mask,
    disturbance: Disturbance,
    options: GuidedOptions,
    pictures: Path | None,
) -> GuidedPhoto:
    place, ious, seconds = path.parent.parent.name, [], 0.0
    sure_px = _SURE * disturbance.shift_px * max(truth.shape) / REFERENCE_PX
    guides = disturbed(truth, disturbance, options.draws, options.seed, f"{place}/{path.stem}")
    for draw, guide in enumerate(guides):
        started = process_time()
        given = [without_map(guide, photo, segmenter.params)]
        probability = guided_mask(photo, given, segmenter.params).probability
        found = cv2.resize(probability, truth.shape[::-1], interpolation=cv2.INTER_LINEAR) >= 0.5
        seconds += process_time() - started
        peer = [mask_iou(_grabcut(photo, guide, sure_px), truth)] if options.has_grabcut else []
        ious.append((mask_iou(guide, truth), mask_iou(found, truth), *peer))
        if pictures is not None and draw == 0:
            folder = pictures / str(disturbance).replace(", ", "_").replace(" ", "")
            write_overlay(PhotoMask(place, path, truth, np.asarray(found), seconds), folder)
    guide_ious, found_ious, *peers = zip(*ious, strict=True)
    return GuidedPhoto(
        place, path.name, guide_ious, found_ious, peers[0] if peers else (), seconds / options.draws
    )


def _grabcut(photo: NDArray[np.uint8], guide: Mask, sure_px: float) -> Mask:
    """Returns OpenCV's GrabCut seeded by a silhouette; what lies so far from its outline is certain."""
    scale = min(1.0, _GRABCUT_PX / max(guide.shape))
    small = cv2.resize(photo[..., ::-1], None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    seed = cv2.resize(guide.astype(np.uint8), small.shape[1::-1], interpolation=cv2.INTER_NEAREST) > 0
    if not seed.any() or seed.all():
        return guide
    labels = np.where(seed, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    distance = signed_distance(seed)
    labels[distance > sure_px * scale] = cv2.GC_FGD
    labels[distance < -sure_px * scale] = cv2.GC_BGD
    cv2.setRNGSeed(0)
    outside, inside = np.zeros((1, 65)), np.zeros((1, 65))
    picture = np.ascontiguousarray(small)
    cv2.grabCut(picture, labels, (0, 0, 0, 0), outside, inside, _GRABCUT_ROUNDS, cv2.GC_INIT_WITH_MASK)
    found = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.float32)
    return np.asarray(cv2.resize(found, guide.shape[::-1], interpolation=cv2.INTER_LINEAR) >= 0.5)


def _means(photos: list[GuidedPhoto], what: str) -> list[float]:
    """Returns each photo's mean over its draws; empty where it was not measured."""
    return [float(np.mean(values)) for photo in photos if (values := getattr(photo, what))]


def _place_means(photos: list[GuidedPhoto], what: str) -> list[float]:
    places = dict.fromkeys(photo.place for photo in photos)
    found = [_means([photo for photo in photos if photo.place == place], what) for place in places]
    return [float(np.mean(means)) for means in found if means]


def _disturbance(text: str) -> Disturbance:
    try:
        shift_px, turn_deg = (float(part) for part in text.split(","))
    except ValueError:
        raise ArgumentTypeError(f"{text} is not PX,DEG, as in 20,2") from None
    if not (0 <= shift_px <= 1200 and 0 <= turn_deg <= 180):
        raise ArgumentTypeError(f"{text} is not within 0 to 1200 px and 0 to 180 deg")
    return Disturbance(shift_px, turn_deg)


@dataclass(frozen=True, kw_only=True)
class GuidedWords:
    """What is measured."""

    photos: Path = flag(..., "PLACE/photos with traced PLACE/masks", metavar="DIR")
    guided_by: tuple[Disturbance, ...] = flag(
        ...,
        "how far silhouettes are off, pixels of a photo 1200 wide; may be repeated",
        type=_disturbance,
        metavar="PX,DEG",
    )
    blocks: bool = flag(False, "also as blocks, a tenth of the buildings left out or added")
    draws: int = flag(4, "silhouettes of each photo (4)")
    grabcut: bool = flag(False, "measure OpenCV's GrabCut beside it")
    seed: int = flag(0, "of the silhouettes (0)")
    segmenter_option: tuple[str, ...] = flag((), "may be repeated", metavar="KEY=VALUE")
    pictures: Path | None = flag(None, "folder for pictures, if there are any", metavar="DIR")


def _measure(given: GuidedWords, steps: Progress) -> Report:
    segmenter = segmenter_of("map_guided", given.segmenter_option)
    assert isinstance(segmenter, MapGuided)  # noqa: S101
    blocks = [each._replace(is_blocks=True) for each in given.guided_by] if given.blocks else []
    disturbances = tuple(dict.fromkeys([*given.guided_by, *blocks]))
    options = GuidedOptions(disturbances, given.draws, given.seed, given.grabcut)
    found = measure_guided_masks(segmenter, given.photos, options, steps, given.pictures)
    return Report(found.to_text(), found.figures())


if __name__ == "__main__":
    sys.exit(run("guided_masks", GuidedWords, _measure))
