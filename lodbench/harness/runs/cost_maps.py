"""Average cost around the truth: IoU over the offset in x-y, in z and in yaw (the paper's basin figure)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.query import Entry
from lodbench.errors import QueryFault
from lodbench.execution import Ledger, Progress
from lodbench.geometry import rotations_at_yaws
from lodbench.harness.runs.prepare import Preparation
from lodbench.rendering import Scorer
from lodbench.segmentation import binary_mask

Floats = NDArray[np.float64]
# The size at which the coarse stage compares.
_SIZE = (301, 224)


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
    """IoU with the query mask at offsets from the truth, averaged over queries.

    Attributes:
        grid: The offsets.
        num_queries: Queries averaged over.
        xy: (Y, X) mean IoU.
        z: (Z,) mean IoU.
        z_spread: (Z,) standard deviation over queries.
        yaw: (A,) mean IoU.
        yaw_spread: (A,) standard deviation over queries.
    """

    grid: CostGrid
    num_queries: int
    xy: Floats
    z: Floats
    z_spread: Floats
    yaw: Floats
    yaw_spread: Floats


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
                ledger.record(entry.key, {"iou": _around_truth(preparation, scorer, entry, grid)})
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


def _around_truth(
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
