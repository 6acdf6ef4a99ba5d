"""How good must a mask be? Recall over the IoU of the mask: the paper's Table 4 as a curve."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lodbench.bench.accuracy import AccuracyOptions, measure_accuracy
from lodbench.bench.accuracy_report import TILTS, Outcome
from lodbench.bench.figures import Figure, Progress, no_progress
from lodbench.evaluation.recall import DEFAULT_THRESHOLDS, hits_of
from lodbench.evaluation.statistics import wilson_interval
from lodbench.storage import write_bytes

_THRESHOLD = DEFAULT_THRESHOLDS[0]
IOUS = tuple(round(0.3 + 0.1 * step, 1) for step in range(8))
# IoU of the mask and recall within 2 m, 2 deg, in and out of trajectory, of the paper's three networks.
_REPORTED = ((0.39, "FastSAM"), (0.54, "SAM1-Adapter"), (0.88, "SAM2-UNet"))


@dataclass(frozen=True, slots=True)
class SegmentationOptions:
    """What to measure.

    Attributes:
        num_views: Views over the city, the same at every IoU.
        ious: IoUs of the masks with the true silhouettes.
        seed: Of views, masks, priors and method.
        threads: Threads of the engine; None for one per core.
    """

    num_views: int = 50
    ious: tuple[float, ...] = IOUS
    seed: int = 0
    threads: int | None = None


@dataclass(frozen=True, slots=True)
class SegmentationReport:
    """What was measured.

    Attributes:
        city: Name of the city model.
        ious: IoUs of the masks.
        outcomes: Per IoU, the outcomes of all views with both tilts.
    """

    city: str
    ious: tuple[float, ...]
    outcomes: tuple[tuple[Outcome, ...], ...]

    def recall(self, tilt: str) -> list[tuple[float, float, float]]:
        """Returns per IoU the recall within 2 m and 2 deg and its 95 % interval, percent."""
        rows = []
        for outcomes in self.outcomes:
            errors = np.array([o.error for o in outcomes if o.tilt == tilt], dtype=np.float64)
            hits = hits_of(errors, _THRESHOLD)
            low, high = wilson_interval(hits)
            rows.append((100.0 * float(hits.mean()), low, high))
        return rows

    def figures(self) -> list[Figure]:
        """Returns the recalls, one figure per IoU and tilt."""
        return [
            Figure(f"recall_{_THRESHOLD.label}_iou_{iou:g}_tilt_{tilt}", row[0], "%")
            for tilt in TILTS
            for iou, row in zip(self.ious, self.recall(tilt), strict=True)
        ]

    def to_text(self) -> str:
        """Returns a table: a line per IoU."""
        recalls = {tilt: self.recall(tilt) for tilt in TILTS}
        count = len(self.outcomes[0]) // len(TILTS)
        lines = [
            f"{self.city}: recall {_THRESHOLD.label} of lodlocv2 over {count} views, by the IoU of the mask",
            "mask IoU" + "".join(f"{f'tilt={tilt}':>24}" for tilt in TILTS),
        ]
        for number, iou in enumerate(self.ious):
            cells = [recalls[tilt][number] for tilt in TILTS]
            lines.append(
                f"{iou:8g}" + "".join(f"{r:11.1f} ({low:.0f} to {high:.0f})" for r, low, high in cells)
            )
        return "\n".join(lines)

    def write_picture(self, folder: Path) -> Path:
        """Writes the curve as PNG and returns its file."""
        from matplotlib.figure import Figure as Canvas

        canvas = Canvas(figsize=(6.4, 4.2), layout="constrained")
        axes = canvas.subplots()
        for tilt, colour in zip(TILTS, ("#1b6ca8", "#c8553d"), strict=True):
            rows = np.array(self.recall(tilt))
            axes.plot(self.ious, rows[:, 0], "o-", ms=4, color=colour, label=f"tilt={tilt}")
            axes.fill_between(self.ious, rows[:, 1], rows[:, 2], color=colour, alpha=0.15, lw=0)
        for iou, network in _REPORTED:
            axes.axvline(iou, color="#999999", lw=0.8, ls=":")
            axes.text(iou, 104, network, ha="center", va="bottom", fontsize=8, color="#666666")
        axes.set(
            xlabel="IoU of the mask with the true silhouette",
            ylabel=f"recall {_THRESHOLD.label}, %",
            ylim=(0, 103),
        )
        axes.grid(alpha=0.3)
        axes.legend(loc="lower right", title=f"{self.city}, lodlocv2")
        content = io.BytesIO()
        canvas.savefig(content, format="png", dpi=120, metadata={"Software": None})
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / "iou_recall.png"
        write_bytes(path, content.getvalue())
        return path


def measure_segmentation(
    city: Path, options: SegmentationOptions | None = None, progress: Progress = no_progress
) -> SegmentationReport:
    """Returns the recall of LoD-Loc v2 over the IoU of its masks.

    Views and priors are the same at every IoU; masks are roughened as ``noisy_oracle`` does.

    Args:
        city: City model file.
        options: What to measure.
        progress: Called after each view.

    Raises:
        LodbenchError: The city cannot be read, or no views can be drawn over it.
    """
    options = options or SegmentationOptions()
    base = AccuracyOptions(num_views=options.num_views, seeds=(options.seed,), threads=options.threads)
    outcomes = []
    for number, iou in enumerate(options.ious):
        measured = measure_accuracy(city, replace(base, mask_iou=iou), _part(progress, number, options.ious))
        outcomes.append(measured.outcomes)
    return SegmentationReport(Path(city).name, options.ious, tuple(outcomes))


def _part(progress: Progress, number: int, ious: Sequence[float]) -> Progress:
    def told(done: int, total: int) -> None:
        progress(number * total + done, len(ious) * total)

    return told
