"""What a flight says of drone and map, as JSON values: constants with sigmas, buildings in doubt."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.query import Query
from lodbench.methods.contour_alignment.pose_vector import pose_from_vector
from lodbench.methods.flight.gone_buildings import gone_buildings
from lodbench.methods.flight.joint import (
    CONSTANTS,
    FOCAL,
    ROOFS,
    Solution,
    State,
    covariance_of,
    shared_covariance,
)
from lodbench.methods.flight.map_views import views_of
from lodbench.methods.flight.missing_buildings import missing_buildings
from lodbench.methods.flight.params import Params
from lodbench.methods.flight.photo_terms import PhotoTerms

Floats = NDArray[np.float64]

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
    ("masks too large by", "px"),
    ("roofs higher than the map", "m"),
    ("feet of walls higher than the map", "m"),
)
# Where photos narrow a number by less than this, they do not tell it.
_TOLD = 0.7
# A focal length that is not told, and whose error goes with the height's by more than this, is left alone.
_HEIGHT, _ALIKE = 2, 0.5
# A building's height is in doubt where it differs from the others' by so many metres and sigmas; of one that
# would be lower than this, metres, masks show nothing: whether it is gone is looked at elsewhere.
_DOUBT_M, _DOUBT_SIGMAS, _LOWEST_M = 1.0, 1.7, 2.0


def findings_of(
    state: State,
    solution: Solution,
    terms: Sequence[PhotoTerms | None],
    queries: Sequence[Query],
    city_map: CityMap,
    params: Params,
    of_ends: Floats,
) -> dict[str, Any]:
    """Returns what a flight says, beside the poses; ``of_ends`` is what constants err by besides, (11, 11).

    ``constants``: by name the ``value`` to be added to what the sensors or the map say, ``sigma``, ``unit``
    and whether the photos ``told`` it; ``buildings``: id, metres ``higher_m`` against the map and all other
    buildings, ``sigma_m``, number of ``photos`` and whether it is in ``doubt``; ``lost``: photos placed by
    the others alone, and ``reasons`` why, by name; ``changes``: buildings that stand in the map only
    (``gone_buildings``) and places where the map lacks one (``missing_buildings``).
    """
    spread = np.sqrt(np.diag(shared_covariance(solution, np.arange(CONSTANTS)) + of_ends))
    beforehand = params.constant_sigmas()
    constants = {
        name: {
            "value": float(state.constants[k]),
            "sigma": float(spread[k]),
            "unit": unit,
            "told": bool(spread[k] < _TOLD * beforehand[k]),
        }
        for k, (name, unit) in enumerate(_NAMES)
        if beforehand[k] > 1e-3 * (1.0 if unit == "m" else 0.1)
    }
    photos: Counter[int] = Counter()
    for term in terms:
        if term is not None:
            shown = state.roofs.building[term.parts]
            photos.update(int(b) for b in np.unique(shown[shown >= 0]))
    rises_m = _rises(city_map)
    buildings = [
        {
            "id": city_map.scene.building_ids[building],
            "higher_m": higher,
            "sigma_m": sigma,
            "photos": photos[int(building)],
            "doubt": _is_in_doubt(higher, sigma, float(rises_m[building])),
        }
        for building, higher, sigma in _heights(state, solution)
    ]
    lost = [query.name for query, weight in zip(queries, state.weights, strict=True) if weight == 0.0]
    kept = [int(k) for k in np.flatnonzero(state.weights > 0)]
    poses = [pose_from_vector(state.vectors[k]) for k in kept]
    views = views_of([queries[k] for k in kept], poses, float(state.lens[0]))
    changes = [*gone_buildings(views, city_map), *missing_buildings(views, city_map)]
    gone = {change["id"] for change in changes if change["kind"] == "gone"}
    # What is gone has no height.
    buildings = [building for building in buildings if building["id"] not in gone]
    reasons = {queries[k].name: reason for k, reason in state.reasons.items()}
    return {
        "constants": constants,
        "buildings": buildings,
        "changes": changes,
        "lost": lost,
        "reasons": reasons,
    }


def cannot_tell_focal(solution: Solution, params: Params) -> bool:
    """Returns whether photos leave a longer lens and a higher flight alike: all look straight down."""
    if params.focal == 0.0:
        return False
    spread = shared_covariance(solution, np.array([_HEIGHT, FOCAL]))
    height, focal = np.sqrt(np.diag(spread))
    is_told = focal < _TOLD * params.constant_sigmas()[FOCAL]
    return bool(not is_told and abs(spread[0, 1]) > _ALIKE * height * focal)


def _is_in_doubt(higher_m: float, sigma_m: float, rise_m: float) -> bool:
    return abs(higher_m) > max(_DOUBT_M, _DOUBT_SIGMAS * sigma_m) and rise_m + higher_m > _LOWEST_M


def _rises(city_map: CityMap) -> Floats:
    """Returns (B,) how high the map's buildings are, metres; 0 for one without geometry."""
    scene = city_map.scene
    filled = np.flatnonzero(np.diff(scene.vertex_starts) > 0)
    starts, heights = scene.vertex_starts[filled], scene.vertices[:, 2].astype(np.float64)
    rises = np.zeros(scene.num_buildings)
    rises[filled] = np.maximum.reduceat(heights, starts) - np.minimum.reduceat(heights, starts)
    return rises


def _heights(state: State, solution: Solution) -> Iterator[tuple[int, float, float]]:
    """Yields each building's row, and how much higher its parts are than all roofs, with sigma; metres."""
    first = CONSTANTS + len(solution.buildings)
    sums = np.zeros((len(solution.buildings), first + len(state.roofs)))
    sums[:, ROOFS] = -1.0
    for row, building in enumerate(solution.buildings):
        parts = np.flatnonzero(state.roofs.building == building)
        sums[row, first + parts] = 1.0 / len(parts)
    values = np.concatenate([state.constants, state.buildings_m[solution.buildings], state.roofs.heights_m])
    sigmas = np.sqrt(np.diag(covariance_of(solution, sums)))
    for building, higher, sigma in zip(solution.buildings, sums @ values, sigmas, strict=True):
        yield int(building), float(higher), float(sigma)
