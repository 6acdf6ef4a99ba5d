"""How good are a segmenter's masks? IoU over the views of a training set, and of what is visible at best."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.bench import Figure, Progress, Report, no_progress
from lodbench.errors import ConfigError, DatasetError, LodbenchError, nearest_names, require_within
from lodbench.evaluation.pose_errors import Interval, bootstrap_means, bootstrap_ratio
from lodbench.reporting.aligned_text import format_columns
from lodbench.reporting.overlays import draw_outline, png_bytes
from lodbench.segmentation import Segmenter, binary_mask, notes_of
from lodbench.segmentation.masks import read_mask, read_photo
from lodbench.segmentation.photo_segmenter import photo_probability
from lodbench.storage import digest_of, file_digest
from lodbench.storage.disk import writable
from lodbench.storage.paths import cache_root
from lodbench.synthesis import generate
from lodbench.synthesis.camera_paths import GenerateParams
from lodbench.synthesis.demo import DemoParams, DemoTrainParams, demo_folder
from lodbench.synthesis.generate import generate_training_data
from lodbench.synthesis.town.build import FINE_CITY_FILE, PROPS_FILE
from lodbench.training.samples import Sample, find_samples

if TYPE_CHECKING:
    import pandas as pd

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]
SHEET_FILE = "masks.png"
_PER_GROUP, _TILE = 4, 448
# BGR: distinguished with any colour vision, on roofs and on green.
_EXTRA, _MISSED, _OUTLINE = (30, 120, 255), (255, 60, 190), (255, 255, 255)
_INK, _PAPER = (235, 235, 235), (32, 28, 26)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
# Kinds of overlaps by the name of their columns; their names in figures, and in words.
KINDS = {
    "mask": ("mask_iou", "IoU with the mask"),
    "ceiling": ("mask_iou_ceiling", "  ceiling: what is visible of it"),
    "visible": ("visible_iou", "IoU with the visible part"),
}
_SPLITS = ("train", "val", "test")
# A visible part may lie outside its mask by this share of the view: none but for a file's rounding.
_STRAY_SHARE = 1e-3
_SAME_VIEWS = "Make it with the same settings and seed, and occluders_in_mask=true images=false."
TOWNS: dict[str, DemoParams] = {"test": DemoParams(), "train": DemoTrainParams()}
# Draws per view that is kept; what else a view must show is in ``_settings``.
_DRAWS = 2.5
_SEED = 7


def draw_sheet(views: pd.DataFrame, title: str) -> dict[str, bytes]:
    """Returns the sheet, ``masks.png``: rows of worst, median and best views.

    The true mask's outline is white; what was found beside it is orange, what was missed violet.
    """
    ious = (views["mask shared"] / views["mask union"].clip(lower=1)).rename("iou")
    ordered = views.join(ious).sort_values(["iou", "key"])
    count = min(_PER_GROUP, len(ordered))
    middle = (len(ordered) - count) // 2
    groups = {"worst": ordered[:count], "median": ordered[middle : middle + count], "best": ordered[-count:]}
    rows = [np.hstack([_tile(name, view) for _, view in mine.iterrows()]) for name, mine in groups.items()]
    return {SHEET_FILE: png_bytes(np.vstack([_legend(title, rows[0].shape[1]), *rows]))}


def draw_all(views: Sequence[tuple[str, Picture, Mask, Mask]], title: str) -> bytes:
    """Returns a sheet of all views as PNG, in their order; colours as in ``draw_sheet``.

    Args:
        views: Caption, (H, W, 3) BGR photo, and (H, W) found and true mask of each.
        title: Whose masks of what.
    """
    tiles = [_captioned(caption, tinted(photo, guess, truth, 3)) for caption, photo, guess, truth in views]
    blank = np.full_like(tiles[0], _PAPER)
    columns = min(_PER_GROUP, len(tiles))
    tiles += [blank] * (-len(tiles) % columns)
    rows = [np.hstack(tiles[first : first + columns]) for first in range(0, len(tiles), columns)]
    return png_bytes(np.vstack([_legend(title, rows[0].shape[1]), *rows]))


def tinted(photo: Picture, guess: NDArray[np.bool_], truth: NDArray[np.bool_], thickness: int) -> Picture:
    """Returns an (H, W, 3) BGR photo with its true outline, and what is wrongly found or missed tinted."""
    canvas = np.ascontiguousarray(photo)
    for wrong, colour in ((guess & ~truth, _EXTRA), (truth & ~guess, _MISSED)):
        canvas[wrong] = (0.35 * canvas[wrong] + 0.65 * np.array(colour)).astype(np.uint8)
    draw_outline(canvas, truth, _OUTLINE, thickness)
    return canvas


def _tile(group: str, view: pd.Series[Any]) -> Picture:
    """Returns a view's photo with what is wrong tinted, and a line of text below; all of one size."""
    truth = read_mask(view["mask"]) >= 0.5
    height, width = truth.shape
    photo = cv2.resize(read_photo(view["photo"])[..., ::-1], (width, height), interpolation=cv2.INTER_AREA)
    caption = f"{group}: IoU {view['iou']:.3f}  {view['key']}"
    return _captioned(caption, tinted(np.asarray(photo, np.uint8), view["found"], truth, 1))


def _captioned(caption: str, picture: Picture) -> Picture:
    """Returns a picture framed, with a line of text below; all of one size."""
    framed = _framed(picture, _TILE, _TILE * 3 // 4)
    strip = np.full((24, _TILE, 3), _PAPER, np.uint8)
    cv2.putText(strip, writable(caption), (6, 17), _FONT, 0.42, _INK, 1, cv2.LINE_AA)
    return np.pad(np.vstack([framed, strip]), ((2, 2), (2, 2), (0, 0)))


def _framed(picture: Picture, width: int, height: int) -> Picture:
    """Returns a picture in the middle of a frame, as large as it fits."""
    factor = min(width / picture.shape[1], height / picture.shape[0])
    inner = max(1, round(factor * picture.shape[1])), max(1, round(factor * picture.shape[0]))
    small = cv2.resize(picture, inner, interpolation=cv2.INTER_AREA)
    framed = np.full((height, width, 3), _PAPER, np.uint8)
    top, left = (height - inner[1]) // 2, (width - inner[0]) // 2
    framed[top : top + inner[1], left : left + inner[0]] = small
    return framed


def _legend(title: str, width: int) -> Picture:
    strip = np.full((34, width, 3), _PAPER, np.uint8)
    x = 8
    for words, colour in (
        (title, None),
        ("outline of the true mask", _OUTLINE),
        ("found, not in the mask", _EXTRA),
        ("in the mask, not found", _MISSED),
    ):
        if colour is not None:
            cv2.line(strip, (x, 17), (x + 22, 17), colour, 5)
            x += 30
        cv2.putText(strip, words, (x, 22), _FONT, 0.5, _INK, 1, cv2.LINE_AA)
        x += 26 + int(cv2.getTextSize(words, _FONT, 0.5, 1)[0][0])
    return strip


class IouSummary(NamedTuple):
    """Overlaps of many views."""

    mean: float  # mean of the views' IoUs
    mean_interval: Interval  # 95 % interval of it, by bootstrap over views
    pooled: float  # IoU of all pixels together
    pooled_interval: Interval  # likewise


def report_masks(views: pd.DataFrame, which: str, segmenter: str, notes: Sequence[str]) -> Report:
    """Returns the report of views: a table, the time per photo, and what must be known of the segmenter.

    Args:
        views: A row per view: ``key`` (split and name), ``photo`` and ``mask`` (their files), ``found``
            ((H, W) bool, what the segmenter made), ``seconds`` (CPU time from the file to the mask), and for
            each kind of ``KINDS`` there is its ``shared`` and ``union``, pixels in both masks and in either.
        which: Views and their data in words.
        segmenter: Its name.
        notes: What the segmenter says of itself.
    """
    summaries = {kind: summary_of(views, kind) for kind in KINDS if f"{kind} shared" in views}
    seconds = float(views["seconds"].median())
    cells = [["", "mean per view", "(95 %)", "pooled", "(95 %)"]]
    figures = []
    for kind, s in summaries.items():
        name, words = KINDS[kind]
        figures += [Figure(f"{name}_mean", s.mean, ""), Figure(f"{name}_pooled", s.pooled, "")]
        mean, pooled = f"{s.mean:.3f}", f"{s.pooled:.3f}"
        cells.append([words, mean, in_words(s.mean_interval), pooled, in_words(s.pooled_interval)])
    figures += [Figure("views", float(len(views)), ""), Figure("cpu_seconds_per_photo", seconds, "s")]
    time = f"{1000 * seconds:.0f} ms a photo on one core, from file to mask (median CPU time)"
    text = "\n".join([which, format_columns(cells), time, *(f"note: {note}" for note in notes)])
    return Report(text, figures, views, partial(draw_sheet, views, f"{segmenter} on {len(views)} views"))


def summary_of(views: pd.DataFrame, kind: str) -> IouSummary:
    """Returns mean and pooled IoU of some views, of a kind of overlap, with their intervals."""
    shared, union = (views[f"{kind} {part}"].to_numpy(np.float64) for part in ("shared", "union"))
    union = np.maximum(union, 1.0)
    ious = shared / union
    return IouSummary(
        mean=float(ious.mean()),
        mean_interval=bootstrap_means(ious[:, None])[0],
        pooled=float(shared.sum() / union.sum()),
        pooled_interval=bootstrap_ratio(shared, union),
    )


def in_words(interval: Interval) -> str:
    """Returns ``(0.881 to 0.902)``."""
    return f"({interval[0]:.3f} to {interval[1]:.3f})"


@dataclass(frozen=True, slots=True)
class MaskQualityOptions:
    """What to measure."""

    data: Path  # training set with photos and masks, or a folder of such sets; all splits count
    # The same set with ``occluders_in_mask=true``: masks without what trees and cars cover; None to
    # leave the ceiling out.
    visible: Path | None = None
    # Views with fewer buildings in them do not count: one wrong shed halves their IoU.
    least_share: float = 0.05

    def __post_init__(self) -> None:
        require_within("least_share", self.least_share, 0, 1)


class _Truth(NamedTuple):
    mask: Mask
    visible: Mask | None


def measure_masks(
    segmenter: Segmenter, options: MaskQualityOptions, progress: Progress = no_progress
) -> Report:
    """Returns how well a segmenter's masks agree with those of a training set, and how long one takes.

    Masks are compared at their own size, thresholded as a run does. Nothing is taken from the cache.

    Raises:
        LodbenchError: A set is missing or broken, or the two sets do not show the same views.
    """
    import pandas as pd

    samples = [sample for split in _SPLITS for sample in find_samples(options.data, split)]
    if not samples:
        raise DatasetError(f"{options.data} holds no views.", "lodbench generate-training-data makes some.")
    views = []
    with one_core():
        for number, sample in enumerate(samples, start=1):
            truth = _truth(sample, options)
            if truth.mask.mean() >= options.least_share:
                views.append(_measured(segmenter, sample, truth))
            progress(number, len(samples))
    if not views:
        raise DatasetError(
            f"None of the {len(samples)} views of {options.data} shows "
            f"{100 * options.least_share:g} % buildings or more."
        )
    height, width = views[0]["found"].shape
    which = (
        f"{name_and_weights(segmenter)}: {len(views)} of the {len(samples)} "
        f"views of {options.data.name}, those with {100 * options.least_share:g} % buildings or more, "
        f"{width} x {height}"
    )
    return report_masks(pd.DataFrame(views), which, segmenter.name, notes_of(segmenter))


@contextmanager
def one_core() -> Iterator[None]:
    """Lets OpenCV, and torch if it is loaded, compute on one core."""
    torch, threads = sys.modules.get("torch"), cv2.getNumThreads()
    torch_threads = torch.get_num_threads() if torch else 0
    cv2.setNumThreads(1)
    if torch:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
        if torch:
            torch.set_num_threads(torch_threads)


def name_and_weights(segmenter: Segmenter) -> str:
    """Returns a segmenter's name with the first digits of its weights' digest; a plug-in may tell none."""
    digest = getattr(segmenter, "weights_digest", "")
    return f"{segmenter.name}, weights {digest[:12]}" if digest else segmenter.name


def predicted_mask(segmenter: Segmenter, photo: Path, shape: Sequence[int]) -> Mask:
    """Returns the (H, W) mask that a segmenter makes of a photo, at the size of its true mask."""
    return binary_mask(photo_probability(segmenter, photo), shape[1], shape[0])


def _measured(segmenter: Segmenter, sample: Sample, truth: _Truth) -> dict[str, Any]:
    """Returns a row as ``report_masks`` wants it."""
    started = time.process_time()
    guess = predicted_mask(segmenter, sample.photo, truth.mask.shape)
    seconds = time.process_time() - started
    row = {"key": sample.key, "photo": sample.photo, "mask": sample.mask, "found": guess, "seconds": seconds}
    row |= _overlap("mask", guess, truth.mask)
    if truth.visible is not None:
        row |= _overlap("ceiling", truth.visible, truth.mask) | _overlap("visible", guess, truth.visible)
    return row


def _truth(sample: Sample, options: MaskQualityOptions) -> _Truth:
    mask = _read(sample.mask)
    if options.visible is None:
        return _Truth(mask, None)
    path = options.visible / sample.mask.relative_to(options.data)
    if not path.is_file():
        raise DatasetError(f"{options.visible} has no mask of {sample.key}.", _SAME_VIEWS)
    visible = _read(path)
    if visible.shape != mask.shape or (visible & ~mask).mean() > _STRAY_SHARE:
        raise DatasetError(f"{path} is not the visible part of {sample.mask}.", _SAME_VIEWS)
    return _Truth(mask, visible)


def _read(path: Path) -> Mask:
    try:
        return np.asarray(read_mask(path) >= 0.5)
    except LodbenchError as fault:
        raise DatasetError(f"{path}: {fault.message}", "Delete it and generate the set again.") from fault


def _overlap(kind: str, first: Mask, second: Mask) -> dict[str, int]:
    return {f"{kind} shared": int((first & second).sum()), f"{kind} union": int((first | second).sum())}


class TownSets(NamedTuple):
    """Two training sets of the same views."""

    data: Path
    visible: Path


def town_sets(town: str, num_views: int, workers: int | None = None) -> TownSets:
    """Returns views of a town with masks, and the visible parts of these masks.

    Args:
        town: ``test``, whose look no training has seen, or ``train``.
        num_views: So many views, fewer where not so many show buildings.
        workers: Processes; None for one per core.

    Raises:
        LodbenchError: There is no such town, the number is none, or the cache cannot be written.
    """
    if town not in TOWNS:
        raise ConfigError(f"There is no town {town}.", nearest_names(town, TOWNS))
    if num_views < 1:
        raise ConfigError(f"views={num_views} is not a number of views.")
    root = demo_folder(TOWNS[town])
    folder = cache_root() / "bench" / f"{town}-town-{num_views}-views-{_digest(root)}"
    params = _settings(root, folder / f"{town}-town", num_views, workers)
    visible = replace(params, out=str(folder / "visible"), occluders_in_mask=True, images=False)
    for wanted in (params, visible):
        generate_training_data(wanted)
    return TownSets(Path(params.out), Path(visible.out))


def _settings(root: Path, out: Path, num_views: int, workers: int | None) -> GenerateParams:
    return GenerateParams(
        city=str(root / FINE_CITY_FILE),
        out=str(out),
        lod="3",
        props=str(root / PROPS_FILE),
        sampling="random",
        pitch=[20.0, 30.0, 40.0, 50.0, 60.0],
        height=[70.0, 90.0, 110.0, 130.0, 150.0],
        count=round(_DRAWS * num_views),
        limit=num_views,
        size=(512, 384),
        fov_deg=70.0,
        min_buildings=0.05,
        val_share=0.0,
        test_share=0.0,
        workers=workers,
        seed=_SEED,
    )


def _digest(root: Path) -> str:
    """Returns a digest of the town and of the code that pictures it: other code, other pictures."""
    code = sorted(Path(generate.__file__).parents[1].rglob("*.py"))
    return digest_of([root.name, [file_digest(file) for file in code]], length=8)
