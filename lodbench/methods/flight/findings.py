"""What a flight says of drone and map, as JSON values: constants with sigmas, buildings in doubt."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymodel.scene import Scene
from lodbench.datasets.query import Query
from lodbench.geometry.pose import pose_from_vector
from lodbench.methods.flight.aligning import Aligned
from lodbench.methods.flight.building_heights import BuildingHeight, building_heights
from lodbench.methods.flight.gone_buildings import gone_buildings, views_of
from lodbench.methods.flight.joint import shared_covariance
from lodbench.methods.flight.missing_buildings import missing_buildings
from lodbench.methods.flight.params import FlightParams
from lodbench.methods.flight.roof_edges import open_pictures
from lodbench.methods.flight.roof_sweep import sweep_roofs
from lodbench.methods.flight.state import CONSTANTS, FOCAL, Solution, State
from lodbench.methods.flight.witnesses import APART_DEG, apart_deg, roof_middles

Floats = NDArray[np.float64]

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
_TOLD = 0.7
# A focal length that is not told, and whose error goes with the height's by more than this, is left alone.
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
    and whether the photos ``told`` it; ``buildings``: id, metres ``higher_m`` against the map and all other
    buildings, ``sigma_m``, number of ``photos``, ``apart_deg`` between the directions they look from, and
    whether it is in ``doubt``; ``lost``: photos placed by the others alone, and ``reasons`` why, by name;
    ``changes``: buildings that stand in the map only (``gone_buildings``) and places where the map lacks one
    (``missing_buildings``), with ``photos`` and ``apart_deg``. Nothing in the map is contradicted by photos
    that look from one side only, nor by less than masks and pixels of this flight are wrong about.
    """
    state = aligned.state
    kept = [int(k) for k in np.flatnonzero(state.weights > 0)]
    kept_queries, poses = [queries[k] for k in kept], [pose_from_vector(state.vectors[k]) for k in kept]
    views = views_of(kept_queries, poses, float(state.lens[0]))
    pictures = open_pictures(kept_queries, poses, state.lens[:2])
    curves = sweep_roofs(pictures, city_map)
    changes = [*gone_buildings(views, city_map), *missing_buildings(views, city_map, pictures)]
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


def lost_of(state: State, queries: Sequence[Query]) -> dict[str, Any]:
    """Returns the photos that others alone place, and ``reasons`` why, by name."""
    return {
        "lost": [query.name for query, weight in zip(queries, state.weights, strict=True) if weight == 0.0],
        "reasons": {queries[k].name: reason for k, reason in state.reasons.items()},
    }


def constants_of(aligned: Aligned, params: FlightParams, of_ends: Floats) -> dict[str, dict[str, Any]]:
    """Returns what photos share, by name: value, sigma, unit, whether photos told it; none that is held."""
    state = aligned.state
    spread = np.sqrt(np.diag(shared_covariance(aligned.solution, np.arange(CONSTANTS)) + of_ends))
    beforehand = params.constant_sigmas(state.scales)
    return {
        name: {
            "value": float(state.constants[k]),
            "sigma": float(spread[k]),
            "unit": unit,
            "told": bool(spread[k] < _TOLD * beforehand[k]),
        }
        for k, (name, unit) in enumerate(_NAMES)
        if beforehand[k] > 1e-3 * (1.0 if unit == "m" else 0.1)
    }


def _buildings(
    heights: Mapping[int, BuildingHeight], aligned: Aligned, scene: Scene, centers: Floats
) -> list[dict[str, Any]]:
    """Returns the heights of buildings with their ids, and which photos' outlines or pixels told them."""
    photos: dict[int, list[int]] = defaultdict(list)
    for k, term in enumerate(aligned.terms):
        if term is not None:
            shown = aligned.state.roofs.building[term.parts]
            for row in np.unique(shown[shown >= 0]).tolist():
                photos[row].append(k)
    places, cameras = roof_middles(scene), aligned.state.vectors[:, :3]
    far = _sigmas_of_doubt(heights.values())
    found = []
    for row, height in heights.items():
        # Pixels were compared in photos that may show no outline of it: any of the flight.
        witnesses = cameras[photos[row]] if height.photos <= len(photos[row]) else centers
        apart = apart_deg(places[row], witnesses)
        is_far = abs(height.higher_m) > far * height.sigma_m
        found.append(
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
    return found


def _sigmas_of_doubt(heights: Iterable[BuildingHeight]) -> float:
    """Returns how many of its own deviations off a height is in doubt, given how far others of a flight are.

    Where masks err by more than is known of them, most heights show it.
    """
    off = [abs(height.higher_m) / height.sigma_m for height in heights]
    usual = _PER_MEDIAN * float(np.median(off)) if off else 0.0
    return _DOUBT_SIGMAS * max(1.0, usual)


def cannot_tell_focal(solution: Solution, params: FlightParams) -> bool:
    """Returns whether photos leave a longer lens and a higher flight alike: all look straight down."""
    if params.focal == 0.0:
        return False
    spread = shared_covariance(solution, np.array([_HEIGHT, FOCAL]))
    height, focal = np.sqrt(np.diag(spread))
    is_told = focal < _TOLD * params.constant_sigmas()[FOCAL]
    return bool(not is_told and abs(spread[0, 1]) > _ALIKE * height * focal)
