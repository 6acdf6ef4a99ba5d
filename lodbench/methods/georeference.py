"""``method=georeference``: a flight's reconstruction, laid on the map by poses that another method finds.

It is what ``lodbench georeference`` does with a COLMAP model: docs/methods/flight.md, "Georeferencing".
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.inputs import Input, declared_inputs
from lodbench.datasets.query import Query, Reference
from lodbench.errors import ConfigError, QueryFault
from lodbench.estimation.state_vector import probability_within
from lodbench.geometry import Pose
from lodbench.geometry.pose import cross_matrix, turn_per_angle, vector_from_pose
from lodbench.geometry.similarity import FEWEST_POSES, FittedSimilarity, fit_similarity
from lodbench.methods.assessment import assessed
from lodbench.methods.localize import weight_files
from lodbench.methods.protocol import (
    Estimate,
    FlightEstimate,
    Streams,
    SupportsFlights,
    SupportsPrepare,
    Workspace,
)
from lodbench.methods.registry import configure_method

Floats = NDArray[np.float64]

# What rough places and directions are off by, each photo by itself, metres and degrees.
ROUGH_M, ROUGH_DEG = np.array([3.0, 3.0, 5.0]), 5.0
# Under which a flight's findings hold how its reconstruction lies, and the names of its standard deviations.
PLACEMENT = "placement"
SIGMAS = ("east_m", "north_m", "up_m", "about_east_deg", "about_north_deg", "about_up_deg", "scale")
_NOWHERE = "it fits nowhere near the others"


@dataclass(frozen=True, slots=True)
class GeoreferenceParams:
    """Which method finds the poses that the reconstruction is laid on, and its settings.

    Attributes:
        name: Name to report.
        inner: A method that solves flights.
        settings: Of that method, those that are not its defaults.
    """

    name: str = "georeference"
    inner: str = "flight"
    settings: dict[str, Any] = field(default_factory=dict)


class Georeference:
    """Answers the photos of a flight's reconstruction with a similarity applied to their poses in it.

    The similarity lays these poses on those that the inner method finds. So a photo that shows no building,
    that has no mask or that the inner method lost has an answer too.
    """

    name = "georeference"
    params_type = GeoreferenceParams
    requires: frozenset[Input] = frozenset({Input.MASK, Input.RECONSTRUCTION})

    def __init__(self, params: GeoreferenceParams | None = None) -> None:
        self.params = params or GeoreferenceParams()
        name = self.params.inner
        if "name" in self.params.settings:
            raise ConfigError("`method.settings.name` is not a setting.", "Set `method.inner=NAME`.")
        inner = configure_method({**self.params.settings, "name": name}, "method.settings").make()
        if not isinstance(inner, SupportsFlights) or isinstance(inner, Georeference):
            raise ConfigError(
                f"`method.inner={name}` finds no poses of a flight's photos.", "Leave `method.inner` out."
            )
        self.inner = inner
        self._needs_mask = Input.MASK in declared_inputs(inner, "requires", {Input.MASK})
        self.requires = declared_inputs(inner, "requires", {Input.MASK}) | {Input.RECONSTRUCTION}

    def weight_files(self) -> Sequence[Path]:
        """Returns the files of the inner method."""
        return weight_files(self.inner)

    def prepare(self, city_map: CityMap, references: Sequence[Reference], workspace: Workspace) -> None:
        """Lets the inner method prepare, if it does."""
        if isinstance(self.inner, SupportsPrepare):
            self.inner.prepare(city_map, references, workspace)

    def localize(self, query: Query, city_map: CityMap, streams: Streams) -> Estimate:
        """Raises QueryFault: a flight of one photo has no scale."""
        (found,) = self.localize_flight([query], city_map, [streams]).estimates
        if isinstance(found, QueryFault):
            raise found
        return found

    def localize_flight(
        self, queries: Sequence[Query], city_map: CityMap, streams: Sequence[Streams]
    ) -> FlightEstimate:
        """Returns the poses of a flight's photos, in their order, and the inner method's findings.

        ``PLACEMENT`` of these holds the similarity from the reconstruction to the city's coordinates, its
        standard deviations (``SIGMAS``) and the point that they refer to (``middle``); of each photo that it
        rests on (``used``) the probability and the score of the inner method's pose, and how many metres that
        is from the similarity's; name and reason of all others (``left_out``).

        Raises:
            LodbenchError: All cameras are in one place.
        """
        usable, left_out = self._usable(queries)
        answers, findings = self._answers(usable, left_out, city_map, streams)
        used = {row: answer for row, answer in answers.items() if row not in left_out}
        placement: dict[str, Any] = {
            "used": {
                queries[row].name: {
                    "probability": answer.probability,
                    "score": float(answer.score) if math.isfinite(answer.score) else None,
                }
                for row, answer in used.items()
            },
            "left_out": [[queries[row].name, reason] for row, reason in left_out.items()],
        }
        findings = {**findings, PLACEMENT: placement}
        if len(used) < FEWEST_POSES:
            # Of fewer the inner method knows nothing.
            count = len(used) if len(usable) >= FEWEST_POSES else len(usable)
            return FlightEstimate([_too_few(count, left_out, queries)] * len(queries), findings)
        own = [_own_pose(queries[row]) for row in used]
        fitted = _fitted(own, list(used.values()), city_map.scene.origin)
        placement |= _values_of(fitted)
        for each, distance_m in zip(placement["used"].values(), fitted.distances_m, strict=True):
            each["distance_m"] = float(distance_m)
        estimates = [
            _estimate(query, fitted, answers.get(row), left_out.get(row, ""), city_map)
            for row, query in enumerate(queries)
        ]
        return FlightEstimate(estimates, findings)

    def _usable(self, queries: Sequence[Query]) -> tuple[dict[int, Query], dict[int, str]]:
        """Returns the queries that the inner method can answer, by row, and why it cannot answer others."""
        usable, left_out = dict[int, Query](), dict[int, str]()
        for row, query in enumerate(queries):
            try:
                _own_pose(query)
                if self._needs_mask and query.building_probability is None:
                    mask = query.mask if query.segment is None else query.segment(query.prior)
                    query = replace(query, building_probability=mask)
                usable[row] = query
            except QueryFault as fault:
                left_out[row] = fault.message.rstrip(".")
        return usable, left_out

    def _answers(
        self,
        usable: Mapping[int, Query],
        left_out: dict[int, str],
        city_map: CityMap,
        streams: Sequence[Streams],
    ) -> tuple[dict[int, Estimate], dict[str, Any]]:
        """Returns answers of the inner method, by row, and findings; extends ``left_out``."""
        if len(usable) < FEWEST_POSES:
            return {}, {}
        found = self.inner.localize_flight([*usable.values()], city_map, [streams[row] for row in usable])
        answers, params = dict[int, Estimate](), getattr(self.inner, "params", None)
        for (row, query), answer in zip(usable.items(), found.estimates, strict=True):
            if isinstance(answer, QueryFault):
                left_out[row] = answer.message
            else:
                answers[row] = assessed(answer, query, city_map, params, is_camera_solved=True)
        rows = {query.name: row for row, query in usable.items()}
        for name in found.findings.get("lost", []):
            left_out.setdefault(rows[name], found.findings.get("reasons", {}).get(name, _NOWHERE))
        return answers, found.findings


def _own_pose(query: Query) -> Pose:
    if query.reconstructed is None:
        raise QueryFault("no reconstruction has a pose of it")
    return query.reconstructed


def _too_few(count: int, left_out: Mapping[int, str], queries: Sequence[Query]) -> QueryFault:
    reasons = "; ".join(f"{queries[row].name}: {reason}" for row, reason in list(left_out.items())[:3])
    needed = f"{FEWEST_POSES} are needed{': ' * bool(reasons)}{reasons}"
    return QueryFault(f"{count} of {len(queries)} photos of the flight can be used, and {needed}")


def _values_of(fitted: FittedSimilarity) -> dict[str, Any]:
    """Returns a similarity as JSON values."""
    similarity = fitted.similarity
    return {
        "similarity": {
            "scale": similarity.scale,
            "rotation": similarity.rotation.tolist(),
            "translation": similarity.translation.tolist(),
        },
        "sigmas": dict(zip(SIGMAS, map(float, fitted.sigmas), strict=True)),
        "middle": fitted.middle.tolist(),
    }


def _fitted(own: Sequence[Pose], answers: Sequence[Estimate], origin: Floats) -> FittedSimilarity:
    """Returns the similarity that lays own poses on answers, weighed by how sure each is; city's coordinates.

    Eqs. (F27), (F28) of docs/methods/flight.md.
    """
    unknown = np.diag([*ROUGH_M, *[ROUGH_DEG] * 3]) ** 2
    spreads = np.array([np.diagonal(unknown if a.covariance is None else a.covariance) for a in answers])
    sigma_m, sigma_deg = np.sqrt(spreads[:, :3]), np.sqrt(spreads[:, 3:].mean(axis=1))
    fitted = fit_similarity(own, [each.pose.shifted(origin) for each in answers], sigma_m, sigma_deg)
    # What photos of a flight are wrong about, they are wrong about alike: their number makes nothing surer.
    count = len(answers)
    return replace(
        fitted, sigmas=fitted.sigmas * math.sqrt(count), covariance=fitted.covariance * float(count)
    )


def _estimate(
    query: Query, fitted: FittedSimilarity, answer: Estimate | None, left_out: str, city_map: CityMap
) -> Estimate | QueryFault:
    """Returns a photo's pose by the similarity, scene frame; a fault of one that is in no reconstruction.

    Its score is that of the inner method's pose, NaN without one.
    """
    if query.reconstructed is None:
        return QueryFault(left_out)
    placed = fitted.similarity.pose(query.reconstructed)
    pose = placed.shifted(-city_map.scene.origin)
    vector = vector_from_pose(pose)
    covariance = pose_covariance(fitted, placed)
    estimate = Estimate(
        pose,
        math.nan if answer is None else answer.score,
        covariance=covariance,
        probability=probability_within(covariance, vector),
        notes=(f"placed by the other photos of its reconstruction: {left_out}",) if left_out else (),
    )
    # The pose is the similarity's: a laser's range of one photo does not move it.
    return assessed(estimate, replace(query, measured=None), city_map, is_camera_solved=True)


def pose_covariance(fitted: FittedSimilarity, pose: Pose) -> Floats:
    """Returns (6, 6) the covariance of a pose that a similarity has led to, as of ``Estimate``.

    Eq. (F29) of docs/methods/flight.md. The pose is in the city's coordinates.
    """
    away = pose.center - fitted.middle
    slopes = np.zeros((6, 7))
    slopes[:3, :3], slopes[:3, 3:6], slopes[:3, 6] = np.eye(3), -np.radians(cross_matrix(away)), away
    slopes[3:, 3:6] = -np.linalg.pinv(turn_per_angle(vector_from_pose(pose))) @ pose.rotation
    return np.asarray(slopes @ fitted.covariance @ slopes.T)
