"""Bins and numbers by the name of a benchmark: what a dataset's results are reported by.

A dataset declares its protocol (``Dataset.protocol``); ``summary.json`` names it where it is not LoD-Loc's,
and tables, ``compare`` and the leaderboard read it there. A query without an answer is beyond every bin;
means and roots of mean squares are of those answered.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import ConfigError, nearest_names
from lodbench.evaluation.recall import DEFAULT_THRESHOLDS, Threshold, hits_of

if TYPE_CHECKING:
    import pandas as pd

LODLOC = "lodloc"
# Errors of queries that only some protocols have written: of the camera east and north, of the ground that
# the photo's centre shows, metres.
EAST_NORTH, GROUND = ("east_error_m", "north_error_m"), "ground_error_m"


@dataclass(frozen=True, slots=True)
class Protocol:
    """How results are reported.

    Attributes:
        thresholds: Where recall is measured; both errors are strictly below them.
        horizontal_m: Distances in plan where recall is measured, including them, whatever height and angles.
        has_errors: Whether means, roots of mean squares and the share beyond the loosest bin are reported.
        columns: Which of ``EAST_NORTH`` and ``GROUND`` are.
    """

    thresholds: tuple[Threshold, ...] = DEFAULT_THRESHOLDS
    horizontal_m: tuple[float, ...] = ()
    has_errors: bool = True
    columns: tuple[str, ...] = ()

    def numbers(self, queries: pd.DataFrame) -> dict[str, float]:
        """Returns its numbers beyond recalls and medians, of the queries of a split that have a truth."""
        errors = queries[["translation_error_m", "rotation_error_deg"]].to_numpy()
        plan = queries["horizontal_error_m"].to_numpy()
        numbers = {f"horizontal_{most:g}m_percent": _percent(plan <= most) for most in self.horizontal_m}
        if self.horizontal_m:
            numbers["mean_horizontal_m"] = _mean(plan)
        if self.has_errors:
            for name, values in (("translation_m", errors[:, 0]), ("rotation_deg", errors[:, 1])):
                answered = values[np.isfinite(errors[:, 0])]
                numbers |= {f"mean_{name}": _mean(answered), f"rmse_{name}": _root_mean_square(answered)}
            if self.thresholds:
                loosest = Threshold(*np.max(self.thresholds, axis=0))
                name = f"beyond_{loosest.label.replace('-', '_')}_percent"
                numbers[name] = _percent(~hits_of(errors, loosest))
        for column in self.columns:
            values = np.abs(queries[column].to_numpy()) if column in queries else np.empty(0)
            axis = column.removesuffix("_error_m")
            known = values[np.isfinite(values)]
            numbers |= {f"median_{axis}_m": _median(values), f"rmse_{axis}_m": _root_mean_square(known)}
        if set(EAST_NORTH) <= set(self.columns):
            numbers["rmse_vertical_m"] = _root_mean_square(queries["vertical_error_m"].to_numpy())
        return numbers


PROTOCOLS = {
    LODLOC: Protocol(has_errors=False),
    "lodlocv3": Protocol(tuple(Threshold(*pair) for pair in ((1, 1), (2, 2), (3, 3), (5, 5), (10, 15)))),
    "uavd4l": Protocol(tuple(Threshold(*pair) for pair in ((1, 1), (3, 3), (5, 5))), columns=(GROUND,)),
    "egeniouss": Protocol(
        tuple(Threshold(*pair) for pair in ((0.5, 2), (2, 5), (5, 10))), columns=EAST_NORTH
    ),
    "ortholoc": Protocol(
        tuple(Threshold(*pair) for pair in ((0.1, 1), (0.25, 2), (0.5, 5), (2, 2), (3, 3), (5, 5), (5, 10)))
    ),
    "anyvisloc": Protocol((), (1.0, 3.0, 5.0, 10.0, 20.0)),
    "semcityloc": Protocol(columns=EAST_NORTH),
}


def protocol_named(name: str) -> Protocol:
    """Returns the protocol of a name.

    Raises:
        ConfigError: There is none.
    """
    if name not in PROTOCOLS:
        raise ConfigError(f"There is no protocol {name!r}.", nearest_names(name, PROTOCOLS))
    return PROTOCOLS[name]


def _percent(hits: NDArray[np.bool_]) -> float:
    return 100.0 * float(hits.mean()) if len(hits) else float("nan")


def _mean(values: NDArray[np.float64]) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")


def _median(values: NDArray[np.float64]) -> float:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else float("nan")


def _root_mean_square(values: NDArray[np.float64]) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")
