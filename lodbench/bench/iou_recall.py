"""How good must a mask be? Recall over the IoU of the mask: the paper's Table 4 as a curve."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lodbench.bench.accuracy import measure_accuracy, part_of
from lodbench.bench.accuracy_options import AccuracyOptions
from lodbench.bench.accuracy_report import TILTS, AccuracyReport
from lodbench.bench.figures import Figure, Progress, no_progress
from lodbench.errors import ConfigError
from lodbench.evaluation.recall import DEFAULT_THRESHOLDS
from lodbench.methods import Method
from lodbench.methods.lodlocv2 import LodLocV2
from lodbench.storage import write_bytes

PICTURE_FILE = "iou_recall.png"
_THRESHOLD = DEFAULT_THRESHOLDS[0]
IOUS = tuple(round(0.3 + 0.1 * step, 1) for step in range(8))
_COLOURS = {"truth": "#1b6ca8", "prior": "#c8553d"}
_LINES = ("-", "--", "-.", ":")


class Reported(NamedTuple):
    """A row of the paper's Table 4: UAVD4L-LoDv2, real photos, networks fine-tuned on the same data.

    Attributes:
        network: Its name.
        iou: Of its masks.
        recall: Within 2 m and 2 deg, percent.
        is_in_trajectory: Whether on the in-trajectory split.
    """

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


class Point(NamedTuple):
    """Recall at one IoU, percent, with its 95 % interval."""

    recall: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class IouRecallOptions:
    """What to measure.

    Attributes:
        num_views: Views over the city, the same at every IoU.
        ious: IoUs of the masks with the true silhouettes.
        seed: Of views, masks, priors and method.
        threads: Threads of the engine; None for one per core.

    Raises:
        ConfigError: There are no views.
    """

    num_views: int = 50
    ious: tuple[float, ...] = IOUS
    seed: int = 0
    threads: int | None = None

    def __post_init__(self) -> None:
        if self.num_views < 1:
            raise ConfigError(f"views={self.num_views} is not a number of views.")


@dataclass(frozen=True, slots=True)
class IouRecallReport:
    """What was measured.

    Attributes:
        city: Name of the city model.
        methods: Names of the methods.
        ious: IoUs of the masks.
        reports: What was found at each IoU.
    """

    city: str
    methods: tuple[str, ...]
    ious: tuple[float, ...]
    reports: tuple[AccuracyReport, ...]

    @property
    def num_views(self) -> int:
        """Returns the number of views behind each point."""
        return len(self.reports[0].of_tilt(TILTS[0]))

    def recall(self, tilt: str, method: str | None = None) -> list[Point]:
        """Returns per IoU the recall of a method within 2 m and 2 deg; of the first method if None."""
        found = [report.summary(tilt, method) for report in self.reports]
        label = _THRESHOLD.label
        return [Point(summary.recall[label], *summary.interval[label]) for summary in found]

    def figures(self) -> list[Figure]:
        """Returns the recalls, one figure per method, tilt and IoU."""
        return [
            Figure(f"recall_{_THRESHOLD.label}_{method}_iou_{iou:g}_tilt_{tilt}", point.recall, "%")
            for method in self.methods
            for tilt in TILTS
            for iou, point in zip(self.ious, self.recall(tilt, method), strict=True)
        ]

    def to_text(self) -> str:
        """Returns a table: a line per IoU."""
        lines = [
            f"{self.city}: recall {_THRESHOLD.label} over {self.num_views} views, by the IoU of the mask"
        ]
        for method in self.methods:
            columns = [self.recall(tilt, method) for tilt in TILTS]
            lines.append(f"{method:16}" + "".join(f"{f'tilt={tilt}':>24}" for tilt in TILTS))
            for iou, *points in zip(self.ious, *columns, strict=True):
                cells = [f"{p.recall:11.1f} ({p.low:.0f} to {p.high:.0f})" for p in points]
                lines.append(f"  IoU {iou:<10g}" + "".join(f"{cell:>24}" for cell in cells))
        return "\n".join(lines)

    def write_picture(self, folder: Path) -> Path:
        """Writes the curves, and the paper's Table 4 beside them, as PNG; returns the file."""
        from matplotlib.figure import Figure as Canvas

        canvas = Canvas(figsize=(7.6, 4.8), layout="constrained")
        axes = canvas.subplots()
        for method, line in zip(self.methods, _LINES, strict=False):
            for tilt in TILTS:
                self._draw(axes, method, tilt, line)
        _draw_reported(axes)
        axes.set(
            xlabel="IoU of the mask with the true silhouette",
            ylabel=f"recall {_THRESHOLD.label.replace('-', ', ')}, %",
            ylim=(-2, 103),
            title=f"{self.city}, {self.num_views} views; shaded: 95 %",
        )
        axes.title.set_fontsize(10)
        axes.grid(alpha=0.3)
        canvas.legend(loc="outside lower center", ncols=2, fontsize=8)
        content = io.BytesIO()
        canvas.savefig(content, format="png", dpi=120, metadata={"Software": None})
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / PICTURE_FILE
        write_bytes(path, content.getvalue())
        return path

    def _draw(self, axes: Any, method: str, tilt: str, line: str) -> None:
        points = np.array(self.recall(tilt, method))
        colour = _COLOURS[tilt]
        label = f"{method}, tilt={tilt}"
        axes.plot(self.ious, points[:, 0], line, marker="o", ms=4, color=colour, label=label)
        axes.fill_between(self.ious, points[:, 1], points[:, 2], color=colour, alpha=0.1, lw=0)


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


def measure_iou_recall(
    city: Path,
    options: IouRecallOptions | None = None,
    progress: Progress = no_progress,
    methods: Sequence[Method] = (),
) -> IouRecallReport:
    """Returns the recall of methods over the IoU of their masks.

    Views and priors are the same at every IoU; masks are degraded as ``noisy_oracle`` does.

    Args:
        city: City model file.
        options: What to measure.
        progress: Called after each view.
        methods: Which methods; LoD-Loc v2 if empty.

    Raises:
        LodbenchError: The city cannot be read, or no views can be drawn over it.
    """
    options, methods = options or IouRecallOptions(), methods or (LodLocV2(),)
    base = AccuracyOptions(num_views=options.num_views, seeds=(options.seed,), threads=options.threads)
    reports = [
        measure_accuracy(
            city, replace(base, mask_iou=iou), part_of(progress, number, len(options.ious)), methods
        )
        for number, iou in enumerate(options.ious)
    ]
    names = tuple(method.name for method in methods)
    return IouRecallReport(Path(city).name, names, options.ious, tuple(reports))
