"""A convergence basin: how far off a prior may be before a method no longer finds the pose.

The protocol is fixed, so that basins of two methods compare: priors uniform around the truth, a search
as wide as the prior's error (twice its half width) at the method's own stride, every pose of the grid
kept, one random stream per query. The paper gives the ranges and the stride and leaves the rest open
(its Table 3); the orientation twin of that table is in an appendix that is not published.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Entry
from lodbench.errors import ConfigError, QueryFault, require_within
from lodbench.evaluation.metrics import summarize_queries
from lodbench.evaluation.pose_errors import SplitSummary
from lodbench.execution import Ledger, Progress
from lodbench.geometry import rotations_at_yaws
from lodbench.harness.runs.artefacts import Run, summary_of
from lodbench.harness.runs.inputs import chosen_entries
from lodbench.harness.runs.queries import Preparation
from lodbench.rendering import Scorer
from lodbench.reporting import aligned_text, figures, summaries, table_heads
from lodbench.reporting.tables import RecallTable, format_latex, format_markdown
from lodbench.segmentation import binary_mask
from lodbench.storage import digest_of, make_folder, write_bytes, write_text

TRANSLATION, ORIENTATION = "translation", "orientation"
_UNITS = {TRANSLATION: "m", ORIENTATION: "deg"}
# What stays as it is while the other part of the prior is widened: the published priors.
_BASE = UniformPrior()
_AXES = {TRANSLATION: "prior's half width in x, y and z, m", ORIENTATION: "prior's half width in yaw, deg"}
Floats = NDArray[np.float64]
# The size at which the coarse stage compares.
_SIZE = (301, 224)


@dataclass(frozen=True, slots=True)
class BasinStep:
    """One row of a basin table."""

    kind: str  # ``translation`` or ``orientation``
    half_width: float  # half width of the prior's error: along x, y and z in metres, or of yaw in degrees
    limit: int | None  # at most this many queries per split, or None

    @property
    def unit(self) -> str:
        """Returns ``m`` or ``deg``."""
        return _UNITS[self.kind]

    @property
    def label(self) -> str:
        """Returns ``Delta 30 m``."""
        return f"Delta {self.half_width:g} {self.unit}"

    def prior(self) -> UniformPrior:
        """Returns the priors of this row."""
        if self.kind == TRANSLATION:
            return replace(_BASE, x_m=self.half_width, y_m=self.half_width, z_m=self.half_width)
        return replace(_BASE, yaw_deg=self.half_width)


def basin_steps(
    ranges_m: Sequence[float], yaw_ranges_deg: Sequence[float], limits: Sequence[int | None]
) -> tuple[BasinStep, ...]:
    """Returns the rows of both tables, cheapest first within each.

    Args:
        ranges_m: Half widths of the translation table.
        yaw_ranges_deg: Half widths of the orientation table.
        limits: Queries per split by translation range; one for all, or as many as ranges.

    Raises:
        ConfigError: A range is not a positive number within reason, or occurs twice; or the limits
            are not as many as the ranges.
    """
    require_within("ranges", ranges_m, 0, 1e4, "(]")
    require_within("yaw_ranges", yaw_ranges_deg, 0, 180, "(]")
    for kind, widths in ((TRANSLATION, ranges_m), (ORIENTATION, yaw_ranges_deg)):
        if len(set(widths)) < len(widths):
            raise ConfigError(f"A {kind} range occurs twice: {list(widths)}.")
    if not ranges_m and not yaw_ranges_deg:
        raise ConfigError("There is no range to run.", "Set `ranges='[30,50,100,200]'`.")
    if len(limits) not in (1, len(ranges_m)):
        raise ConfigError(f"{len(limits)} limits are not one per range: there are {len(ranges_m)} ranges.")
    each = list(limits) * len(ranges_m) if len(limits) == 1 else list(limits)
    far = [
        BasinStep(TRANSLATION, *pair) for pair in sorted(zip(ranges_m, each, strict=True), key=lambda p: p[0])
    ]
    fewest = min((n for n in limits if n is not None), default=None) if len(limits) == 1 else None
    return (*far, *(BasinStep(ORIENTATION, width, fewest) for width in sorted(yaw_ranges_deg)))


def protocol_lines(tilt: str, seed: int, takes_width: bool) -> list[str]:
    """Returns the protocol in words, as it is printed with every basin.

    ``takes_width`` is whether the method searches as far as priors are off, not as far as it is set.
    """
    tilts = {
        "truth": "the true pitch and roll (an oracle, as the paper's tables most likely have)",
        "prior": f"pitch and roll +-{_BASE.pitch_deg:g} deg",
    }
    search = (
        "2 x Delta wide on each axis, ends included, at the method's stride; no pose is dropped, "
        "not even one below a roof or the ground"
    )
    return [
        "priors: uniform around the truth, +-Delta in x, y and z, +-"
        f"{_BASE.yaw_deg:g} deg in yaw (translation table); +-Delta in yaw, "
        f"+-{_BASE.x_m:g}/{_BASE.y_m:g}/{_BASE.z_m:g} m in x/y/z (orientation table)",
        f"tilt={tilt}: {tilts.get(tilt, tilt)}",
        f"search: {search if takes_width else 'as the method is set, whatever Delta: it takes no width'}",
        f"random numbers: one stream per query, seed {seed}; a wider prior errs the same way, only further",
    ]


@dataclass(frozen=True, slots=True)
class Basin:
    """The runs of a basin."""

    protocol: tuple[str, ...]
    steps: list[tuple[BasinStep, Run]]

    def add(self, step: BasinStep, run: Run) -> None:
        """Adds a finished row."""
        self.steps.append((step, run))

    def run_of(self, step: BasinStep) -> Run:
        """Returns the run of a row."""
        return next(run for known, run in self.steps if known == step)

    def summary(self, step: BasinStep, split: str) -> SplitSummary:
        """Returns the recalls of a row."""
        return summarize_queries(self.run_of(step).queries, split)[0]

    def of_kind(self, kind: str) -> list[tuple[BasinStep, Run]]:
        """Returns the rows of one of the two tables."""
        return [(step, run) for step, run in self.steps if step.kind == kind]

    def tables(self) -> list[RecallTable]:
        """Returns the translation table and its orientation twin, where they have rows."""
        return [_table(self, kind) for kind in (TRANSLATION, ORIENTATION) if self.of_kind(kind)]


def write_basin(basin: Basin, grid: CostGrid | None) -> Path:
    """Writes the tables, the pictures and the protocol of a basin; returns their folder. No grid, no maps."""
    first = basin.steps[0][1]
    name = digest_of([run.folder.name for _, run in basin.steps])
    folder = first.folder.parent.with_name(f"{first.folder.parent.name}-{name}")
    make_folder(folder)
    write_text(folder / "protocol.txt", "\n".join(basin.protocol) + "\n")
    write_text(folder / "basin.csv", _basin_csv(basin))
    write_text(folder / "timings.csv", _timings_csv(basin))
    write_text(folder / "basin.md", "\n".join(map(format_markdown, basin.tables())))
    write_text(folder / "basin.tex", "\n".join(map(format_latex, basin.tables())))
    runs = [{"kind": s.kind, "half_width": s.half_width, "run": str(r.folder)} for s, r in basin.steps]
    write_text(folder / "runs.json", json.dumps(runs, indent=2) + "\n")
    panels = [
        (_AXES[kind], _curves(basin, kind)) for kind in (TRANSLATION, ORIENTATION) if basin.of_kind(kind)
    ]
    _write_figure(folder / "recall", figures.draw_recall_curves(panels))
    if grid is not None:
        _write_maps(folder, max((run for _, run in basin.steps), key=lambda run: len(run.queries)), grid)
    return folder


def _write_maps(folder: Path, run: Run, grid: CostGrid) -> None:
    entries = chosen_entries(run.dataset, run.splits, run.config.get("limit"))
    # Another grid, another ledger: its numbers stand at other offsets.
    ledger = folder / f"cost_ledger_{digest_of(asdict(grid))}.jsonl"
    maps = measure_cost_maps(run.preparation, run.scorer, entries, ledger, grid)
    if maps is None:
        return
    write_text(folder / "cost_maps.csv", cost_csv(maps))
    pictures = figures.draw_cost_maps(
        maps.num_queries,
        grid.xy(),
        maps.xy,
        (grid.z(), maps.z, maps.z_spread),
        (grid.yaw(), maps.yaw, maps.yaw_spread),
    )
    _write_figure(folder / "cost_maps", pictures)


def _write_figure(stem: Path, pictures: dict[str, bytes]) -> None:
    for kind, content in pictures.items():
        write_bytes(stem.with_suffix(f".{kind}"), content)


def _table(basin: Basin, kind: str) -> RecallTable:
    rows = basin.of_kind(kind)
    summary = summary_of(rows[0][1])
    body = []
    for step, run in rows:
        cells = {split: summaries.numbers_of(basin.summary(step, split).to_json()) for split in run.splits}
        counts = {numbers["queries"] for numbers in cells.values()}
        queries = (
            ""
            if len(rows) == 1
            else f" ({aligned_text.count_of('/'.join(map(str, sorted(counts))), 'queries')})"
        )
        body.append(table_heads.Line(f"{step.label}{queries}", cells))
    method = f"{summary['method']['name']} {summary['method']['variant']}".strip()
    title = f"{method}, {kind} of the prior · {table_heads.title_of(summary, {'prior'})}"
    return RecallTable(title, tuple(body))


def _curves(basin: Basin, kind: str) -> list[figures.RecallCurve]:
    rows = basin.of_kind(kind)
    widths = tuple(step.half_width for step, _ in rows)
    return [
        figures.RecallCurve(split, widths, tuple(basin.summary(step, split) for step, _ in rows))
        for split in rows[0][1].splits
    ]


def _timings_csv(basin: Basin) -> str:
    import pandas as pd

    rows = [
        (step.kind, step.half_width, split, run.seconds_per_query(split))
        for step, run in basin.steps
        for split in run.splits
    ]
    frame = pd.DataFrame(rows, columns=["kind", "half_width", "split", "seconds_per_query"])
    return str(frame.to_csv(index=False, lineterminator="\n"))


def _basin_csv(basin: Basin) -> str:
    import pandas as pd

    rows = []
    for step, run in basin.steps:
        for split in run.splits:
            summary = basin.summary(step, split)
            row: dict[str, Any] = {
                "kind": step.kind,
                "half_width": step.half_width,
                "unit": step.unit,
                "split": split,
            }
            row |= {"queries": summary.num_queries, "failed": summary.num_failed, **summary.recall}
            for label, bounds in summary.interval.items():
                row |= zip((f"{label} low", f"{label} high"), bounds, strict=True)
            row |= {
                "median_translation_m": summary.median_translation_m,
                "median_rotation_deg": summary.median_rotation_deg,
                "hypotheses_per_query": summary.hypotheses_per_query,
                "run": run.folder.name,
            }
            rows.append(row)
    return str(pd.DataFrame(rows).to_csv(index=False, lineterminator="\n"))


@dataclass(frozen=True, slots=True)
class CostGrid:
    """Offsets from the truth: half widths and steps."""

    xy_m: float = 50.0
    xy_step_m: float = 2.5
    z_m: float = 100.0
    z_step_m: float = 5.0
    yaw_deg: float = 30.0
    yaw_step_deg: float = 1.0

    def xy(self) -> Floats:
        """Returns the offsets along x, and along y, metres."""
        return _offsets(self.xy_m, self.xy_step_m)

    def z(self) -> Floats:
        """Returns the offsets along z, metres."""
        return _offsets(self.z_m, self.z_step_m)

    def yaw(self) -> Floats:
        """Returns the offsets in yaw, degrees."""
        return _offsets(self.yaw_deg, self.yaw_step_deg)


@dataclass(frozen=True, slots=True, eq=False)
class CostMaps:
    """IoU with the query mask at offsets from the truth, averaged over queries."""

    grid: CostGrid  # the offsets
    num_queries: int  # queries averaged over
    xy: Floats  # (Y, X) mean IoU
    z: Floats  # (Z,) mean IoU
    z_spread: Floats  # (Z,) standard deviation over queries
    yaw: Floats  # (A,) mean IoU
    yaw_spread: Floats  # (A,) standard deviation over queries


def measure_cost_maps(
    preparation: Preparation, scorer: Scorer, entries: tuple[Entry, ...], ledger_file: Path, grid: CostGrid
) -> CostMaps | None:
    """Returns the averages over all queries that have a mask and a truth; None if there is no such query.

    The tilt is the true one. Finished queries are taken from the ledger.
    """
    ledger = Ledger(ledger_file)
    with Progress("cost around the truth", len(entries)) as progress:
        for entry in entries:
            if entry.key not in ledger:
                ledger.record(entry.key, {"iou": _iou_at_offsets(preparation, scorer, entry, grid)})
            progress.advance()
    rows = [row for row in (ledger[entry.key]["iou"] for entry in entries) if row is not None]
    if not rows:
        return None
    table = np.array(rows)
    side, height = len(grid.xy()), len(grid.z())
    xy, z, yaw = np.split(table, [side * side, side * side + height], axis=1)
    return CostMaps(
        grid=grid,
        num_queries=len(rows),
        xy=xy.mean(axis=0).reshape(side, side),
        z=z.mean(axis=0),
        z_spread=z.std(axis=0),
        yaw=yaw.mean(axis=0),
        yaw_spread=yaw.std(axis=0),
    )


def cost_csv(maps: CostMaps) -> str:
    """Returns one line per offset as CSV: map, offsets, mean and spread of IoU."""
    import pandas as pd

    grid = maps.grid
    y, x = np.meshgrid(grid.xy(), grid.xy(), indexing="ij")
    parts = [
        pd.DataFrame({"map": "xy", "x_m": x.ravel(), "y_m": y.ravel(), "mean_iou": maps.xy.ravel()}),
        pd.DataFrame({"map": "z", "z_m": grid.z(), "mean_iou": maps.z, "spread_iou": maps.z_spread}),
        pd.DataFrame(
            {"map": "yaw", "yaw_deg": grid.yaw(), "mean_iou": maps.yaw, "spread_iou": maps.yaw_spread}
        ),
    ]
    offsets = ["x_m", "y_m", "z_m", "yaw_deg"]
    frame = pd.concat(parts).fillna(dict.fromkeys(offsets, 0.0)).assign(queries=maps.num_queries)
    return str(
        frame[["map", *offsets, "mean_iou", "spread_iou", "queries"]].to_csv(index=False, lineterminator="\n")
    )


def _iou_at_offsets(
    preparation: Preparation, scorer: Scorer, entry: Entry, grid: CostGrid
) -> list[float] | None:
    """Returns the IoU at every offset: x-y by rows of y, then z, then yaw; None without a query."""
    try:
        query = preparation.query(entry)
        mask = binary_mask(query.mask, *_SIZE)
    except QueryFault:
        return None
    truth = preparation.local(preparation.dataset.truth[entry.key])
    y, x = np.meshgrid(grid.xy(), grid.xy(), indexing="ij")
    flat = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    up = np.stack([np.zeros(len(grid.z()))] * 2 + [grid.z()], axis=1)
    turned = np.zeros((len(grid.yaw()), 3))
    offsets = np.concatenate([flat, up, turned])
    yaws = np.concatenate([np.zeros(len(flat) + len(up)), grid.yaw()])
    pitch, roll, yaw = truth.euler
    rotations = rotations_at_yaws(pitch, roll, yaw + yaws)
    counts = scorer.counts(query.camera.scaled(*_SIZE), rotations, truth.center + offsets, mask)
    return [float(v) for v in counts.iou()]


def _offsets(half_width: float, step: float) -> Floats:
    count = round(half_width / step)
    return np.arange(-count, count + 1, dtype=np.float64) * np.float64(step)
