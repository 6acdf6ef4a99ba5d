"""How good must a mask be? Recall over the IoU of the mask: the paper's Table 4 as a curve."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.bench import Figure, Progress, Report, no_progress
from lodbench.bench.accuracy import TILTS, Job, blocks_of, sweep
from lodbench.datasets.inputs import Input, declared_inputs, read_labels
from lodbench.datasets.query import Entry
from lodbench.errors import ConfigError, DatasetError
from lodbench.evaluation.pose_errors import DEFAULT_THRESHOLDS
from lodbench.methods import Method
from lodbench.reporting.aligned_text import format_columns
from lodbench.reporting.figures import LINE_STYLES, SERIES, draw_figure
from lodbench.segmentation.protocol import BUILDING_THRESHOLD, InstanceSegmenter, Segmenter
from lodbench.synthesis.views_dataset import ViewsParams
from lodbench.training.samples import INTERIORS, find_samples

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure as Canvas

_LABEL = DEFAULT_THRESHOLDS[0].label
IOUS = tuple(round(0.3 + 0.1 * step, 1) for step in range(8))
_SPLITS = ("train", "val", "test")
# Buildings of less than some 8 x 8 pixels do not count: what is left of one behind another.
_LEAST_PX = 64


class Reported(NamedTuple):
    """A row of the paper's Table 4: UAVD4L-LoDv2, real photos, networks fine-tuned on the same data."""

    network: str
    iou: float
    recall: float
    is_in_trajectory: bool


TABLE_4 = (
    Reported("FastSAM", 0.39, 45.3, True),
    Reported("SAM1-Adapter", 0.54, 86.4, True),
    Reported("SAM2-UNet", 0.88, 93.7, True),
    Reported("FastSAM", 0.31, 45.6, False),
    Reported("SAM1-Adapter", 0.43, 96.4, False),
    Reported("SAM2-UNet", 0.80, 97.9, False),
)


def measure_iou_recall(
    views: ViewsParams,
    methods: Sequence[Method],
    progress: Progress = no_progress,
    ious: Sequence[float] = IOUS,
    threads: int | None = None,
) -> Report:
    """Returns the recall of methods over the IoU of their masks.

    Views and priors are the same at every IoU; masks are degraded as ``noisy_oracle`` does. ``data`` has the
    columns ``method``, ``tilt``, ``iou``, and in percent ``recall`` with its 95 % interval, ``low`` and
    ``high``.

    Raises:
        LodbenchError: The city cannot be read, or no views can be drawn over it.
    """
    import pandas as pd

    jobs = [
        Job(method, replace(views, mask_iou=iou), tilt, {"iou": iou})
        for iou, method, tilt in product(ious, methods, TILTS)
    ]
    points = pd.DataFrame(
        [
            (block.method, block.tilt, iou, block.summary.recall[_LABEL], *block.summary.interval[_LABEL])
            for iou, rows in sweep(jobs, progress, threads).groupby("iou")
            for block in blocks_of(rows)
        ],
        columns=["method", "tilt", "iou", "recall", "low", "high"],
    )
    city = Path(views.city_model).name
    figures = [
        Figure(f"recall_{_LABEL}_{p['method']}_iou_{p['iou']:g}_tilt_{p['tilt']}", p["recall"], "%")
        for _, curve in points.groupby(["method", "tilt"], sort=False)
        for _, p in curve.iterrows()
    ]
    text = f"{city}: recall {_LABEL} over {views.num_views} views, by the IoU of the mask\n{_table(points)}"
    title = f"{city}, {views.num_views} views; shaded: 95 %"
    return Report(text, figures, points, partial(_pictures, points, title))


def _table(points: pd.DataFrame) -> str:
    """Returns for each method a line per IoU."""
    lines = []
    for method, mine in points.groupby("method", sort=False):
        lines.append(f"{method:16}" + "".join(f"{f'tilt={tilt}':>24}" for tilt in TILTS))
        for iou, pair in mine.groupby("iou"):
            cells = [f"{p.recall:11.1f} ({p.low:.0f} to {p.high:.0f})" for p in pair.itertuples()]
            lines.append(f"  IoU {iou:<10g}" + "".join(f"{cell:>24}" for cell in cells))
    return "\n".join(lines)


def _pictures(points: pd.DataFrame, title: str) -> dict[str, bytes]:
    """Returns the curves, and the paper's Table 4 beside them."""

    def draw(canvas: Canvas) -> None:
        axes = canvas.subplots()
        methods = list(dict.fromkeys(points["method"]))
        for (method, tilt), curve in points.groupby(["method", "tilt"], sort=False):
            line, colour = LINE_STYLES[methods.index(method) % len(LINE_STYLES)], SERIES[TILTS.index(tilt)]
            label = f"{method}, tilt={tilt}"
            axes.plot(curve["iou"], curve["recall"], line, marker="o", ms=4, color=colour, label=label)
            axes.fill_between(curve["iou"], curve["low"], curve["high"], color=colour, alpha=0.1, lw=0)
        _draw_reported(axes)
        recall = f"recall {_LABEL.replace('-', ', ')}, %"
        axes.set(
            xlabel="IoU of the mask with the true silhouette", ylabel=recall, ylim=(-2, 103), title=title
        )
        canvas.legend(loc="outside lower center", ncols=2, fontsize=8)

    return {f"iou_recall.{kind}": picture for kind, picture in draw_figure(7.6, 4.8, draw).items()}


def _draw_reported(axes: Any) -> None:
    for is_in, marker, words in ((True, "s", "in"), (False, "D", "out of")):
        rows = [row for row in TABLE_4 if row.is_in_trajectory == is_in]
        axes.plot(
            [row.iou for row in rows], [row.recall for row in rows], marker, ms=6, color="#444444",
            fillstyle="full" if is_in else "none", label=f"paper, Table 4, {words} trajectory (real photos)",
        )  # fmt: skip
        for row in rows:
            axes.annotate(
                row.network, (row.iou, row.recall), (0, -13), textcoords="offset points", ha="center",
                fontsize=7, color="#444444", bbox={"fc": "white", "ec": "none", "alpha": 0.7, "pad": 0.5},
            )  # fmt: skip


def measure_instances(segmenter: Segmenter, data: Path, progress: Progress = no_progress) -> Report:
    """Returns the panoptic quality of a segmenter's buildings, and of the coherent parts of its mask.

    Args:
        segmenter: Provides ``instances`` of the photo alone.
        data: Training set with ``labels``, or a folder of such sets; all splits count.
        progress: Called after each view.

    Raises:
        LodbenchError: The segmenter separates no buildings, or a set is missing or has no labels.
    """
    if not isinstance(segmenter, InstanceSegmenter) or declared_inputs(segmenter, "requires") != {
        Input.IMAGE
    }:
        raise ConfigError(
            f"segmenter {segmenter.name} does not separate buildings by the photo alone.",
            "--segmenter compact_instances does, and any other that requires the image alone.",
        )
    samples = [sample for split in _SPLITS for sample in find_samples(data, split, INTERIORS)]
    if not samples:
        raise DatasetError(
            f"{data} holds no views.", "lodbench generate-training-data labels=true makes some."
        )
    apart, parts = InstanceMatches(), InstanceMatches()
    for number, sample in enumerate(samples, start=1):
        labels = read_labels(sample.mask)
        height, width = labels.shape
        entry = Entry(sample.photo.name, sample.key, None, None, sample.photo, None)
        guess = np.zeros(labels.shape, np.uint16)
        for k, mask in enumerate(segmenter.segment_instances(entry), start=1):
            guess[cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0] = k
        apart += match_instances(guess, labels, _LEAST_PX)
        mask = cv2.resize(segmenter.segment(entry), (width, height)) >= BUILDING_THRESHOLD
        parts += match_instances(
            np.asarray(cv2.connectedComponents(mask.astype(np.uint8))[1], np.int32), labels, _LEAST_PX
        )
        progress(number, len(samples))
    return _report(segmenter.name, data, len(samples), {"buildings": apart, "parts of its mask": parts})


def _report(name: str, data: Path, views: int, rows: dict[str, InstanceMatches]) -> Report:
    cells = [["", "PQ", "RQ (F1)", "SQ", "found", "there"]]
    figures = []
    for words, matches in rows.items():
        quality = (matches.panoptic, matches.recognition, matches.segmentation)
        cells.append(
            [words, *(f"{value:.3f}" for value in quality), str(matches.predicted), str(matches.true)]
        )
        figures += [
            Figure(f"{words.replace(' ', '_')}_{kind}", value, "")
            for kind, value in zip(("pq", "rq", "sq"), quality, strict=True)
        ]
    which = f"{name}: single buildings of {views} views of {data.name}, those of {_LEAST_PX} pixels or more"
    return Report("\n".join([which, format_columns(cells)]), figures)


@dataclass(frozen=True, slots=True)
class InstanceMatches:
    """How buildings that were found go with those that are there; sums over photos are `+`."""

    matched: int = 0
    iou_sum: float = 0.0
    predicted: int = 0
    true: int = 0

    def __add__(self, other: InstanceMatches) -> InstanceMatches:
        return InstanceMatches(
            self.matched + other.matched,
            self.iou_sum + other.iou_sum,
            self.predicted + other.predicted,
            self.true + other.true,
        )

    @property
    def recognition(self) -> float:
        """Returns the share of pairs among all, RQ, which is the F1 at IoU one half; NaN of nothing."""
        either = self.predicted + self.true
        return 2 * self.matched / either if either else float("nan")

    @property
    def segmentation(self) -> float:
        """Returns the mean IoU of pairs, SQ; NaN where there is none."""
        return self.iou_sum / self.matched if self.matched else float("nan")

    @property
    def panoptic(self) -> float:
        """Returns PQ, the product of both; NaN of nothing."""
        return 2 * self.iou_sum / (self.predicted + self.true) if self.predicted + self.true else float("nan")


def match_instances(
    predicted: NDArray[np.integer], true: NDArray[np.integer], least_px: int
) -> InstanceMatches:
    """Returns how labels of a photo, (H, W) and 0 for no building, go with the true ones.

    Buildings of fewer pixels than ``least_px`` do not count, on either side.
    """
    predicted_ids, a, of_predicted = np.unique(predicted, return_inverse=True, return_counts=True)
    true_ids, b, of_true = np.unique(true, return_inverse=True, return_counts=True)
    shared = np.zeros((len(predicted_ids), len(true_ids)))
    np.add.at(shared, (a.ravel(), b.ravel()), 1)
    counted_predicted = (predicted_ids > 0) & (of_predicted >= least_px)
    counted_true = (true_ids > 0) & (of_true >= least_px)
    iou = shared / (of_predicted[:, None] + of_true[None] - shared)
    pairs = iou[counted_predicted][:, counted_true]
    is_pair = pairs > 0.5
    return InstanceMatches(
        int(is_pair.sum()), float(pairs[is_pair].sum()), int(counted_predicted.sum()), int(counted_true.sum())
    )
