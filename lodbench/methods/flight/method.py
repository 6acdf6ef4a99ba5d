"""The method: each photo alone, what all are wrong about by vote, then all in one least-squares problem."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.inputs import Input
from lodbench.datasets.query import Query
from lodbench.errors import ConfigError, QueryFault
from lodbench.estimation.state_vector import differences, probability_within
from lodbench.geometry.pose import pose_from_vector, vector_from_pose
from lodbench.methods.contour_alignment import ContourAlignment
from lodbench.methods.flight import aligning
from lodbench.methods.flight.bundle import block_of
from lodbench.methods.flight.demolished_buildings import without_contradicted
from lodbench.methods.flight.findings import MASKS, cannot_tell_focal, constants_of, findings_of, lost_of
from lodbench.methods.flight.joint import (
    CONSTANTS,
    FOCAL,
    State,
    photo_covariance,
    solve,
    without_odd_heights,
)
from lodbench.methods.flight.params import FlightParams
from lodbench.methods.flight.photo_terms import LENS, RoofParts
from lodbench.methods.flight.relative_poses import FEWEST_PHOTOS, Reconstruction, placed, relative_poses
from lodbench.methods.flight.shared_looks import agreed_places, with_masks_by_looks
from lodbench.methods.protocol import Estimate, FlightEstimate, Streams
from lodbench.methods.region import Region

Floats = NDArray[np.float64]

# Steps in which photos find their places among each other, before any outline is looked at.
_TIE_STEPS = 6
_SAME_SCALE = "focal length and height cannot be separated with these photos: focal length unchanged"
# Edges place a flight where no less of the map's lines than this show one: more than do by chance.
_LEAST_EDGES = 0.55
# Priors scatter that do so by more than this times what was declared.
_SCATTERED = 2.0
# What photos have in common is this many sigmas from what was expected before all is believed less.
_EXPECTED_SIGMAS = 2.0


class FlightMethod:
    """Finds the poses of a flight's photos jointly, and what drone and map are wrong about."""

    params_type = FlightParams
    name = "flight"
    requires: frozenset[Input] = frozenset({Input.MASK})

    def __init__(self, params: FlightParams | None = None) -> None:
        self.params = params or FlightParams()
        if self.params.single == "region":
            self.requires = frozenset({Input.IMAGE})

    def localize(self, query: Query, city_map: CityMap, streams: Streams) -> Estimate:
        """Returns the pose of a flight of one photo.

        Raises:
            QueryFault: As for ``ContourAlignment.localize``.
        """
        (estimate,) = self.localize_flight([query], city_map, [streams]).estimates
        if isinstance(estimate, QueryFault):
            raise estimate
        return estimate

    def localize_flight(
        self, queries: Sequence[Query], city_map: CityMap, streams: Sequence[Streams]
    ) -> FlightEstimate:
        """Returns the poses of a flight's photos, in their order, and what it says of drone and map.

        A photo that shows nothing of the map, or whose outline fits nowhere near where the others say it
        was, is placed by the others alone; its covariance says so.

        Raises:
            ConfigError: A reconstruction is required, and there is none of these photos.
        """
        self._require_reconstruction(queries)
        return self.solve(queries, self.localize_alone(queries, city_map, streams), city_map)

    def localize_alone(
        self, queries: Sequence[Query], city_map: CityMap, streams: Sequence[Streams]
    ) -> list[Estimate | QueryFault]:
        """Returns what is found of each photo by itself, in their order."""
        by_looks = self.params.single == "region"
        single = Region(self.params.region()) if by_looks else ContourAlignment(self.params.photo())
        # With the lens as declared: how far it is from that is the flight's to find, which all photos share.
        declared = [replace(query, lens_percent=None) for query in queries]
        return [_alone(single, query, city_map, own) for query, own in zip(declared, streams, strict=True)]

    def solve(
        self, queries: Sequence[Query], alone: Sequence[Estimate | QueryFault], city_map: CityMap
    ) -> FlightEstimate:
        """Returns what ``localize_flight`` does, given what ``localize_alone`` found."""
        params = self.params.with_measured([query.measured for query in queries])
        method = FlightMethod(params.with_cameras([query.camera_sigmas for query in queries]))
        joint = method._solve_by_edges if self.params.single == "region" else method.solve_jointly
        return joint(queries, alone, city_map)

    def solve_jointly(
        self,
        queries: Sequence[Query],
        alone: Sequence[Estimate | QueryFault],
        city_map: CityMap,
        start: State | None = None,
    ) -> FlightEstimate:
        """Returns what ``localize_flight`` does, given what each photo says by itself.

        The start is where sensors and ties have photos, if that is known already.
        """
        faults = [estimate for estimate in alone if isinstance(estimate, QueryFault)]
        if len(faults) == len(alone):
            return FlightEstimate(faults)
        start = self._start(queries, city_map, alone) if start is None else start
        aligned, method = self._aligned_by_masks(queries, alone, city_map, start)
        begun, scattered = aligned.state, self._params_of(start)
        if float((scattered.own_sigmas() / self.params.own_sigmas()).max()) > _SCATTERED:
            # Edges begin where priors that err together lead; what is said does not rest on such priors.
            method._with_covariances(queries, start, aligned, city_map)
            aligned, method = FlightMethod(scattered)._aligned_by_masks(queries, alone, city_map, start)
        estimate = method._finished(queries, start, aligned, city_map)
        if method.params.focal < self.params.focal:
            estimate.findings["notes"] = [_SAME_SCALE]
        return self._refined_by_edges(queries, start, (begun, aligned.state), estimate, city_map)

    def _aligned_by_masks(
        self,
        queries: Sequence[Query],
        alone: Sequence[Estimate | QueryFault],
        city_map: CityMap,
        start: State,
    ) -> tuple[aligning.Aligned, FlightMethod]:
        """Returns where masks have a flight, and the method, its focal length held if they do not tell it."""
        offsets = np.array(
            [
                differences(vector_from_pose(estimate.pose)[None], vector[None])[0]
                for estimate, vector in zip(alone, start.vectors, strict=True)
                if isinstance(estimate, Estimate)
            ]
        )
        offset, _ = aligning.flight_error(queries, start.vectors, offsets, city_map, self.params)
        aligned = aligning.align(queries, start.begun(np.arange(len(queries)), offset), city_map, self.params)
        if not cannot_tell_focal(aligned.solution, self.params):
            return aligned, self
        held = FlightMethod(replace(self.params, focal=0.0))
        aligned.state.constants[FOCAL] = start.constants[FOCAL] = 0.0
        return aligning.align(queries, aligned.state, city_map, held.params), held

    def _refined_by_edges(
        self,
        queries: Sequence[Query],
        start: State,
        states: tuple[State, State],
        flight: FlightEstimate,
        city_map: CityMap,
    ) -> FlightEstimate:
        """Returns a flight that masks have placed where edges have it, if these lie on the map's lines.

        Findings about the map stay those of masks, without those that edges contradict; what is said of the
        drone goes with the poses. ``states`` are where edges begin, and where ``flight`` has the photos.
        """
        begun, state = states
        if all(query.image is None for query in queries):
            return flight
        if start.reconstruction is None:
            return _checked(flight, queries, state, city_map)
        method = FlightMethod(replace(self.params, single="region"))
        begun = replace(start, vectors=begun.vectors).begun(np.arange(len(queries)), np.zeros(6))
        aligned, method = method._aligned_by_edges(queries, begun, city_map)
        if aligning.mean_iou(aligned.terms) < _LEAST_EDGES:
            return _checked(flight, queries, state, city_map)
        refined = method._with_covariances(queries, begun, aligned, city_map)
        by_edges = constants_of(aligned, method.params, np.array(refined.findings["of_constants"]))
        by_masks = flight.findings["constants"]
        constants = {name: by_masks.get(name) if name == MASKS else each for name, each in by_edges.items()}
        findings = {**flight.findings, **lost_of(aligned.state, queries)}
        findings["constants"] = {name: each for name, each in constants.items() if each is not None}
        return _checked(FlightEstimate(refined.estimates, findings), queries, aligned.state, city_map)

    def _solve_by_edges(
        self, queries: Sequence[Query], alone: Sequence[Estimate | QueryFault], city_map: CityMap
    ) -> FlightEstimate:
        """Returns the same of photos without masks, which are compared by their edges."""
        if len(queries) == 1 or all(isinstance(estimate, QueryFault) for estimate in alone):
            return FlightEstimate(alone)
        start = self._start(queries, city_map, alone)
        if start.reconstruction is None:
            start.vectors, _ = agreed_places(start.vectors, alone, self.params)
        aligned, method = self._aligned_by_edges(queries, start, city_map)
        # Masks are made for what stands in the map or on the ground only: poses do not rest on them.
        masked = with_masks_by_looks(queries, aligned.state.vectors, aligned.state.weights, city_map)
        estimate = method._finished(masked, start, aligned, city_map)
        return _checked(estimate, queries, aligned.state, city_map)

    def _aligned_by_edges(
        self, queries: Sequence[Query], start: State, city_map: CityMap
    ) -> tuple[aligning.Aligned, FlightMethod]:
        """Returns where edges have a flight, and the method that knows how far its priors scatter."""
        params = self._params_of(start).for_edges()
        return aligning.align(queries, start, city_map, params), FlightMethod(params)

    def _params_of(self, start: State) -> FlightParams:
        """Returns the parameters with priors that scatter as they do against a block of photos, if any."""
        if start.reconstruction is None:
            return self.params
        gaps = differences(start.vectors, start.priors)
        return self.params.with_scatter(gaps[start.reconstruction.photos])

    def _require_reconstruction(self, queries: Sequence[Query]) -> None:
        known = sum(query.reconstructed is not None for query in queries)
        if self.params.relative_poses == "reconstruction" and known < min(FEWEST_PHOTOS, len(queries)):
            raise ConfigError(
                f"method.relative_poses=reconstruction, and {known} of {len(queries)} photos of the flight "
                f"of {queries[0].name} are in a reconstruction.",
                "Set `method.relative_poses=auto`, or give the flight's COLMAP model (docs/flights.md).",
            )

    def _finished(
        self, queries: Sequence[Query], start: State, aligned: aligning.Aligned, city_map: CityMap
    ) -> FlightEstimate:
        """Returns the poses of an aligned flight, and what it says of drone and map."""
        flight = self._with_covariances(queries, start, aligned, city_map)
        of_constants = np.array(flight.findings["of_constants"])
        return FlightEstimate(
            flight.estimates, findings_of(aligned, queries, city_map, self.params, of_constants)
        )

    def _with_covariances(
        self, queries: Sequence[Query], start: State, aligned: aligning.Aligned, city_map: CityMap
    ) -> FlightEstimate:
        """Returns the poses of an aligned flight; of findings what constants err by besides, (13, 13)."""
        ends = self._ends(queries, start, aligned, city_map)
        aligned.state.shift(*ends.middle)
        of_pose, of_constants = ends.covariances
        of_footprints = self._footprint_covariances(aligned, len(of_constants))

        def estimate(row: int) -> Estimate:
            return self._estimate(aligned, row, of_pose + of_footprints[row])

        # Each takes the longer the more photos there are: of hundreds, all of them take as long as the steps.
        with aligning.side_by_side(city_map.threads) as threads:
            estimates = list((map if threads is None else threads.map)(estimate, range(len(queries))))
        return FlightEstimate(estimates, {"of_constants": of_constants + of_footprints[-1]})

    def _footprint_covariances(self, aligned: aligning.Aligned, constants: int) -> list[Floats]:
        """Returns what footprints of the map are wrong about: (6, 6) of each photo, and of constants last.

        No photo shows it: cameras go aside with a building. Outlines of masks lie on all buildings alike;
        of edges a few may outweigh all others: each building's error is followed through the solution.
        """
        photos, footprint_m = len(aligned.terms), self.params.footprint_m
        if self.params.single != "region":
            terms = aligned.terms, aligned.state.roofs, footprint_m
            return [aligning.footprint_covariance(*terms, size) for size in (*[6] * photos, constants)]
        moved = footprint_m * aligned.solution.moved_by_places()
        blocks = [moved[6 * k : 6 * k + 6] for k in range(photos)]
        return [block @ block.T for block in (*blocks, moved[6 * photos :][:constants])]

    def _ends(
        self, queries: Sequence[Query], start: State, aligned: aligning.Aligned, city_map: CityMap
    ) -> aligning.Ends:
        """Returns where the flight ends from other starts around its answer.

        Some photos of a long flight end elsewhere than all of them do: theirs are compared with each other.
        """
        starts_m = aligning.STARTS_M[: self.params.restarts]
        photos, offset = (
            aligning.restarted(len(queries), bool(start.ties)),
            aligned.state.offset - start.offset,
        )
        if len(photos) < len(queries) and len(starts_m):
            starts_m, ends = np.vstack([np.zeros(3), starts_m]), []
        else:
            iou = aligning.mean_iou([aligned.terms[k] for k in photos])
            ends = [(aligned.state.vectors[photos], aligned.state.constants, iou)]
        # Restarts look at the same photos: each is made ready once.
        some = [queries[k] for k in photos]
        evidence = aligning.Evidence.of(some, city_map, self.params) if len(starts_m) else None
        for start_m in starts_m:
            begun = start.begun(photos, offset + np.append(start_m, np.zeros(3)))
            again = aligning.align(some, begun, city_map, self.params, evidence)
            ends.append((again.state.vectors, again.state.constants, aligning.mean_iou(again.terms)))
        return aligning.ends_of(ends)

    def _start(
        self, queries: Sequence[Query], city_map: CityMap, alone: Sequence[Estimate | QueryFault]
    ) -> State:
        """Returns where photos are by what sensors say, and by what ties them to each other."""
        priors = np.array([vector_from_pose(query.prior) for query in queries])
        state = State(
            vectors=priors,
            priors=priors,
            roofs=RoofParts(self.params.part_width_m, city_map.scene.num_buildings),
            buildings_m=np.zeros(city_map.scene.num_buildings),
            weights=np.ones(len(queries)),
            measured=without_odd_heights([query.measured for query in queries], priors),
        )
        kind = self.params.relative_poses
        known = {k: query.reconstructed for k, query in enumerate(queries) if query.reconstructed is not None}
        information = self.params.reconstruction_information()
        if kind in ("auto", "reconstruction"):
            state.reconstruction = placed(known, priors, information)
        if kind in ("auto", "tracks"):
            state.ties, shared = relative_poses(queries, priors)
        if state.ties or state.reconstruction is not None:
            # Photos move to their places among each other.
            for _ in range(_TIE_STEPS):
                state.step(solve(state, [None] * len(state.vectors), self.params))
        if state.reconstruction is not None and self.params.single == "region":
            # Masks vote on what sensors are wrong about; without them, where photos find themselves says it.
            places = _places(state.vectors, alone)
            state.reconstruction = placed(known, places, information) or state.reconstruction
            state.vectors = _in_block(state.reconstruction, places)
        elif kind in ("auto", "tracks") and state.reconstruction is None:
            # How far a photo may be from where sensors have it, whatever they share.
            sigmas = np.hypot(self.params.own_sigmas(), self.params.shared_sigmas())
            block = block_of(shared, state.vectors, sigmas, queries[0].camera.fx)
            places = _places(state.vectors, alone)
            state.reconstruction = placed(block, places, information)
            if state.reconstruction is not None:
                state.vectors = _in_block(state.reconstruction, places)
                # Its photos are tied by all that they share at once.
                state.ties = [t for t in state.ties if not {t.first, t.second} <= block.keys()]
        return state

    def _misfit(self, state: State) -> float:
        """Returns by how much less all is known where photos agree on what masks and map can hardly be.

        Eq. (F19) of docs/methods/flight.md. Masks that are all far too large, or roofs all far too high,
        stand for an error of another kind.
        """
        common = slice(6 + LENS - 1, CONSTANTS)
        beyond = (
            state.constants[common] / self.params.constant_sigmas(state.scales)[common] / _EXPECTED_SIGMAS
        )
        return max(1.0, float((beyond**2).max()))

    def _estimate(self, aligned: aligning.Aligned, row: int, besides: Floats) -> Estimate:
        """Returns a photo's pose; ``besides`` is what it errs by beyond what the solution says, (6, 6)."""
        vector = aligned.state.vectors[row]
        spread = photo_covariance(aligned.solution, row) * self._misfit(aligned.state) + besides
        term = aligned.terms[row]
        return Estimate(
            pose=pose_from_vector(vector),
            score=0.0 if term is None else term.overlap,
            covariance=spread,
            probability=probability_within(spread, vector),
        )


def _checked(
    flight: FlightEstimate, queries: Sequence[Query], state: State, city_map: CityMap
) -> FlightEstimate:
    """Returns a flight without the findings about its map that edges of its photos contradict."""
    kept = without_contradicted(flight.findings, queries, state.vectors, state.lens, city_map)
    return FlightEstimate(flight.estimates, kept)


def _places(vectors: Floats, alone: Sequence[Estimate | QueryFault]) -> Floats:
    """Returns (P, 6) where photos found themselves, or else where sensors and ties have them."""
    poses = [
        vector if isinstance(each, QueryFault) else vector_from_pose(each.pose)
        for vector, each in zip(vectors, alone, strict=True)
    ]
    return np.array(poses)


def _in_block(block: Reconstruction, vectors: Floats) -> Floats:
    """Returns (P, 6) poses of photos as a block has them, or as given of those that are not in it."""
    poses = vectors.copy()
    for photo, pose in block.poses.items():
        poses[photo] = vector_from_pose(pose)
    return poses


def _alone(
    method: ContourAlignment | Region, query: Query, city_map: CityMap, streams: Streams
) -> Estimate | QueryFault:
    try:
        return method.localize(query, city_map, streams)
    except QueryFault as fault:
        return fault
