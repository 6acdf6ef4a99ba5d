"""How well methods find poses over a real model: recalls and medians beside their priors'.

Every method runs every view twice, with the true tilt in the prior and with a tilt in error. Masks may come
from another level of detail than the map that is searched.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.bench.figures import Figure, Progress, Report, no_progress
from lodbench.bench.views import TILTS, Job, of_seeds, protocol_of, sweep
from lodbench.citymodel.lods import lod_in_words
from lodbench.evaluation import DEFAULT_THRESHOLDS, SplitSummary
from lodbench.evaluation.metrics import Calibration, calibrate
from lodbench.evaluation.queries import ERROR, summarize_queries
from lodbench.evaluation.recall import PROBABILITY_THRESHOLD, hits_of
from lodbench.methods import Method
from lodbench.reporting.aligned_text import count_of, format_columns
from lodbench.reporting.figures import draw_calibration
from lodbench.reporting.table_columns import finite_text
from lodbench.synthesis.views_dataset import SPLIT, ViewsParams

if TYPE_CHECKING:
    import pandas as pd

_HEAD = ("median m", "median deg", "hypotheses", "s/query", "ece %", "aurc %")
_GLOSSARY = (
    "ece: expected calibration error, mean distance of the probability a method gives of being within "
    "(2 m, 2 deg) from the share it found; aurc: area under the risk-coverage curve, the share not found as "
    "the surest 0 to 100 % are answered, averaged."
)

# Answers that a user takes without a look, and those that are more likely right than wrong.
_SURE, _LIKELY = 0.9, 0.5


class Block(NamedTuple):
    """What one method made of all views under one tilt."""

    tilt: str
    method: str
    is_only: bool
    queries: pd.DataFrame
    found: SplitSummary
    prior: SplitSummary


def measure_accuracy(
    views: ViewsParams,
    seeds: Sequence[int],
    methods: Sequence[Method],
    progress: Progress = no_progress,
    threads: int | None = None,
) -> Report:
    """Returns how well methods find seeded views over a city; ``data`` is the table of ``sweep``.

    Raises:
        LodbenchError: The city cannot be read, or no views can be drawn over it.
    """
    drawn = of_seeds(views, seeds)
    queries = sweep([Job(m, v, tilt) for v, m, tilt in product(drawn, methods, TILTS)], progress, threads)
    return report_accuracy(queries, f"{_drawn(views, queries)}, {protocol_of(views, seeds)}")


def report_accuracy(queries: pd.DataFrame, protocol: str) -> Report:
    """Returns the report of a sweep over methods and tilts."""
    blocks = blocks_of(queries)
    calibrations = _calibrations(blocks)
    lines = [
        _table(blocks),
        f"{protocol}; in brackets the 95 % interval.",
        *map(_missed, blocks),
        *_trust(blocks),
    ]
    figures = [figure for block in blocks for figure in _figures(block)]
    text = "\n".join([*lines, _GLOSSARY] if calibrations else lines)
    return Report(text, figures, queries, partial(_pictures, calibrations))


def blocks_of(queries: pd.DataFrame) -> list[Block]:
    """Returns the blocks of a sweep: by tilt, of each tilt by method."""
    methods = list(dict.fromkeys(queries["method"]))
    blocks = []
    for tilt, method in product(TILTS, methods):
        mine = queries[(queries["tilt"] == tilt) & (queries["method"] == method)]
        blocks.append(Block(tilt, method, len(methods) == 1, mine, *summarize_queries(mine, SPLIT)))
    return blocks


def _drawn(views: ViewsParams, queries: pd.DataFrame) -> str:
    first, runs = queries.iloc[0], queries.drop_duplicates("seed")
    city = Path(views.city_model).name
    if views.mask_lod is not None or views.lod is not None:
        city += f" (masks {lod_in_words(first['mask_lod'])}, map {lod_in_words(first['map_lod'])})"
    count = count_of(views.num_views * len(runs), "views")
    return f"{city}, {count} ({runs['rejections'].sum()} draws rejected)"


def _is_found(rows: pd.DataFrame) -> NDArray[np.bool_]:
    return hits_of(rows[list(ERROR)].to_numpy(), PROBABILITY_THRESHOLD)


def _calibrations(blocks: Sequence[Block]) -> dict[str, Calibration]:
    """Returns how calibrated methods are that give a probability, by method and tilt in words."""
    return {
        f"{b.method}, tilt={b.tilt}": calibrate(
            b.queries["probability"].fillna(0.0).to_numpy(), _is_found(b.queries)
        )
        for b in blocks
        if b.queries["probability"].notna().any()
    }


def _pictures(calibrations: dict[str, Calibration]) -> dict[str, bytes]:
    drawn = draw_calibration(calibrations) if calibrations else {}
    return {f"calibration.{kind}": picture for kind, picture in drawn.items()}


def _figures(block: Block) -> Iterator[Figure]:
    found, prior = block.found, block.prior
    name = f"tilt={block.tilt}" if block.is_only else f"{block.method} tilt={block.tilt}"
    for label, percent in found.recall.items():
        yield Figure(f"recall {label} {name}", percent, "%", "prior", prior.recall[label])
        for end, bound in zip(("low", "high"), found.interval[label], strict=True):
            yield Figure(f"recall {label} {name} {end}", bound, "%")
    for median, unit in (("median_translation_m", "m"), ("median_rotation_deg", "deg")):
        value, beside = getattr(found, median), getattr(prior, median)
        yield Figure(f"{median} {name}", value, unit, "prior", beside, beside / value if value else None)
    yield Figure(f"hypotheses per query {name}", found.hypotheses_per_query, "")
    yield Figure(f"seconds per query {name}", float(block.queries["seconds"].mean()), "s")
    if math.isfinite(found.metrics.get("ece_percent", math.nan)):
        yield Figure(f"mean probability {name}", found.metrics["mean_confidence_percent"], "%")
        yield Figure(f"calibration error {name}", found.metrics["ece_percent"], "%")
        yield Figure(f"area under risk over coverage {name}", found.metrics["aurc_percent"], "%")


def _table(blocks: Sequence[Block]) -> str:
    """Returns recalls and medians as text: below each tilt the priors, then the methods."""
    rows = [["", *(f"{t.label} %" for t in DEFAULT_THRESHOLDS), *_HEAD]]
    for block in blocks:
        name = f"tilt={block.tilt}  "
        if block.method == blocks[0].method:
            rows.append([f"{name}prior", *_errors(block.prior), "-", "-", "-", "-"])
        found, seconds = block.found, block.queries["seconds"].mean()
        hypotheses = finite_text(found.hypotheses_per_query or math.nan, ".0f")
        ece, aurc = (found.metrics.get(f"{metric}_percent") for metric in ("ece", "aurc"))
        costs = [hypotheses, f"{seconds:.2f}", finite_text(ece, ".1f"), finite_text(aurc, ".2f")]
        rows.append([f"{name}{block.method}", *_errors(found), *costs])
    return format_columns(rows)


def _errors(summary: SplitSummary) -> list[str]:
    intervals = (f"[{low:.1f}, {high:.1f}]" for low, high in summary.interval.values())
    recalls = [f"{p:.1f} {i}" for p, i in zip(summary.recall.values(), intervals, strict=True)]
    return [*recalls, f"{summary.median_translation_m:.2f}", f"{summary.median_rotation_deg:.2f}"]


def _trust(blocks: Sequence[Block]) -> Iterator[str]:
    """Yields, of each method that states probabilities, what it states and how far that can be trusted."""
    for block in blocks:
        if block.queries["probability"].isna().all():
            continue
        is_found, stated = _is_found(block.queries), block.queries["probability"].fillna(0.0).to_numpy()
        is_sure = stated >= _SURE
        wrong_m = block.queries[ERROR[0]].to_numpy()[is_sure & ~is_found]
        most = f" (up to {wrong_m.max():.1f} m)" if len(wrong_m) else ""
        yield (
            f"{_whose(block)}: states {100 * stated.mean():.1f} % in the mean; of {is_sure.sum()} at {_SURE} "
            f"or more {len(wrong_m)} are wrong{most}; {(is_found & (stated >= _LIKELY)).sum()} of "
            f"{is_found.sum()} within (2 m, 2 deg) state {_LIKELY} or more."
        )


def _whose(block: Block) -> str:
    return f"tilt={block.tilt}" if block.is_only else f"tilt={block.tilt} {block.method}"


def _missed(block: Block) -> str:
    """Returns whether the search or the mask is to blame for what was not found."""
    missed = block.queries[~_is_found(block.queries)]
    unfound = int((missed["score"].fillna(0.0) < missed["mask_iou"]).sum())
    return (
        f"{_whose(block)}: {len(missed)} not within (2 m, 2 deg); in {unfound} of them the truth fits better "
        f"than the estimate, in {len(missed) - unfound} it does not."
    )
