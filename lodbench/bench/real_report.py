"""Priors and ends on real photos: recall, whether wrong answers are known, and a picture of basins."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lodbench.bench.figures import Figure, Report
from lodbench.evaluation.queries import ERROR
from lodbench.evaluation.recall import Threshold, hits_of
from lodbench.evaluation.statistics import bootstrap_ratio
from lodbench.reporting.aligned_text import format_columns
from lodbench.reporting.figures import SERIES, draw_figure

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

LIMITS = (Threshold(2, 1), Threshold(2, 2), Threshold(3, 3), Threshold(5, 5))
# A right answer, and the share of them that a threshold on the probability lets through.
_RIGHT = Threshold(2, 2)
_KEPT = 0.9
# The squared length, in standard deviations, that 95 % of Gaussian errors in three directions stay below.
_HELD, _SURPRISE = 0.95, 7.8147


def report_real(trials: pd.DataFrame, title: str) -> Report:
    """Returns the report of trials: a table of methods, one of trials, and a picture of basins.

    Args:
        trials: A row per method, photo and prior: ``method``, ``photo``, ``prior`` (the number of a drawn
            one, or ``published``), ``prior_translation_error_m``, ``prior_rotation_error_deg``,
            ``translation_error_m``, ``rotation_error_deg`` (infinite without an answer), ``prior_east_m``,
            ``prior_north_m``, ``east_m``, ``north_m`` (less the truth's), ``score``, ``probability`` (of
            being within 2 m and 2 degrees; NaN where the method says none), ``surprise`` (squared error of
            the place in standard deviations, by the covariance that was said; NaN where none was),
            ``seconds``, ``cpu_seconds``, ``failure``.
        title: Data and protocol in words.
    """
    by_method = {str(name): rows for name, rows in trials.groupby("method", sort=False)}
    figures = [figure for name, rows in by_method.items() for figure in _figures(name, rows)]
    text = "\n".join([title, _summary(by_method), "", _table(trials)])
    return Report(text, figures, trials, partial(_pictures, by_method))


def found(trials: pd.DataFrame, limit: Threshold) -> NDArray[np.bool_]:
    """Returns (N,) which answers are nearer than metres and degrees."""
    return hits_of(trials[list(ERROR)].to_numpy(), limit)


def flagged(trials: pd.DataFrame) -> float | None:
    """Returns the share of a method's wrong answers below the threshold that 90 % of right ones pass.

    None where the method says no probability, or nothing is wrong or nothing right.
    """
    probability, right = trials["probability"].to_numpy(np.float64), found(trials, _RIGHT)
    if np.isnan(probability).any() or right.all() or not right.any():
        return None
    return float(np.mean(probability[~right] < np.quantile(probability[right], 1.0 - _KEPT)))


def held(trials: pd.DataFrame) -> NDArray[np.bool_] | None:
    """Returns (N,) which places lie in the ellipsoid said to hold 95 % of them; None where none is said.

    Answers without a covariance are left out.
    """
    surprise = trials["surprise"].to_numpy(np.float64)
    said = surprise[~np.isnan(surprise)]
    return np.asarray(said < _SURPRISE) if len(said) else None


def _figures(name: str, rows: pd.DataFrame) -> Iterator[Figure]:
    for limit in LIMITS:
        yield Figure(f"{name}: recall {limit.label}", 100.0 * float(found(rows, limit).mean()), "%")
    middle = rows[[*ERROR, "seconds", "cpu_seconds"]].median()
    yield Figure(f"{name}: median translation", float(middle[ERROR[0]]), "m")
    yield Figure(f"{name}: median rotation", float(middle[ERROR[1]]), "deg")
    yield Figure(f"{name}: priors", float(len(rows)), "")
    yield Figure(f"{name}: seconds", float(middle["seconds"]), "s")
    yield Figure(f"{name}: CPU seconds", float(middle["cpu_seconds"]), "s")
    inside, share = held(rows), flagged(rows)
    if inside is not None:
        yield Figure(f"{name}: places within the said {100 * _HELD:g} %", 100.0 * float(inside.mean()), "%")
    if share is not None:
        yield Figure(f"{name}: wrong answers flagged, 90 % of right kept", 100.0 * share, "%")


def _summary(by_method: dict[str, pd.DataFrame]) -> str:
    head = [f"{limit.translation_m:g} m, {limit.rotation_deg:g} deg" for limit in LIMITS]
    cells = [["method", *head, "95 % at 2 m, 2 deg", "median", "s", "CPU s", "in said 95 %", "wrong flagged"]]
    for name, rows in by_method.items():
        middle = rows[[*ERROR, "seconds", "cpu_seconds"]].median()
        inside, share = held(rows), flagged(rows)
        cells.append(
            [
                name,
                *(f"{int(found(rows, limit).sum())} of {len(rows)}" for limit in LIMITS),
                _interval(rows),
                f"{middle[ERROR[0]]:.2f} m, {middle[ERROR[1]]:.2f} deg",
                f"{middle['seconds']:.2f}",
                f"{middle['cpu_seconds']:.2f}",
                "-" if inside is None else f"{100 * inside.mean():.0f} %",
                "-" if share is None else f"{100 * share:.0f} %",
            ]
        )
    return format_columns(cells)


def _interval(trials: pd.DataFrame) -> str:
    """Returns the 95 % interval of right answers over photos: answers to one share what is wrong with it."""
    right = trials.assign(right=found(trials, _RIGHT)).groupby("photo")["right"].agg(["sum", "count"])
    if len(right) < 2:
        return "-"
    low, high = bootstrap_ratio(*right.to_numpy(np.float64).T)
    return f"{100.0 * low:.0f} to {100.0 * high:.0f} %"


def _table(trials: pd.DataFrame) -> str:
    cells = [["method", "photo", "prior", "off by", "error", "score", "probability", ""]]
    for _, t in trials.iterrows():
        cells.append(
            [
                t["method"],
                t["photo"],
                t["prior"],
                f"{t['prior_translation_error_m']:.1f} m, {t['prior_rotation_error_deg']:.1f} deg",
                f"{t['translation_error_m']:.2f} m, {t['rotation_error_deg']:.2f} deg",
                f"{t['score']:.3f}",
                "-" if np.isnan(t["probability"]) else f"{t['probability']:.2f}",
                t["failure"],
            ]
        )
    return format_columns(cells)


def _pictures(by_method: dict[str, pd.DataFrame]) -> dict[str, bytes]:
    """Returns, for each method, from each prior to where it ended, seen from above."""

    def draw(canvas: Canvas) -> None:
        axes = canvas.subplots(1, len(by_method), squeeze=False)[0]
        for axis, (name, rows) in zip(axes, by_method.items(), strict=True):
            _draw_basins(axis, name, rows)

    return {f"basins.{kind}": png for kind, png in draw_figure(5.0 * len(by_method), 5.0, draw).items()}


def _draw_basins(axis: Axes, name: str, rows: pd.DataFrame) -> None:
    right = found(rows, _RIGHT)
    places = rows[["prior_east_m", "prior_north_m", "east_m", "north_m"]].to_numpy().reshape(-1, 2, 2)
    for (start, end), is_right in zip(places, right, strict=True):
        colour = SERIES[0] if is_right else SERIES[1]
        axis.plot(*np.column_stack([start, end]), color=colour, alpha=0.4, linewidth=1.0)
        axis.plot(*start, "o", color=colour, markersize=3, fillstyle="none")
        axis.plot(*end, "o", color=colour, markersize=4)
    axis.plot(0.0, 0.0, "+", color="black", markersize=12)
    axis.set(
        title=f"{name}: {int(right.sum())} of {len(rows)} within 2 m and 2 deg",
        xlabel="east of the truth, m",
        ylabel="north of the truth, m",
        aspect="equal",
    )
