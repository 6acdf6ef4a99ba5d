"""The queries of a run as a table, and the numbers of a split computed from it beyond recall and medians.

The table has one row per query, columns as in ``queries.csv``. Errors are NaN where there is no truth, and
(inf, 180) where there is one but no answer; other numbers are NaN where they are not known.

A metric is a function from the queries of one split to numbers by name, offered under the entry point
group ``lodbench.metrics``. Its numbers stand in ``summary.json``, in CSV, and in tables by their names
(`lodbench compare --columns NAME`).
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import STOPPED, ConfigError, nearest_names
from lodbench.evaluation.pose_errors import (
    DEFAULT_THRESHOLDS,
    PROBABILITY_THRESHOLD,
    Interval,
    SplitSummary,
    Threshold,
    hits_of,
    summarize,
    wilson_interval,
)
from lodbench.plugins import installed
from lodbench.storage import hide_formula

if TYPE_CHECKING:
    import pandas as pd

# Share of right answers that a threshold on the probability lets through.
_KEPT = 0.9
LODLOC = "lodloc"
# Errors of queries that only some protocols have written: of the camera east and north, of the ground that
# the photo's centre shows, metres.
EAST_NORTH, GROUND = ("east_error_m", "north_error_m"), "ground_error_m"
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
Floats = NDArray[np.float64]
Hits = NDArray[np.bool_]
# From the queries of one split that have a truth to numbers by name, units in the names, NaN where there
# is none. A query without an answer has errors of inf and 180 deg.
Metric = Callable[["pd.DataFrame"], Mapping[str, float]]
# Names that stand for something else in a summary, a table, the leaderboard: recalls at any threshold, areas,
# intervals, spreads, and the columns themselves.
_TAKEN = re.compile(
    r"(AUC )?[\d.e+-]+m-[\d.e+-]+deg|.+ (low|high|spread|printed|of answered)|is_printed"
    r"|median_(translation_m|rotation_deg)|(hypotheses|seconds)_per_query|queries|failed"
    r"|source|rank|group|method|variant|settings|map|condition|split|protocol|tilt|segmenter|renderer|lod|seeds|evaluator"
    r"|code|table|row|run|kept apart because|notes"
)
_PARTS = ("median_horizontal_m", "median_vertical_m", "median_yaw_deg")
_CALIBRATION = ("mean_confidence_percent", "ece_percent", "aurc_percent")
# The numbers of lodbench's own metrics: every lodbench computes them.
OWN_NUMBERS = frozenset((*_PARTS, *_CALIBRATION, "mask_iou"))


@dataclass(frozen=True, slots=True)
class Protocol:
    """How results are reported."""

    # Where recall is measured; both errors are strictly below them.
    thresholds: tuple[Threshold, ...] = DEFAULT_THRESHOLDS
    # Distances in plan where recall is measured, including them, whatever height and angles.
    horizontal_m: tuple[float, ...] = ()
    # Whether means, roots of mean squares and the share beyond the loosest bin are reported.
    has_errors: bool = True
    columns: tuple[str, ...] = ()  # which of ``EAST_NORTH`` and ``GROUND`` are

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


@dataclass(frozen=True, slots=True)
class ReliabilityBin:
    """The queries whose probability lies in one range."""

    low: float  # lower end of the range, inside it
    high: float  # upper end, outside it unless it is 1
    count: int  # queries
    confidence: float  # their mean probability, in [0, 1]
    hit_share: float  # share that was found, in [0, 1]
    interval: Interval  # 95 % interval of that share, in [0, 1]


@dataclass(frozen=True, slots=True)
class Calibration:
    """How a method's probabilities compare with what it found."""

    bins: tuple[ReliabilityBin, ...]  # of equal width from 0 to 1, empty ones left out
    # Expected calibration error: mean distance of confidence and share found, over the bins, weighted by
    # their queries, in [0, 1]; NaN without queries.
    ece: float
    brier: float  # mean squared distance of probability and outcome; NaN without queries
    coverage: Floats  # (N + 1,) share of queries answered as less and less sure ones are let in, 0 to 1
    risk: Floats  # (N + 1,) share of those answered that were not found
    aurc: float  # area under the risk-coverage curve, in [0, 1]


def calibrate(
    probabilities: Sequence[float] | Floats, hits: Sequence[bool] | Hits, num_bins: int = 10
) -> Calibration:
    """Returns how well probabilities, (N,) in [0, 1], agree with which of N queries were localised.

    The probability of a query without an answer is 0; bins are those of the reliability diagram.
    """
    confidence, is_hit = np.asarray(probabilities, dtype=np.float64), np.asarray(hits, dtype=np.bool_)
    bins = _bins(confidence, is_hit, num_bins)
    coverage, risk = risk_coverage(confidence, is_hit)
    count = len(confidence)
    error = sum(b.count * abs(b.hit_share - b.confidence) for b in bins) / count if count else math.nan
    return Calibration(
        bins=bins,
        ece=error,
        brier=float(np.mean((confidence - is_hit) ** 2)) if count else math.nan,
        coverage=coverage,
        risk=risk,
        aurc=float(risk[1:].mean()) if count else math.nan,
    )


def risk_coverage(probabilities: Floats, hits: Hits) -> tuple[Floats, Floats]:
    """Returns coverage and risk, (N + 1,) each, the surest queries first; the first risk is the second's.

    Queries of equal probability are let in together in no order: each stands for their mean.
    """
    order = np.argsort(-probabilities, kind="stable")
    _, group, counts = np.unique(-probabilities[order], return_inverse=True, return_counts=True)
    missed = np.bincount(group, weights=(~hits[order]).astype(np.float64), minlength=len(counts)) / counts
    share = np.arange(1, len(hits) + 1)
    risk = np.cumsum(missed[group]) / share
    first = risk[:1] if len(risk) else np.zeros(1)
    return np.concatenate([[0.0], share / max(1, len(hits))]), np.concatenate([first, risk])


def share_rejected(probabilities: Floats, hits: Hits) -> float:
    """Returns the share of wrong answers that go where 90 % of the right ones are kept.

    NaN where nothing is wrong, nothing right, or a probability not known.
    """
    if np.isnan(probabilities).any() or hits.all() or not hits.any():
        return math.nan
    return float(np.mean(probabilities[~hits] < np.quantile(probabilities[hits], 1.0 - _KEPT)))


def share_rejectable(probabilities: Floats) -> float:
    """Returns what ``share_rejected`` is expected to be if every probability is exact; NaN if all are 0 or 1.

    How well right and wrong answers can be separated is limited by how sure the answers are: of those
    that all say one half no more wrong ones go than right ones, however true that is.
    """
    given = np.sort(probabilities)
    wrong = np.concatenate([[0.0], np.cumsum(1.0 - given)])
    right = np.concatenate([[0.0], np.cumsum(given)])
    if wrong[-1] <= 0 or right[-1] <= 0:
        return math.nan
    lost = int(np.searchsorted(right, (1.0 - _KEPT) * right[-1] + 1e-9, side="right")) - 1
    return float(wrong[lost] / wrong[-1])


def _bins(confidence: Floats, hits: Hits, num_bins: int) -> tuple[ReliabilityBin, ...]:
    index = np.minimum((confidence * num_bins).astype(np.int64), num_bins - 1)
    bins = []
    for b in np.unique(index):
        mine = index == b
        low, high = wilson_interval(hits[mine])
        bins.append(
            ReliabilityBin(
                low=float(b) / num_bins,
                high=float(b + 1) / num_bins,
                count=int(mine.sum()),
                confidence=float(confidence[mine].mean()),
                hit_share=float(hits[mine].mean()),
                interval=(low / 100.0, high / 100.0),
            )
        )
    return tuple(bins)


def is_taken(name: str) -> bool:
    """Tells whether a number of a metric may not be called so: something of lodbench's own is."""
    return _TAKEN.fullmatch(name) is not None


def compute_metrics(queries: pd.DataFrame) -> dict[str, float]:
    """Returns the numbers of all installed metrics over the queries of one split that have a truth.

    A metric that fails is left out with a warning: the run's other numbers stand.
    """
    numbers: dict[str, float] = {}
    for name, metric in installed_metrics().items():
        try:
            metric_numbers = {str(key): float(value) for key, value in metric(queries).items()}
        except STOPPED:
            raise
        except BaseException as error:  # whatever a plug-in's own code raises
            warnings.warn(f"metric {name} is left out: {type(error).__name__}: {error}", stacklevel=2)
            continue
        if twice := sorted(metric_numbers.keys() & numbers.keys()):
            warnings.warn(f"metric {name} is left out: {twice[0]} is another metric's", stacklevel=2)
            continue
        if taken := sorted(filter(is_taken, metric_numbers)):
            warnings.warn(f"metric {name} is left out: {taken[0]} is a name of lodbench's own", stacklevel=2)
            continue
        numbers |= metric_numbers
    return numbers


def installed_metrics() -> dict[str, Metric]:
    """Returns the installed metrics by name, our own first; a broken one is left out with a warning."""
    metrics: dict[str, Metric] = {}
    for plug_in in installed("metrics"):
        try:
            metrics.setdefault(plug_in.name, plug_in.load())
        except ConfigError as error:
            warnings.warn(f"metric {plug_in.name} is left out: {error.message}", stacklevel=3)
    return metrics


def error_parts(queries: pd.DataFrame) -> dict[str, float]:
    """Returns medians of the error along the ground, and of the sizes of those of height and yaw."""
    parts = queries[["horizontal_error_m", "vertical_error_m", "yaw_error_deg"]].abs().median()
    return dict(zip(_PARTS, map(float, parts), strict=True))


def mask_iou(queries: pd.DataFrame) -> dict[str, float]:
    """Returns the mean IoU of the query masks with the model's silhouette at the truth (paper, Table 4)."""
    return {"mask_iou": float(queries["mask_iou"].mean())}


def calibration(queries: pd.DataFrame) -> dict[str, float]:
    """Returns how a method's probabilities of being within (2 m, 2 deg) compare with what it found, percent.

    The mean probability, the expected calibration error (Guo et al. 2017, ten bins) and the area under
    the risk-coverage curve (Geifman and El-Yaniv 2017); NaN where the method gives no probability. A
    query without an answer is one that the method declined: its probability is 0.
    """
    if queries["probability"].isna().all():
        return dict.fromkeys(_CALIBRATION, math.nan)
    confidence = queries["probability"].fillna(0.0).to_numpy()
    errors = queries[["translation_error_m", "rotation_error_deg"]].to_numpy()
    calibrated = calibrate(confidence, hits_of(errors, PROBABILITY_THRESHOLD))
    return dict(
        zip(
            _CALIBRATION,
            (100.0 * float(confidence.mean()), 100.0 * calibrated.ece, 100.0 * calibrated.aurc),
            strict=True,
        )
    )
