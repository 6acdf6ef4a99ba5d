"""Whole flights over a real model: poses, what drone and map are wrong about, beside the truth."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from shapely import Polygon, box, unary_union

from lodbench.bench import Figure, Progress, Report, no_progress, plain_report
from lodbench.citymap import CityMap
from lodbench.citymap.city_map import corrected_map
from lodbench.citymodel.cache import open_cached_city
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.scene import Scene, building_boxes
from lodbench.datasets.query import Dataset, Query
from lodbench.errors import QueryFault
from lodbench.evaluation import pose_error
from lodbench.evaluation.metrics import Calibration, calibrate
from lodbench.evaluation.pose_errors import FAILED, PROBABILITY_THRESHOLD, PoseError, hits_of
from lodbench.geometry import Pose
from lodbench.harness.city import open_city
from lodbench.methods.flight.demolished_buildings import shares_held, views_of
from lodbench.methods.protocol import Estimate, FlightEstimate, SupportsFlights, SupportsPhotosAlone
from lodbench.segmentation import Segmenter
from lodbench.segmentation.masks import read_mask
from lodbench.storage import random_stream
from lodbench.synthesis.flights import MAP_TRUTH_FILE, FlightsParams, drone_errors, open_flights
from lodbench.synthesis.surroundings import make_surroundings, standing_clutter

# A height is recovered within this, metres.
RECOVERED_M = 0.5
# A place that is found may miss the building it is by this, metres.
_NEAR_M = 3.0
Floats = NDArray[np.float64]
# A building that so many photos show is one that a flight can speak of; of its height, if so many show its
# roof: the silhouette would change by so many pixels if it were so much higher, metres.
_FEWEST_PHOTOS, _FEWEST_OF_ROOF, _ROOF_PX, _ROOF_M = 3, 2, 5, 1.5
# What counts as a gimbal recovered, degrees.
_GIMBAL_DEG = 0.1


@dataclass(frozen=True, slots=True)
class MapScore:
    """Counts; those of several flights add up."""

    heights: int = 0  # buildings whose roofs photos show and whose heights the flight reports
    recovered: int = 0  # of them, those whose height against the map is reported within 0.5 m
    wrong: int = 0  # buildings whose roofs photos show and whose height was changed, reported or not
    doubted_wrong: int = 0  # of these, those in doubt
    doubted: int = 0  # buildings in doubt, whether photos can tell or not
    rightly: int = 0  # of the doubted, those whose height was changed
    demolished: int = 0  # buildings that stand in the map only, and that several photos should show
    reported_demolished: int = 0  # buildings reported as demolished
    rightly_demolished: int = 0  # of them, those that stand in the map only
    unmapped: int = 0  # buildings that the map lacks, and that several photos show
    found: int = 0  # of them, those found
    places: int = 0  # places reported as unmapped
    rightly_unmapped: int = 0  # of them, those where the map lacks one
    # Of the others, those where something else stands that no map holds: containers, tents, heaps.
    clutter: int = 0

    def __add__(self, other: MapScore) -> MapScore:
        """Returns the counts of both."""
        return MapScore(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


def score_map(
    findings: Mapping[str, Any],
    changed: Mapping[str, Any],
    shown: Collection[str],
    roofs: Collection[str],
    boxes: Mapping[str, Sequence[float]],
    clutter: Sequence[Sequence[float]] = (),
) -> MapScore:
    """Returns how a flight's findings compare with what was done to the map.

    Args:
        findings: ``buildings`` and ``changes``, as ``method=flight`` reports them.
        changed: ``heights`` (metres that a building is higher in the map than in truth, by id), ``missing``
            and ``extra`` (ids).
        shown: Ids of the buildings of either that at least three photos show.
        roofs: Ids of the map's buildings whose roofs at least two photos show.
        boxes: West, south, east and north of each missing building, the city's coordinates.
        clutter: The same of what stands there besides.
    """
    truth = changed["heights"]
    reported = {b["id"]: b for b in findings["buildings"] if b["id"] not in changed["extra"]}
    visible = {name: b for name, b in reported.items() if name in roofs}
    errors = [abs(b["higher_m"] + truth.get(name, 0.0)) for name, b in visible.items()]
    doubted = [name for name, b in reported.items() if b["doubt"]]
    reported_demolished = [c["id"] for c in findings["changes"] if c["kind"] == "demolished"]
    outlines = [c["outline"] for c in findings["changes"] if c["kind"] == "unmapped"]
    places = [unary_union([Polygon(ring) for ring in rings]) for rings in outlines]
    lacking = {name: box(*boxes[name]).buffer(_NEAR_M) for name in changed["missing"] if name in boxes}
    others = [place for place in places if not any(place.intersects(there) for there in lacking.values())]
    standing = unary_union([box(*each) for each in clutter])
    return MapScore(
        heights=len(errors),
        recovered=int(np.count_nonzero(np.array(errors) < RECOVERED_M)),
        wrong=sum(name in roofs for name in truth),
        doubted_wrong=sum(name in truth and name in roofs for name in doubted),
        doubted=len(doubted),
        rightly=sum(name in truth for name in doubted),
        demolished=sum(name in shown for name in changed["extra"]),
        reported_demolished=len(reported_demolished),
        rightly_demolished=sum(name in changed["extra"] for name in reported_demolished),
        unmapped=sum(name in shown for name in lacking),
        found=sum(
            name in shown and any(place.intersects(there) for place in places)
            for name, there in lacking.items()
        ),
        places=len(places),
        rightly_unmapped=len(places) - len(others),
        clutter=sum(bool(place.intersects(standing)) for place in others),
    )


@dataclass(slots=True, eq=False)
class _Tally:
    """What flights gave, flight after flight."""

    alone: list[PoseError] = field(default_factory=list)
    errors: list[PoseError] = field(default_factory=list)
    probabilities: list[float] = field(default_factory=list)
    constants: list[Floats] = field(default_factory=list)
    score: MapScore = field(default_factory=MapScore)
    cpu_s: float = 0.0


def measure_flights(
    flights: FlightsParams,
    seeds: Sequence[int],
    method: SupportsFlights,
    progress: Progress = no_progress,
    segmenter: Segmenter | None = None,
) -> Report:
    """Returns how well a method finds seeded flights, and what they say of drone and map.

    Args:
        flights: What is drawn.
        seeds: Of the flights.
        method: What finds them; of one that solves what each photo says by itself, that is measured too.
        progress: Is called with flights done, and all.
        segmenter: Makes masks from drawn photos; None for silhouettes that are degraded.

    Raises:
        LodbenchError: The city cannot be read, or no flight can be drawn over it.
    """
    tally, done, total = _Tally(), 0, len(seeds) * flights.num_flights
    for seed in seeds:
        params = replace(flights, flights_seed=seed)
        dataset = open_flights(params)
        if dataset.city_model is None:
            raise AssertionError("flights are drawn over a city")
        scene = open_city(dataset.city_model, dataset.lod, dataset.city_options, dataset.roof_height).scene
        for flight in range(params.num_flights):
            _fly(tally, params, dataset, scene, flight, method, segmenter)
            done += 1
            progress(done, total)
    return _report(tally, flights, seeds)


def _fly(
    tally: _Tally,
    params: FlightsParams,
    dataset: Dataset,
    scene: Scene,
    flight: int,
    method: SupportsFlights,
    segmenter: Segmenter | None,
) -> None:
    queries, truth = queries_of(dataset, scene, flight, segmenter)
    city_map = CityMap(scene)
    streams = [partial(random_stream, 0, query.name) for query in queries]
    started = process_time()
    alone: Sequence[Estimate | QueryFault] = []
    if isinstance(method, SupportsPhotosAlone):
        alone = method.localize_alone(queries, city_map, streams)
        solution = method.solve(queries, alone, city_map)
    else:
        solution = method.localize_flight(queries, city_map, streams)
    tally.cpu_s += process_time() - started
    tally.alone += [_error(each, pose) for each, pose in zip(alone, truth, strict=bool(alone))]
    tally.errors += [_error(each, pose) for each, pose in zip(solution.estimates, truth, strict=True)]
    tally.probabilities += [
        each.probability or 0.0 if isinstance(each, Estimate) else 0.0 for each in solution.estimates
    ]
    if "constants" in solution.findings:
        tally.constants.append(_constants_off(params, flight, solution))
        if _scores_map(params):
            tally.score += _score(params, dataset, solution, queries, truth, city_map)


def _error(answer: Estimate | QueryFault, truth: Pose) -> PoseError:
    return pose_error(answer.pose, truth) if isinstance(answer, Estimate) else FAILED


def _scores_map(params: FlightsParams) -> bool:
    """Returns whether findings are counted: of wrong maps, and of exact ones where photos show more."""
    return bool(params.map_errors()) or params.look is not None


def queries_of(
    dataset: Dataset, scene: Scene, flight: int, segmenter: Segmenter | None = None
) -> tuple[list[Query], list[Pose]]:
    """Returns the photos of a flight as a method sees them, and where they were taken, scene frame.

    Masks are the dataset's, or a segmenter's of the photos.
    """
    entries = [entry for entry in dataset.entries if entry.sequence == f"flight_{flight:02d}"]
    truth = [dataset.truth[entry.key].shifted(-scene.origin) for entry in entries]
    queries = [
        Query(
            entry.name,
            entry.split,
            entry.camera,  # type: ignore[arg-type]
            entry.prior.shifted(-scene.origin),  # type: ignore[union-attr]
            read_mask(entry.mask) if segmenter is None else segmenter.segment(entry),  # type: ignore[arg-type]
            entry.image,
            sequence=entry.sequence,
            reconstructed=entry.reconstructed,
        )
        for entry in entries
    ]
    return queries, truth


def _constants_off(params: FlightsParams, flight: int, solution: FlightEstimate) -> Floats:
    """Returns by how much pitch, roll (degrees), height (metres) and focal length (share) are off."""
    errors, stated = drone_errors(params, flight), solution.findings["constants"]
    # What is reported is to be added to what sensors say.
    wrong = {
        "pitch": -errors.sensors[3],
        "roll": -errors.sensors[4],
        "height": -errors.sensors[2],
        "focal length": errors.focal - 1.0,
    }
    return np.array(
        [stated[name]["value"] - value if name in stated else -value for name, value in wrong.items()]
    )


def _score(
    params: FlightsParams,
    dataset: Dataset,
    solution: FlightEstimate,
    queries: Sequence[Query],
    truth: Sequence[Pose],
    city_map: CityMap,
) -> MapScore:
    changed: dict[str, Any] = {"heights": {}, "missing": [], "extra": []}
    if params.map_errors():
        changed = json.loads((dataset.root / MAP_TRUTH_FILE).read_text(encoding="utf-8"))
    world = open_cached_city(
        Path(params.city_model),
        lod=params.mask_lod or params.lod,
        options=ReadOptions(crs=params.crs),
        roof_height=params.roof_height,
    ).scene
    shown = {
        name
        for there in (city_map, CityMap(world))
        for name, count in _photos_of(queries, truth, there).items()
        if count >= _FEWEST_PHOTOS
    }
    roofs = _roofs_shown(queries, truth, city_map)
    boxes, missing = building_boxes(world), {}
    for low, high, building in zip(boxes.low, boxes.high, boxes.building, strict=True):
        name = world.building_ids[building]
        if name in changed["missing"]:
            missing[name] = [*(low[:2] + world.origin[:2]), *(high[:2] + world.origin[:2])]
    return score_map(solution.findings, changed, shown, roofs, missing, _clutter(params, world))


def _clutter(params: FlightsParams, world: Scene) -> list[list[float]]:
    """Returns west, south, east and north of what stands beside buildings, the city's coordinates."""
    if params.look is None:
        return []
    props, land = make_surroundings(world, params.flights_seed)
    return standing_clutter(props, land)


def _photos_of(queries: Sequence[Query], truth: Sequence[Pose], city_map: CityMap) -> dict[str, int]:
    counts: dict[str, int] = {}
    for view in views_of(queries, truth, 0.0):
        for building, _, _ in shares_held(view, city_map):
            name = city_map.scene.building_ids[building]
            counts[name] = counts.get(name, 0) + 1
    return counts


def _roofs_shown(queries: Sequence[Query], truth: Sequence[Pose], city_map: CityMap) -> set[str]:
    """Returns the ids of buildings whose heights photos can tell: a roof among others draws no outline."""
    scene, counts = city_map.scene, np.zeros(city_map.scene.num_buildings, np.int64)
    raised, _ = corrected_map(city_map, np.full(scene.num_buildings, _ROOF_M))
    for view in views_of(queries, truth, 0.0):
        shown = city_map.render(view.camera, view.pose)
        (instances,) = raised.instances(view.camera, view.pose.rotation[None], view.pose.center[None])
        for k, row in enumerate(instances.buildings):
            shape, top, left = instances.crop(k)
            there = shown[top : top + shape.shape[0], left : left + shape.shape[1]]
            counts[row] += np.count_nonzero(shape & ~there) >= _ROOF_PX
    return {scene.building_ids[row] for row in np.flatnonzero(counts >= _FEWEST_OF_ROOF)}


def _report(tally: _Tally, flights: FlightsParams, seeds: Sequence[int]) -> Report:
    errors, alone = (
        np.array([(error.translation_m, error.rotation_deg) for error in of_photos])
        for of_photos in (tally.errors, tally.alone)
    )
    by_itself = []
    if tally.alone:
        recall = 100.0 * float(hits_of(alone, PROBABILITY_THRESHOLD).mean())
        by_itself = [
            Figure("photo by photo: recall", recall, "%"),
            Figure("photo by photo: median translation", float(np.median(alone[:, 0])), "m"),
        ]
    hits = hits_of(errors, PROBABILITY_THRESHOLD)
    calibration = calibrate(np.array(tally.probabilities), hits)
    figures = [
        Figure("recall 2m-2deg", 100.0 * float(hits.mean()), "%"),
        Figure("median translation", float(np.median(errors[:, 0])), "m"),
        Figure("median rotation", float(np.median(errors[:, 1])), "deg"),
        *by_itself,
        Figure("mean probability of being within", 100.0 * float(np.mean(tally.probabilities)), "%"),
        Figure("expected calibration error", 100.0 * calibration.ece, "%"),
        *_constant_figures(tally),
        *(_map_figures(tally.score) if _scores_map(flights) else ()),
        Figure("CPU time per photo", tally.cpu_s / len(errors), "s"),
    ]
    title = f"{Path(flights.city_model).name}, {len(errors)} photos, seeds {','.join(map(str, seeds))}"
    return plain_report(title, figures, *_reliability(calibration))


def _constant_figures(tally: _Tally) -> list[Figure]:
    if not tally.constants:
        return []
    off = np.abs(np.array(tally.constants))
    return [
        Figure("gimbal pitch, median error", float(np.median(off[:, 0])), "deg"),
        Figure("gimbal roll, median error", float(np.median(off[:, 1])), "deg"),
        Figure("gimbal within 0.1 deg", 100.0 * float((off[:, :2] < _GIMBAL_DEG).mean()), "%"),
        Figure("shared height, median error", float(np.median(off[:, 2])), "m"),
        Figure("focal length, median error", 100.0 * float(np.median(off[:, 3])), "%"),
    ]


def _map_figures(score: MapScore) -> list[Figure]:
    nothing = score.places - score.rightly_unmapped - score.clutter
    rows = (
        (f"heights within 0.5 m, of {score.heights} shown twice", score.recovered, score.heights),
        (f"wrong heights found, of {score.wrong}", score.doubted_wrong, score.wrong),
        (f"buildings in doubt rightly, of {score.doubted}", score.rightly, score.doubted),
        (f"demolished buildings found, of {score.demolished}", score.rightly_demolished, score.demolished),
        (
            f"reported as demolished rightly, of {score.reported_demolished}",
            score.rightly_demolished,
            score.reported_demolished,
        ),
        (f"unmapped buildings found, of {score.unmapped}", score.found, score.unmapped),
        (f"places not in the map: buildings, of {score.places}", score.rightly_unmapped, score.places),
        (f"places not in the map: containers, tents, heaps, of {score.places}", score.clutter, score.places),
        (f"places not in the map: nothing there, of {score.places}", nothing, score.places),
    )
    return [Figure(name, 100.0 * part / whole if whole else float("nan"), "%") for name, part, whole in rows]


def _reliability(calibration: Calibration) -> list[str]:
    lines = [
        f"probability {each.low:.1f} to {each.high:.1f}: {each.count} photos, "
        f"mean {100 * each.confidence:.0f} %, found {100 * each.hit_share:.0f} %"
        for each in calibration.bins
    ]
    return ["", *lines]
