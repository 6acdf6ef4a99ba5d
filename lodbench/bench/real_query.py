"""`lodbench bench real`: posed photos, priors drawn anew around their truth, and where methods end."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.bench import Progress, Report, no_progress
from lodbench.bench.real_report import EdgeBound, PhotoEdges, median_and_share, report_real
from lodbench.citymap import CityMap
from lodbench.citymap.places import ground_errors
from lodbench.citymodel.scene import Scene, building_boxes
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Dataset, Query
from lodbench.errors import ConfigError, DatasetError, QueryFault
from lodbench.evaluation import pose_error
from lodbench.evaluation.metrics import ERROR, PRIOR_ERROR
from lodbench.evaluation.pose_errors import FAILED
from lodbench.geometry import Camera, Pose
from lodbench.geometry.camera import pixel_rays
from lodbench.harness.runs.queries import Preparation
from lodbench.harness.runs.requirements import segmented_inputs
from lodbench.methods import Method
from lodbench.methods.localize import localize_flight, localize_query
from lodbench.methods.protocol import Estimate, SupportsFlights
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.rendering.surfaces import Surfaces
from lodbench.reporting.overlays import OverlayInput, draw_overlay, png_bytes
from lodbench.segmentation import Segmenter
from lodbench.segmentation.masks import read_photo
from lodbench.storage import random_stream
from lodbench.synthesis.flights import SensorErrors, moved

Answer = Estimate | QueryFault
PUBLISHED = "published"
# About so many pixels of a photo, in a grid, are placed on the map or the ground.
_PIXELS = 100


@dataclass(frozen=True, slots=True)
class RealOptions:
    """What to measure.

    Attributes:
        priors: How many are drawn of each photo; none if only the published ones are requested.
        prior: Half widths of their errors.
        is_shared: Whether photos of a flight err together, see ``shared_and_own``.
        is_published_too: Whether the set's own priors are measured besides.
        is_published_only: Whether none is drawn.
        is_bounded: Whether what edges leave open from the true poses is measured besides.
        seed: Of what is drawn.
    """

    priors: int = 20
    prior: UniformPrior = UniformPrior()  # noqa: RUF009 - frozen
    is_shared: bool = False
    is_published_too: bool = True
    is_published_only: bool = False
    is_bounded: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        if self.priors < 1:
            raise ConfigError(f"--priors {self.priors} is not a number of priors.")

    def labels(self) -> list[str]:
        """Returns the names of the priors that each photo is given."""
        drawn = [] if self.is_published_only else [str(number) for number in range(self.priors)]
        return [*drawn, *([PUBLISHED] if self.is_published_too or self.is_published_only else [])]

    def describe(self) -> str:
        """Returns the priors in words."""
        if self.is_published_only:
            return "the set's own priors"
        return self.prior.describe() + (", mostly shared by a flight's photos" if self.is_shared else "")


class RealSet(NamedTuple):
    """Posed photos over their map, and what makes masks for methods that want one."""

    dataset: Dataset
    scene: Scene
    segmenter: Segmenter


@dataclass(frozen=True, slots=True, eq=False)
class _Shot:
    """One photo of a set."""

    key: str  # its entry's
    flight: tuple[str, str]  # those of one flight are solved together
    query: Query  # with the set's own prior; scene frame, as the truth
    truth: Pose  # true pose
    edges: PhotoEdges | None  # of the photo; None where there is no photo
    height_m: float  # of the camera above the ground of the map
    surfaces: Surfaces  # the map's, and the ground
    pixels: NDArray[np.float64]  # (N, 2) of a grid, those that show map or ground


@dataclass(slots=True, eq=False)
class _Trials:
    """What was measured: rows, and by picture the answers that may be drawn."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    answers: dict[str, tuple[Scene, list[OverlayInput]]] = field(default_factory=dict)


def measure_real(
    sets: Sequence[RealSet],
    methods: Mapping[str, Method],
    options: RealOptions,
    progress: Progress = no_progress,
) -> Report:
    """Returns where methods end from redrawn priors of photos whose pose is known.

    All methods start from the same priors; one that solves flights is given all photos of a flight with one
    prior each. The truth draws priors and scores answers; no method is given it. ``data`` has the columns of
    ``report_real``; pictures are of basins, and of the median answer of each method to each photo.

    Args:
        sets: Photos with poses; masks are made once per photo and method that wants them.
        methods: What to measure, by name, made for the width of the prior.
        options: Which priors.
        progress: Called after each answer.

    Raises:
        DatasetError: No photo of a set has a pose.
    """
    import pandas as pd

    trials, truths = _Trials(), []
    counts = [sum(entry.key in photos.dataset.truth for entry in photos.dataset.entries) for photos in sets]
    total = sum(counts) * (len(methods) + options.is_bounded) * len(options.labels())
    for photos, count in zip(sets, counts, strict=True):
        if not count:
            name = photos.dataset.name
            raise DatasetError(f"None of the {len(photos.dataset.entries)} photos of {name} has a true pose.")
        city_map, edges = CityMap(photos.scene), _photo_edges(photos)
        truths += list(_at_truth(photos, edges, city_map))
        bound = {EdgeBound.name: _bound(photos, options)} if options.is_bounded else {}
        for label, method in {**methods, **bound}.items():
            shots = _shots(photos, method, edges, city_map)
            for prior in options.labels():
                answers = _answers(method, shots, prior, options, city_map)
                _note(trials, photos, label, prior, answers, city_map)
                progress(len(trials.rows), total)
    title = f"{', '.join(photos.dataset.name for photos in sets)}: priors {options.describe()}"
    report = report_real(pd.DataFrame(trials.rows), title, pd.DataFrame(truths))
    return replace(report, draw=lambda: report.draw() | _overlays(trials))


def _bound(photos: RealSet, options: RealOptions) -> EdgeBound:
    dataset, origin = photos.dataset, photos.scene.origin
    truths = {
        entry.name: dataset.truth[entry.key].shifted(-origin)
        for entry in dataset.entries
        if entry.key in dataset.truth
    }
    return EdgeBound(truths, options.prior)


def shared_and_own(prior: UniformPrior) -> tuple[SensorErrors, SensorErrors]:
    """Returns what the photos of a flight err by together, and each by itself: no further than the prior.

    Own errors are those of ``dataset=flights``, at most: 2 m, 0.3 deg of tilt, 2.5 deg of yaw.
    """
    widest = SensorErrors(
        max(prior.x_m, prior.y_m), prior.z_m, max(prior.pitch_deg, prior.roll_deg), prior.yaw_deg
    )
    own = SensorErrors(
        min(2.0, widest.horizontal_m / 2.0),
        min(2.0, widest.height_m / 2.0),
        min(0.3, widest.tilt_deg / 2.0),
        min(2.5, widest.yaw_deg / 2.0),
    )
    shared = SensorErrors(
        widest.horizontal_m - own.horizontal_m,
        widest.height_m - own.height_m,
        widest.tilt_deg - own.tilt_deg,
        widest.yaw_deg - own.yaw_deg,
    )
    return shared, own


def _photo_edges(photos: RealSet) -> dict[str, PhotoEdges]:
    return {
        entry.key: PhotoEdges(read_photo(entry.image), entry.camera)
        for entry in photos.dataset.entries
        if entry.image is not None and entry.camera is not None and entry.key in photos.dataset.truth
    }


def _at_truth(
    photos: RealSet, edges: Mapping[str, PhotoEdges], city_map: CityMap
) -> Iterator[dict[str, Any]]:
    """Yields how a photo's edges lie on the map's at its true pose: what no answer need better."""
    for key, of_photo in edges.items():
        truth = photos.dataset.truth[key].shifted(-photos.scene.origin)
        median, share = median_and_share(of_photo.distances(truth, city_map))
        yield {"set": photos.dataset.name, "photo": key, "edges_px": median, "edges_found": share}


def _shots(
    photos: RealSet, method: Method, edges: Mapping[str, PhotoEdges], city_map: CityMap
) -> list[_Shot]:
    dataset, scene = photos.dataset, photos.scene
    needs = segmented_inputs(method)
    preparation = Preparation(dataset, scene, photos.segmenter, "prior", needs, city_map)
    ground, surfaces = float(np.median(building_boxes(scene).low[:, 2])), Surfaces(scene)
    shots = []
    for entry in dataset.entries:
        if entry.key in dataset.truth:
            truth = preparation.local(dataset.truth[entry.key])
            # Priors are drawn around the truth: that the set has some is not requested.
            own = entry if entry.prior is not None else replace(entry, prior=dataset.truth[entry.key])
            flight, height_m = (entry.split, entry.sequence), float(truth.center[2]) - ground
            query = preparation.query(own)
            pixels = _placed_pixels(query.camera, truth, surfaces)
            of_photo = edges.get(entry.key)
            shots.append(_Shot(entry.key, flight, query, truth, of_photo, height_m, surfaces, pixels))
    return shots


def _placed_pixels(camera: Camera, truth: Pose, surfaces: Surfaces) -> NDArray[np.float64]:
    """Returns (N, 2) pixels of a grid, without those that show neither map nor ground from the true pose."""
    columns = max(1, round(math.sqrt(_PIXELS * camera.width / camera.height)))
    rows = max(1, round(_PIXELS / columns))
    u, v = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    pixels = np.column_stack([u.ravel() * camera.width, v.ravel() * camera.height])
    hits = surfaces.hit(truth.center, pixel_rays(camera, pixels).directions @ truth.rotation)
    return np.asarray(pixels[np.isfinite(hits.places[:, 0])])


def _prior(shot: _Shot, label: str, options: RealOptions) -> Pose:
    if label == PUBLISHED:
        return shot.query.prior
    own_stream = random_stream(options.seed, "bench real", shot.query.name, int(label))
    if not options.is_shared:
        return options.prior.draw(shot.truth, own_stream)
    shared, own = shared_and_own(options.prior)
    of_flight = random_stream(options.seed, "bench real", "flight", *shot.flight, int(label))
    return moved(shot.truth, shared.draw(of_flight) + own.draw(own_stream))


def _answers(
    method: Method, shots: Sequence[_Shot], label: str, options: RealOptions, city_map: CityMap
) -> Iterator[tuple[_Shot, Query, Answer, tuple[float, float]]]:
    """Yields each photo with the query, the answer, and seconds by the clock and of CPU."""
    flights: dict[Any, list[_Shot]] = {}
    for shot in shots:
        flights.setdefault(shot.flight if isinstance(method, SupportsFlights) else shot.key, []).append(shot)
    number = int(label) if label != PUBLISHED else options.priors
    for together in flights.values():
        priors = [_prior(shot, label, options) for shot in together]
        queries = [
            replace(
                shot.query,
                prior=prior,
                hypotheses=(prior,),
                measured=shot.query.measured and shot.query.measured.without_sigmas(),
            )
            for shot, prior in zip(together, priors, strict=True)
        ]
        streams = [
            partial(random_stream, options.seed, "bench real", query.name, number, "search")
            for query in queries
        ]
        wall, cpu = time.perf_counter(), time.process_time()
        answers: Sequence[Answer]
        if isinstance(method, SupportsFlights):
            answers = localize_flight(method, queries, city_map, streams).estimates
        else:
            try:
                answers = [localize_query(method, queries[0], city_map, streams[0])]
            except QueryFault as fault:
                answers = [fault]
        taken = (time.perf_counter() - wall) / len(answers), (time.process_time() - cpu) / len(answers)
        for shot, query, answer in zip(together, queries, answers, strict=True):
            yield shot, query, answer, taken


def _note(
    trials: _Trials,
    photos: RealSet,
    label: str,
    prior: str,
    answers: Iterator[tuple[_Shot, Query, Answer, tuple[float, float]]],
    city_map: CityMap,
) -> None:
    """Adds the rows of a method's answers, and what may be drawn of them."""
    name = photos.dataset.name
    for shot, query, answer, taken in answers:
        row = _row(shot, query, answer, taken, city_map)
        flight = "/".join(filter(None, shot.flight))
        trials.rows.append(
            {"set": name, "method": label, "photo": shot.key, "flight": flight, "prior": prior} | row
        )
        if isinstance(answer, Estimate):
            words = (name, label, shot.key) if shot.key.split("/")[0] != name else (label, shot.key)
            picture = "/".join(re.sub(r"[^A-Za-z0-9._-]", "_", word) for word in words)
            _, shown = trials.answers.setdefault(picture, (photos.scene, []))
            moved_m, turned = (f"{row[column]:.1f}" for column in ERROR)
            before = f"{query.name}: off by {row[PRIOR_ERROR[0]]:.1f} m before"
            caption = f"{before}, {moved_m} m and {turned} deg after"
            pose = answer.pose
            shown.append(
                OverlayInput(query.camera, None, query.image, query.prior, pose, shot.truth, caption)
            )


def _row(
    shot: _Shot, query: Query, answer: Answer, taken: tuple[float, float], city_map: CityMap
) -> dict[str, Any]:
    """Returns the measurements of one answer; a query without an answer has score and probability 0."""
    ends, errors = np.full(3, np.nan), FAILED
    row: dict[str, Any] = {"score": 0.0, "probability": 0.0, "surprise": math.nan, "failure": ""}
    edges, ground = (math.nan, math.nan), (math.inf, math.nan)
    if isinstance(answer, QueryFault):
        row["failure"] = answer.message
    else:
        ends, errors = answer.pose.center, pose_error(answer.pose, shot.truth)
        probability = math.nan if answer.probability is None else answer.probability
        row |= {"score": float(answer.score), "probability": probability}
        row["surprise"] = _surprise(answer, shot.truth)
        ground = _ground(shot, query, answer)
        if shot.edges is not None:
            edges = median_and_share(shot.edges.distances(answer.pose, city_map))
    start = query.prior.center - shot.truth.center
    return {
        **dict(zip((*PRIOR_ERROR, *ERROR), (*pose_error(query.prior, shot.truth), *errors), strict=True)),
        **dict(zip(("prior_east_m", "prior_north_m"), start, strict=False)),
        **dict(zip(("east_m", "north_m", "up_m"), ends - shot.truth.center, strict=True)),
        "height_m": shot.height_m,
        **row,
        **dict(zip(("edges_px", "edges_found"), edges, strict=True)),
        **dict(zip(("ground_m", "ground_held"), ground, strict=True)),
        **dict(zip(("seconds", "cpu_seconds"), taken, strict=True)),
    }


def _surprise(answer: Estimate, truth: Pose) -> float:
    """Returns the squared error of the place in standard deviations that were stated; NaN without any."""
    if answer.covariance is not None:
        missed = answer.pose.center - truth.center
        with suppress(np.linalg.LinAlgError):  # a plug-in may state that it is sure of one direction
            return float(missed @ np.linalg.solve(answer.covariance[:3, :3], missed))
    return math.nan


def _ground(shot: _Shot, query: Query, answer: Estimate) -> tuple[float, float]:
    """Returns how far from the truth pixels are placed, metres (median), and the share in the ellipse.

    A pixel in the sky is infinitely far; the share is NaN where no covariance is stated.
    """
    if not len(shot.pixels):
        return math.nan, math.nan
    covariance = np.zeros((6, 6)) if answer.covariance is None else answer.covariance
    errors = ground_errors(query.camera, answer.pose, covariance, shot.truth, shot.surfaces, shot.pixels)
    away = float(np.median(np.nan_to_num(errors.distance_m, nan=np.inf)))
    return away, math.nan if answer.covariance is None else float(errors.is_within.mean())


def _overlays(trials: _Trials) -> dict[str, bytes]:
    """Returns for each set, method and photo the picture of the answer of median error."""
    renderers: dict[int, SilhouetteRenderer] = {}
    drawn = {}
    for name, (scene, shown) in trials.answers.items():
        renderer = renderers.setdefault(id(scene), SilhouetteRenderer(scene, threads=1))
        errors = [np.linalg.norm(each.estimate.center - each.truth.center) for each in shown]  # type: ignore[union-attr]
        median = shown[int(np.argsort(errors, kind="stable")[len(errors) // 2])]
        drawn[f"{name}.png"] = png_bytes(draw_overlay(median, renderer))
    return drawn
