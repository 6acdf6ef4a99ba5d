"""How well methods find poses over a real model: recalls and medians beside their priors'.

Every method runs every view twice, with the true tilt in the prior and with a tilt in error. Masks may come
from another level of detail than the map that is searched.
"""

from __future__ import annotations

import math
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.bench import Figure, Progress, Report, no_progress
from lodbench.citymodel.model import lod_in_words
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import ConfigError, DatasetError, LodbenchError
from lodbench.evaluation import DEFAULT_THRESHOLDS, SplitSummary, metrics
from lodbench.evaluation.pose_errors import PROBABILITY_THRESHOLD, hits_of, pose_error
from lodbench.harness.runs.artefacts import Run
from lodbench.harness.runs.run import RunSettings, run_method
from lodbench.methods import Method
from lodbench.methods.protocol import SupportsPriorWidth
from lodbench.plugins import blaming
from lodbench.reporting.aligned_text import count_of, format_columns
from lodbench.reporting.figures import draw_calibration
from lodbench.reporting.table_heads import finite_text
from lodbench.segmentation.masks import MaskFiles, MasksParams
from lodbench.synthesis.views import FINE_SIZE
from lodbench.synthesis.views_dataset import SPLIT, ViewsParams, drawing_facts, open_views

if TYPE_CHECKING:
    import pandas as pd

# The two blocks: pitch and roll of the prior true, or drawn with an error.
TILTS = ("truth", "prior")
_HEAD = ("median m", "median deg", "hypotheses", "s/query", "ece %", "aurc %")
_GLOSSARY = (
    "ece: expected calibration error, mean distance of the probability a method gives of being within "
    "(2 m, 2 deg) from the share it found; aurc: area under the risk-coverage curve, the share not found as "
    "the surest 0 to 100 % are answered, averaged."
)
# Answers that a user takes without a look, and those that are more likely right than wrong.
_SURE, _LIKELY = 0.9, 0.5
_CITY_HEAD = ("views", "2m-2deg %", "median m", "median deg", "vertical m", "probability %")
_DIGITS = (".0f", ".1f", ".2f", ".2f", "+.2f", ".1f")
_CITY_GLOSSARY = (
    "vertical: median error in height, above 0 too high; probability: mean of what a method gives of being "
    "within (2 m, 2 deg); mean: over cities, each counting alike; rejected: wrong answers, of all cities, "
    "whose probability is below that of 90 % of the right ones, and how many that would be on the average "
    "of worlds in which every probability is exact."
)


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """One run of a sweep."""

    method: Method  # what finds poses
    views: ViewsParams  # of which city, drawn how
    tilt: str = "prior"  # ``truth`` or ``prior``
    # Columns of the sweep's table that tell this run from others.
    labels: Mapping[str, Any] = field(default_factory=dict)
    # How far off the method is given that priors may be; None for as far as they are.
    stated: UniformPrior | None = None


def sweep(jobs: Sequence[Job], progress: Progress = no_progress, threads: int | None = None) -> pd.DataFrame:
    """Returns the queries of runs over views, one row each, as ``lodbench.evaluation.metrics`` has them.

    Further columns are ``method``, ``seed``, ``seconds``, ``pose`` (the estimate in the city's frame, or
    None), ``is_any_kept_found`` (whether that or one of its alternatives lies within (2 m, 2 deg)),
    ``map_lod``, ``mask_lod``, ``rejections`` and the jobs' labels. A ``score`` below ``mask_iou``, what the
    true pose would score, is a failure of the search; a higher one says that the mask fits a wrong pose
    better. A method that can is given how far off the priors may be, tilt included (0 with the true one);
    never whether they are.

    Args:
        jobs: The runs.
        progress: Called after each.
        threads: Of the engine; None for one per core. Results do not depend on it.

    Raises:
        LodbenchError: The city cannot be read, or no views can be drawn over it.
    """
    import pandas as pd

    tables = []
    for number, job in enumerate(jobs, start=1):
        tables.append(_queries_of(job, threads))
        progress(number, len(jobs))
    return pd.concat(tables)


def with_prior_range(method: Method, prior: UniformPrior) -> Method:
    """Returns a method that is given how far off priors may be, if it is one that can be."""
    if not isinstance(method, SupportsPriorWidth):
        return method
    with blaming("methods", method.name, "take the width of priors"):
        made: Method = type(method)(method.params_for_prior(prior))  # type: ignore[call-arg]
    return made


def of_seeds(views: ViewsParams, seeds: Sequence[int]) -> list[ViewsParams]:
    """Returns what is drawn for each seed.

    Raises:
        ConfigError: There is no seed, or one twice.
    """
    if not seeds or len(set(seeds)) < len(seeds):
        raise ConfigError(f"seeds are one or more different numbers, not {list(seeds)}.")
    return [replace(views, views_seed=seed) for seed in seeds]


def protocol_of(views: ViewsParams, seeds: Sequence[int]) -> str:
    """Returns in words what is drawn."""
    prior, (width, height) = views.prior(), FINE_SIZE
    return (
        f"masks of {width} x {height} degraded to IoU {views.mask_iou:g}, priors +-{prior.x_m:g}/"
        f"+-{prior.y_m:g}/+-{prior.z_m:g} m and +-{prior.yaw_deg:g} deg yaw, with tilt=prior "
        f"+-{views.tilt_deg:g} deg pitch and roll, seed{'s' if len(seeds) > 1 else ''} "
        + ", ".join(map(str, seeds))
        + ("" if views.rtk_m is None else f", RTK to {views.rtk_m:g} m along each axis")
        + ("" if views.laser_m is None else f", a laser's range to {views.laser_m:g} m")
        + (f", {views.area}ern half of the city" if views.area else "")
        + (f", a world of {views.world.describe()}" if views.world.describe() else "")
    )


def _queries_of(job: Job, threads: int | None) -> pd.DataFrame:
    dataset = open_views(job.views)
    method = with_prior_range(job.method, job.stated or job.views.prior(job.tilt))
    with tempfile.TemporaryDirectory() as scratch:
        settings = RunSettings(Path(scratch), threads=threads, tilt=job.tilt, seed=job.views.views_seed)
        settings = replace(settings, stream_names=_stream_names)
        run = run_method(method, dataset, MaskFiles(MasksParams()), settings)
    answers = [run.predictions[key] for key in run.queries.index]
    return run.queries.assign(
        method=method.name,
        seed=job.views.views_seed,
        seconds=[sum(answer.seconds.values()) for answer in answers],
        pose=np.array([answer.pose for answer in answers], dtype=object),
        is_any_kept_found=[_is_any_hit(dataset, run, key) for key in run.queries.index],
        map_lod=run.lod or "",
        **drawing_facts(dataset),
        **job.labels,
    )


def _is_any_hit(dataset: Dataset, run: Run, key: str) -> bool:
    answer = run.predictions[key]
    kept = [pose for pose in (answer.pose, *answer.alternatives) if pose is not None]
    errors = [pose_error(pose, dataset.truth[key]) for pose in kept]
    return bool(kept) and bool(hits_of(np.array(errors), PROBABILITY_THRESHOLD).any())


def _stream_names(entry: Entry) -> tuple[str, ...]:
    """Returns names that know neither the tilt nor the dataset's own: all blocks try the same moves."""
    return "accuracy", Path(entry.name).stem


class Block(NamedTuple):
    """What one method made of all views under one tilt."""

    tilt: str
    method: str
    is_only: bool
    queries: pd.DataFrame
    summary: SplitSummary
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
        blocks.append(Block(tilt, method, len(methods) == 1, mine, *metrics.summarize_queries(mine, SPLIT)))
    return blocks


def _drawn(views: ViewsParams, queries: pd.DataFrame) -> str:
    first, runs = queries.iloc[0], queries.drop_duplicates("seed")
    city = Path(views.city_model).name
    if views.mask_lod is not None or views.lod is not None:
        city += f" (masks {lod_in_words(first['mask_lod'])}, map {lod_in_words(first['map_lod'])})"
    count = count_of(views.num_views * len(runs), "views")
    return f"{city}, {count} ({runs['rejections'].sum()} draws rejected)"


def _is_hit(rows: pd.DataFrame) -> NDArray[np.bool_]:
    return hits_of(rows[list(metrics.ERROR)].to_numpy(), PROBABILITY_THRESHOLD)


def _calibrations(blocks: Sequence[Block]) -> dict[str, metrics.Calibration]:
    """Returns how calibrated methods are that give a probability, by method and tilt in words."""
    return {
        f"{b.method}, tilt={b.tilt}": metrics.calibrate(
            b.queries["probability"].fillna(0.0).to_numpy(), _is_hit(b.queries)
        )
        for b in blocks
        if b.queries["probability"].notna().any()
    }


def _pictures(calibrations: dict[str, metrics.Calibration]) -> dict[str, bytes]:
    drawn = draw_calibration(calibrations) if calibrations else {}
    return {f"calibration.{kind}": picture for kind, picture in drawn.items()}


def _figures(block: Block) -> Iterator[Figure]:
    summary, prior = block.summary, block.prior
    name = f"tilt={block.tilt}" if block.is_only else f"{block.method} tilt={block.tilt}"
    for label, percent in summary.recall.items():
        yield Figure(f"recall {label} {name}", percent, "%", "prior", prior.recall[label])
        for end, bound in zip(("low", "high"), summary.interval[label], strict=True):
            yield Figure(f"recall {label} {name} {end}", bound, "%")
    for median, unit in (("median_translation_m", "m"), ("median_rotation_deg", "deg")):
        value, beside = getattr(summary, median), getattr(prior, median)
        yield Figure(f"{median} {name}", value, unit, "prior", beside, beside / value if value else None)
    yield Figure(f"hypotheses per query {name}", summary.hypotheses_per_query, "")
    yield Figure(f"seconds per query {name}", float(block.queries["seconds"].mean()), "s")
    if math.isfinite(summary.metrics.get("ece_percent", math.nan)):
        yield Figure(f"mean probability {name}", summary.metrics["mean_confidence_percent"], "%")
        yield Figure(f"calibration error {name}", summary.metrics["ece_percent"], "%")
        yield Figure(f"area under risk over coverage {name}", summary.metrics["aurc_percent"], "%")


def _table(blocks: Sequence[Block]) -> str:
    """Returns recalls and medians as text: below each tilt the priors, then the methods."""
    rows = [["", *(f"{t.label} %" for t in DEFAULT_THRESHOLDS), *_HEAD]]
    for block in blocks:
        name = f"tilt={block.tilt}  "
        if block.method == blocks[0].method:
            rows.append([f"{name}prior", *_errors(block.prior), "-", "-", "-", "-"])
        summary, seconds = block.summary, block.queries["seconds"].mean()
        hypotheses = finite_text(summary.hypotheses_per_query or math.nan, ".0f")
        ece, aurc = (summary.metrics.get(f"{metric}_percent") for metric in ("ece", "aurc"))
        costs = [hypotheses, f"{seconds:.2f}", finite_text(ece, ".1f"), finite_text(aurc, ".2f")]
        rows.append([f"{name}{block.method}", *_errors(summary), *costs])
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
        is_hit, stated = _is_hit(block.queries), block.queries["probability"].fillna(0.0).to_numpy()
        is_sure = stated >= _SURE
        wrong_m = block.queries[metrics.ERROR[0]].to_numpy()[is_sure & ~is_hit]
        most = f" (up to {wrong_m.max():.1f} m)" if len(wrong_m) else ""
        yield (
            f"{_whose(block)}: states {100 * stated.mean():.1f} % in the mean; of {is_sure.sum()} at {_SURE} "
            f"or more {len(wrong_m)} are wrong{most}; {(is_hit & (stated >= _LIKELY)).sum()} of "
            f"{is_hit.sum()} within (2 m, 2 deg) state {_LIKELY} or more."
        )


def _whose(block: Block) -> str:
    return f"tilt={block.tilt}" if block.is_only else f"tilt={block.tilt} {block.method}"


def _missed(block: Block) -> str:
    """Returns whether the search or the mask is to blame for what was not found."""
    missed = block.queries[~_is_hit(block.queries)]
    unfound = int((missed["score"].fillna(0.0) < missed["mask_iou"]).sum())
    return (
        f"{_whose(block)}: {len(missed)} not within (2 m, 2 deg); in {unfound} of them the truth fits better "
        f"than the estimate, in {len(missed) - unfound} it does not."
    )


def measure_cities(
    cities: Sequence[ViewsParams],
    seeds: Sequence[int],
    methods: Sequence[Method],
    progress: Progress = no_progress,
    threads: int | None = None,
) -> Report:
    """Returns how well methods find seeded views over several cities; ``data`` is the table of ``sweep``.

    A city over which no views can be drawn, or that cannot be read, has no row and is named with its reason.

    Raises:
        DatasetError: No city is left.
    """
    drawn, left_out = drawable(cities, seeds)
    names = names_of(cities)
    jobs = [Job(m, v, t, {"city": names[v.city_model]}) for t, m, v in product(TILTS, methods, drawn)]
    queries = sweep(jobs, progress, threads)
    groups = [
        ((t, m.name), queries[(queries["tilt"] == t) & (queries["method"] == m.name)])
        for t, m in product(TILTS, methods)
    ]
    lines = [_city_table(groups), f"{protocol_of(drawn[0], seeds)}.", *left_out]
    lines += [f"tilt={tilt} {method}: {_rejected_in_words(rows)}" for (tilt, method), rows in groups]
    return Report("\n".join([*lines, _CITY_GLOSSARY]), list(_city_figures(groups)), queries)


def drawable(cities: Sequence[ViewsParams], seeds: Sequence[int]) -> tuple[list[ViewsParams], list[str]]:
    """Returns what is drawn over the cities for each seed, and why those have none that are left out.

    Raises:
        DatasetError: No city is left.
    """
    names, drawn, left_out = names_of(cities), [], []
    for city in cities:
        try:
            drawn += [view for view in of_seeds(city, seeds) if open_views(view)]
        except LodbenchError as error:
            left_out.append(f"{names[city.city_model]} is left out: {error}")
    if not drawn:
        raise DatasetError("No city is left to find views in.", "; ".join(left_out))
    return drawn, left_out


def names_of(cities: Sequence[ViewsParams]) -> dict[str, str]:
    """Returns what tables call each city model: its file's name, or its path where others share that."""
    files = {views.city_model: Path(views.city_model).name for views in cities}
    counts = Counter(files.values())
    return {model: name if counts[name] == 1 else model for model, name in files.items()}


def percent_within(queries: pd.DataFrame) -> float:
    """Returns the percentage within (2 m, 2 deg)."""
    return 100.0 * float(hits_of(queries[list(metrics.ERROR)].to_numpy(), PROBABILITY_THRESHOLD).mean())


def _city_table(groups: Sequence[tuple[tuple[str, str], pd.DataFrame]]) -> str:
    rows = [["", *_CITY_HEAD]]
    for (tilt, method), queries in groups:
        cities = [(city, _row(of_city)) for city, of_city in queries.groupby("city", sort=False)]
        mean = np.mean([row for _, row in cities], axis=0).tolist()
        for city, row in [*cities, (f"mean of {len(cities)}", [len(queries), *mean[1:]])]:
            texts = [finite_text(value, form) for value, form in zip(row, _DIGITS, strict=True)]
            rows.append([f"tilt={tilt}  {method}  {city}", *texts])
    return format_columns(rows)


def _row(queries: pd.DataFrame) -> list[float]:
    medians = [float(queries[name].median()) for name in (*metrics.ERROR, "vertical_error_m")]
    given = queries["probability"]
    mean = float(given.fillna(0.0).mean()) if given.notna().any() else float("nan")
    return [len(queries), percent_within(queries), *medians, 100.0 * mean]


def _rejection(queries: pd.DataFrame) -> tuple[float, float]:
    """Returns the share of wrong answers rejected, and what is expected; without an answer: probability 0."""
    given = queries["probability"].fillna(0.0).to_numpy()
    right = hits_of(queries[list(metrics.ERROR)].to_numpy(), PROBABILITY_THRESHOLD)
    return metrics.share_rejected(given, right), metrics.share_rejectable(given)


def _rejected_in_words(queries: pd.DataFrame) -> str:
    if not queries["probability"].notna().any():
        return "gives no probability."
    share, most = _rejection(queries)
    if share != share:
        return "nothing to reject."
    bound = "" if most != most else f"; {100.0 * most:.0f} % were each probability exact"
    return f"{100.0 * share:.0f} % of wrong answers rejected{bound}."


def _city_figures(groups: Sequence[tuple[tuple[str, str], pd.DataFrame]]) -> Iterator[Figure]:
    for (tilt, method), queries in groups:
        recalls = []
        for city, of_city in queries.groupby("city", sort=False):
            recalls.append(_row(of_city)[1])
            yield Figure(f"recall 2m-2deg {method} tilt={tilt} {city}", recalls[-1], "%")
        yield Figure(f"mean recall 2m-2deg {method} tilt={tilt}", float(np.mean(recalls)), "%")
        share, most = _rejection(queries)
        yield Figure(f"wrong answers rejected {method} tilt={tilt}", 100.0 * share, "%")
        if queries["probability"].notna().any():
            yield Figure(f"wrong answers rejected {method} tilt={tilt}, expected", 100.0 * most, "%")
