"""What a flight says of drone and map, as JSON values: constants with sigmas, buildings in doubt."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymodel.scene import Scene, floors_and_rises
from lodbench.datasets.query import Query
from lodbench.geometry.pose import pose_from_vector
from lodbench.methods.flight import joint
from lodbench.methods.flight.aligning import Aligned
from lodbench.methods.flight.demolished_buildings import (
    APART_DEG,
    apart_deg,
    demolished_buildings,
    roof_middles,
    views_of,
)
from lodbench.methods.flight.params import FlightParams
from lodbench.methods.flight.roof_edges import open_pictures
from lodbench.methods.flight.roof_sweep import HEIGHTS_M, RoofCurve, density_of, peak_of, sweep_roofs
from lodbench.methods.flight.unmapped_buildings import unmapped_buildings

Floats = NDArray[np.float64]

# Heights that a building may be off by, metres.
_HEIGHTS_M: Floats = np.arange(-60.0, 60.01, 0.25)
# The map's errors are of a Cauchy density, half as wide as this share of what is declared of them: most
# heights are right to a little, some wrong by much.
_USUAL = 0.175
# Outlines err by this share of what they say themselves; they are wrong altogether (a tree, a neighbour) this
# often where pixels speak too, more rarely of buildings that stand free, and then by so many metres.
_OUTLINES, _ASTRAY, _ASTRAY_ALONE, _ASTRAY_M = 0.7, 0.05, 0.01, 4.0
# A height is in doubt that is off by more than so many metres, with more than this probability, and known to
# better than that many.
_DOUBT_M, _DOUBT, _OPEN_M = 1.0, 0.4, 2.5
# Less information than this, m^-2, is none.
_LEAST_INFORMATION = 1e-3
# Of a building that would be lower than this, metres, masks show nothing: whether it is gone is looked at
# elsewhere. However low a building is, its roof is looked for so far below the map's.
_LOWEST_M, _LOWER_M = 2.0, 1.0
# Heights are known no worse than this by pixels alone, metres.
_WORST_M = 1.0
# Roofs are sharp whose best height is so many nats better than most heights; what all are wrong about alike
# is the median of no fewer.
_SHARP, _FEWEST_SHARP = 1.2, 5


class BuildingHeight(NamedTuple):
    """By how much a building is higher than the map has it, all others' mean error taken away."""

    higher_m: float  # metres
    sigma_m: float  # its standard deviation
    photos: int  # photos whose pixels count, 0 for outlines alone
    is_in_doubt: bool  # whether the map's height is contradicted


class _Outlines(NamedTuple):
    """How much higher a building is by outlines, standard deviations after and before they were looked at."""

    higher_m: float
    sigma_m: float
    beforehand_m: float


def building_heights(
    aligned: Aligned, curves: Mapping[int, RoofCurve], scene: Scene, params: FlightParams
) -> dict[int, BuildingHeight]:
    """Returns the heights of buildings whose outlines or pixels determine them, by row of the scene.

    Eq. (F20) of docs/methods/flight.md; curves are those of ``sweep_roofs``.
    """
    by_outlines = dict(_by_outlines(aligned, params))
    (_, rises), common = floors_and_rises(scene), _common(curves)
    by_pixels = {} if common is None else curves
    heights = {}
    for row in sorted({*by_outlines, *by_pixels}):
        nats = _beforehand(params.roof_m, float(rises[row]))
        outlines, curve = by_outlines.get(row), by_pixels.get(row)
        if outlines is not None and abs(outlines.higher_m) > HEIGHTS_M[-1]:
            # Pixels have not looked there.
            alone = _log_normal(outlines.higher_m, outlines.sigma_m)
            nats, curve = np.where(np.isfinite(nats), alone, -np.inf), None
        elif outlines is not None:
            nats = nats + _nats_of_outlines(outlines, _ASTRAY_ALONE if curve is None else _ASTRAY)
        if curve is not None:
            # Heights that pixels were not compared at are as good as most of them.
            usual, heights_m = float(np.median(curve.nats)), HEIGHTS_M - (common or 0.0)
            nats = nats + np.interp(_HEIGHTS_M, heights_m, curve.nats, left=usual, right=usual)
        height = _height(nats, 0 if curve is None else curve.photos, float(rises[row]))
        if outlines is not None or height.sigma_m < _WORST_M:
            heights[row] = height
    return heights


def _beforehand(roof_m: float, rise_m: float) -> Floats:
    """Returns how likely errors of a building's height are before photos are looked at, nats."""
    likely = -np.log1p((_HEIGHTS_M / max(_USUAL * roof_m, 1e-3)) ** 2)
    return np.where(_HEIGHTS_M >= min(_LOWEST_M - rise_m, -_LOWER_M), likely, -np.inf)


def _nats_of_outlines(outlines: _Outlines, astray: float) -> Floats:
    """Returns how well heights explain what outlines tell beyond what the joint problem knew beforehand."""
    precision = outlines.sigma_m**-2.0
    information = max(precision - outlines.beforehand_m**-2.0, _LEAST_INFORMATION)
    higher_m = outlines.higher_m * precision / information
    nearest_m = float(np.clip(higher_m, *_HEIGHTS_M[[0, -1]]))
    right = np.log1p(-astray) + _log_normal(nearest_m, _OUTLINES / math.sqrt(information))
    return np.asarray(np.logaddexp(right, math.log(astray) + _log_normal(0.0, _ASTRAY_M)))


def _log_normal(mean_m: float, sigma_m: float) -> Floats:
    """Returns the logarithm of a normal density at all heights."""
    return np.asarray(
        -0.5 * ((_HEIGHTS_M - mean_m) / sigma_m) ** 2 - math.log(sigma_m * math.sqrt(2.0 * math.pi))
    )


def _height(nats: Floats, photos: int, rise_m: float) -> BuildingHeight:
    """Returns the best height, given how well heights explain everything, nats."""
    shares = density_of(nats)
    best, sigma = peak_of(shares, _HEIGHTS_M)
    is_off = abs(best) > _DOUBT_M and float(shares[np.abs(_HEIGHTS_M) > _DOUBT_M].sum()) > _DOUBT
    return BuildingHeight(best, sigma, photos, is_off and sigma < _OPEN_M and rise_m + best > _LOWEST_M)


def _common(curves: Mapping[int, RoofCurve]) -> float | None:
    """Returns by how much all roofs are higher than the map as poses have it, metres; None if few tell."""
    nats = [curve.nats for curve in curves.values()]
    sharp = [HEIGHTS_M[np.argmax(each)] for each in nats if each.max() - np.median(each) > _SHARP]
    return float(np.median(sharp)) if len(sharp) >= _FEWEST_SHARP else None


def _by_outlines(aligned: Aligned, params: FlightParams) -> Iterator[tuple[int, _Outlines]]:
    """Yields each building's row, and how much higher its parts are than all roofs."""
    state, solution = aligned.state, aligned.as_declared
    first = joint.CONSTANTS + len(solution.buildings)
    sums = np.zeros((len(solution.buildings), first + len(state.roofs)))
    sums[:, joint.ROOFS] = -1.0
    of_building = {int(b): np.flatnonzero(state.roofs.building == b) for b in solution.buildings}
    for row, parts in enumerate(of_building.values()):
        sums[row, first + parts] = 1.0 / len(parts)
    values = np.concatenate([state.constants, state.buildings_m[solution.buildings], state.roofs.heights_m])
    values += (solution.shared_step - aligned.solution.shared_step)[: len(values)]
    sigmas = np.sqrt(np.diag(joint.covariance_of(solution, sums)))
    for (row, parts), higher, sigma in zip(of_building.items(), sums @ values, sigmas, strict=True):
        building = state.buildings_m[row]
        own = 1.0 / joint.precisions_of(building - state.constants[joint.ROOFS], params.roof_m)
        of_parts = 1.0 / joint.precisions_of(state.roofs.heights_m[parts] - building, params.part_m)
        beforehand = np.sqrt(own + of_parts.sum() / len(parts) ** 2)
        yield row, _Outlines(float(higher), float(sigma), float(beforehand))


# What masks alone say.
MASKS = "masks too large by"
# Of the shared numbers before the buildings': name and unit.
_NAMES = (
    ("east", "m"),
    ("north", "m"),
    ("height", "m"),
    ("pitch", "deg"),
    ("roll", "deg"),
    ("yaw", "deg"),
    ("focal length", "share"),
    ("radial distortion k1", ""),
    ("principal point to the right", "share"),
    ("principal point down", "share"),
    (MASKS, "px"),
    ("roofs higher than the map", "m"),
    ("feet of walls higher than the map", "m"),
)
# A height is in doubt that is off by more than so many of its deviations, as none of hundreds is by chance,
# and of those that all others of the flight show; the deviation per median of absolute values.
_DOUBT_SIGMAS, _PER_MEDIAN = 3.0, 1.4826
# Where photos narrow a number by less than this, they do not tell it.
_DETERMINED = 0.7
# A focal length that photos leave open, and whose error goes with the height's by more than this, is not
# estimated.
_HEIGHT, _ALIKE = 2, 0.5


def findings_of(
    aligned: Aligned,
    queries: Sequence[Query],
    city_map: CityMap,
    params: FlightParams,
    of_ends: Floats,
) -> dict[str, Any]:
    """Returns what a flight says, beside the poses; ``of_ends`` is what constants err by besides, (13, 13).

    ``constants``: by name the ``value`` to be added to what the sensors or the map say, ``sigma``, ``unit``
    and whether it is ``determined``; ``buildings``: id, metres ``higher_m`` against the map and all other
    buildings, ``sigma_m``, number of ``photos``, ``apart_deg`` between the directions they look from, and
    whether it is in ``doubt``; ``lost``: photos placed by the others alone, and ``reasons`` why, by name;
    ``changes``: buildings that stand in the map only (``demolished_buildings``) and places where the map
    lacks one (``unmapped_buildings``), with ``photos`` and ``apart_deg``. Nothing in the map is contradicted
    by photos that look from one side only, nor by less than masks and pixels of this flight are wrong about.
    """
    state = aligned.state
    kept = [int(k) for k in np.flatnonzero(state.weights > 0)]
    kept_queries, poses = [queries[k] for k in kept], [pose_from_vector(state.vectors[k]) for k in kept]
    views = views_of(kept_queries, poses, float(state.lens[0]))
    pictures = open_pictures(kept_queries, poses, state.lens[:2])
    curves = sweep_roofs(pictures, city_map)
    changes = [*demolished_buildings(views, city_map), *unmapped_buildings(views, city_map, pictures)]
    gone = {change["id"] for change in changes if change["kind"] == "demolished"}
    heights = building_heights(aligned, curves, city_map.scene, params)
    centers = np.array([pose.center for pose in poses]).reshape(-1, 3)
    buildings = _buildings(heights, aligned, city_map.scene, centers)
    return {
        "constants": constants_of(aligned, params, of_ends),
        # What is gone has no height.
        "buildings": [building for building in buildings if building["id"] not in gone],
        "changes": changes,
        **lost_of(state, queries),
    }


def lost_of(state: joint.State, queries: Sequence[Query]) -> dict[str, Any]:
    """Returns the photos that others alone place, and ``reasons`` why, by name."""
    return {
        "lost": [query.name for query, weight in zip(queries, state.weights, strict=True) if weight == 0.0],
        "reasons": {queries[k].name: reason for k, reason in state.reasons.items()},
    }


def constants_of(aligned: Aligned, params: FlightParams, of_ends: Floats) -> dict[str, dict[str, Any]]:
    """Returns what photos share but for what is held: value, sigma, unit, whether photos determine it."""
    state = aligned.state
    spread = np.sqrt(np.diag(joint.shared_covariance(aligned.solution, np.arange(joint.CONSTANTS)) + of_ends))
    beforehand = params.constant_sigmas(state.scales)
    return {
        name: {
            "value": float(state.constants[k]),
            "sigma": float(spread[k]),
            "unit": unit,
            "determined": bool(spread[k] < _DETERMINED * beforehand[k]),
        }
        for k, (name, unit) in enumerate(_NAMES)
        if beforehand[k] > 1e-3 * (1.0 if unit == "m" else 0.1)
    }


def _buildings(
    heights: Mapping[int, BuildingHeight], aligned: Aligned, scene: Scene, centers: Floats
) -> list[dict[str, Any]]:
    """Returns the heights of buildings with their ids, and which photos' outlines or pixels say so."""
    photos: dict[int, list[int]] = defaultdict(list)
    for k, term in enumerate(aligned.terms):
        if term is not None:
            shown = aligned.state.roofs.building[term.parts]
            for row in np.unique(shown[shown >= 0]).tolist():
                photos[row].append(k)
    places, cameras = roof_middles(scene), aligned.state.vectors[:, :3]
    far = _sigmas_of_doubt(heights.values())
    buildings = []
    for row, height in heights.items():
        # Pixels were compared in photos that may show no outline of it: any of the flight.
        witnesses = cameras[photos[row]] if height.photos <= len(photos[row]) else centers
        apart = apart_deg(places[row], witnesses)
        is_far = abs(height.higher_m) > far * height.sigma_m
        buildings.append(
            {
                "id": scene.building_ids[row],
                "higher_m": height.higher_m,
                "sigma_m": height.sigma_m,
                "photos": max(len(photos[row]), height.photos),
                "apart_deg": apart,
                # From one side it may be something else: a tree, a crane, a mask's own error.
                "doubt": height.is_in_doubt and apart >= APART_DEG and is_far,
            }
        )
    return buildings


def _sigmas_of_doubt(heights: Iterable[BuildingHeight]) -> float:
    """Returns from how many of its deviations on a height is in doubt: more where most heights are off."""
    off = [abs(height.higher_m) / height.sigma_m for height in heights]
    usual = _PER_MEDIAN * float(np.median(off)) if off else 0.0
    return _DOUBT_SIGMAS * max(1.0, usual)


def cannot_tell_focal(solution: joint.Solution, params: FlightParams) -> bool:
    """Returns whether photos leave a longer lens and a higher flight alike: all look straight down."""
    if params.focal == 0.0:
        return False
    spread = joint.shared_covariance(solution, np.array([_HEIGHT, joint.FOCAL]))
    height, focal = np.sqrt(np.diag(spread))
    is_determined = focal < _DETERMINED * params.constant_sigmas()[joint.FOCAL]
    return bool(not is_determined and abs(spread[0, 1]) > _ALIKE * height * focal)
