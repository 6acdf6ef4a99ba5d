"""The queries of a run as a table: what every number of a split is computed from.

One row per query, columns as in ``queries.csv``. Errors are NaN where there is no truth, and (inf, 180)
where there is one but no answer; other numbers are NaN where they are not known.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import ConfigError, nearest_names
from lodbench.evaluation.metrics import compute_metrics
from lodbench.evaluation.pose_errors import DEFAULT_THRESHOLDS, SplitSummary, Threshold, hits_of, summarize
from lodbench.storage import hide_formula

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


# The reason of a row that cannot be scored: it is not part of the truth list.
NO_TRUTH = "no true pose to compare with"

ERROR = ("translation_error_m", "rotation_error_deg")
PRIOR_ERROR = ("prior_translation_error_m", "prior_rotation_error_deg")
PARTS = ("horizontal_error_m", "vertical_error_m", "yaw_error_deg")
TEXTS = ("query", "split", "failure", "tilt", "covariance")
COLUMNS = (
    "query", "split", *ERROR, "score", "hypotheses", "failure", *PRIOR_ERROR, "tilt", *PARTS, "mask_iou",
    "probability", "covariance",
)  # fmt: skip


# Those that only some protocols have written.
MORE = (*EAST_NORTH, GROUND)


def queries_frame(rows: pd.DataFrame | Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Returns rows as a table of ``COLUMNS``: texts, and float64 for everything else.

    The index is ``split/query``: what the key of an entry is.
    """
    import pandas as pd

    known = rows if isinstance(rows, pd.DataFrame) else pd.DataFrame(list(rows))
    columns = [*COLUMNS, *(name for name in MORE if name in known)]
    frame = known.reindex(columns=columns)
    types: dict[str, Any] = {name: object if name in TEXTS else np.float64 for name in columns}
    frame = frame.astype(types)
    frame.index = pd.Index(frame["split"] + "/" + frame["query"], name="key", dtype=object)
    return frame


def of_split(queries: pd.DataFrame, split: str) -> pd.DataFrame:
    """Returns the rows of one split that have a truth: the denominator of its numbers."""
    return queries[(queries["split"] == split) & has_truth(queries)]


def has_truth(queries: pd.DataFrame) -> pd.Series[bool]:
    """Returns which queries have a truth to be compared with."""
    return queries[ERROR[0]].notna()


def without_truth(queries: pd.DataFrame) -> pd.DataFrame:
    """Returns the rows of splits in which no query has a truth: nothing of them is scored."""
    return queries[~has_truth(queries).groupby(queries["split"]).transform("any")]


def is_answered(queries: pd.DataFrame) -> pd.Series[bool]:
    """Returns which queries have an estimate: without a truth that is all that is known of them."""
    return queries[ERROR[0]].lt(math.inf) | (queries["failure"] == NO_TRUTH)


def is_without_truth(failure: str) -> bool:
    """Tells whether a row's reason is that nothing is known to compare with: it is in no denominator."""
    return failure.startswith(NO_TRUTH)


def own_failure(failure: str) -> str:
    """Returns a row's reason without the words that nothing is known to compare with.

    Example:
        >>> own_failure(f"{NO_TRUTH}; no match"), own_failure(NO_TRUTH), own_failure("no match")
        ('no match', '', 'no match')
    """
    return failure.removeprefix(NO_TRUTH).removeprefix("; ")


def summarize_queries(
    queries: pd.DataFrame,
    split: str,
    protocol: Protocol = PROTOCOLS[LODLOC],
    thresholds: Sequence[Threshold] | None = None,
) -> tuple[SplitSummary, SplitSummary]:
    """Returns the summaries of the estimates and of the priors of one split, over its truth list.

    Recall is measured at the protocol's bins, or at other thresholds.
    """
    thresholds = protocol.thresholds if thresholds is None else thresholds
    scored = of_split(queries, split)
    is_mine, answered = queries["split"] == split, is_answered(queries)
    mine = queries[is_mine & answered]
    estimates = summarize(
        scored[list(ERROR)].to_numpy(),
        mine["hypotheses"].dropna().to_numpy(),
        thresholds,
        metrics=compute_metrics(scored) | protocol.numbers(scored),
    )
    if scored.empty:
        # Nothing to score is no reason to call an unanswered query answered.
        estimates = replace(estimates, num_failed=int((is_mine & ~answered).sum()))
    return estimates, summarize(scored[list(PRIOR_ERROR)].to_numpy(), (), thresholds)


def fill_failures(queries: pd.DataFrame, known: pd.Series[bool]) -> pd.DataFrame:
    """Returns the table in which the empty errors of queries with a known truth are those of failures."""
    more = [name for name in MORE if name in queries]
    failed = dict.fromkeys((ERROR[0], PRIOR_ERROR[0], *PARTS[:2], *more), math.inf)
    failed |= dict.fromkeys((ERROR[1], PRIOR_ERROR[1], PARTS[2]), 180.0)
    columns = {
        name: queries[name].mask(queries[name].isna() & known, value) for name, value in failed.items()
    }
    return queries.assign(**columns)


def queries_csv(queries: pd.DataFrame) -> str:
    """Returns the table as CSV: what is not finite is empty, and no text is a formula to a spreadsheet."""
    frame = queries.copy()
    more = tuple(name for name in MORE if name in frame)
    for group in (ERROR, PRIOR_ERROR, PARTS, *((name,) for name in more)):
        lost = np.isinf(frame[group[0]])
        frame.loc[lost, list(group)] = math.nan
    for name in ("query", "split", "failure"):
        frame[name] = frame[name].map(hide_formula)
    frame["hypotheses"] = frame["hypotheses"].astype("Int64")
    return str(frame.to_csv(index=False, lineterminator="\n"))
