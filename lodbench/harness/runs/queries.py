"""A query of a run: from a stored entry to what a method is given, and to its answer as it is stored.

This is the one place where truth may touch a query.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench import segmentation
from lodbench.citymap import CityMap
from lodbench.citymodel.scene import Scene
from lodbench.datasets.faults import camera_fault
from lodbench.datasets.inputs import Input
from lodbench.datasets.query import Dataset, Entry, Query
from lodbench.errors import STOPPED, ConfigError, InputChanged, LodbenchError, QueryFault, WorkersGone
from lodbench.evaluation.predictions import Prediction, encoded_mask
from lodbench.execution.processes import staying_here
from lodbench.geometry import Camera, Pose
from lodbench.harness.runs.requirements import require_near, require_photo, require_tilt
from lodbench.harness.tracebacks import answered_flight, keep_traceback, words_of
from lodbench.methods import Estimate, Method
from lodbench.methods.localize import (
    localize_queries,
    localize_query,
    note_fault,
    number_fault,
    uncertainty_fault,
)
from lodbench.methods.protocol import Streams, SupportsBatches, SupportsFlights
from lodbench.photos.measurements import Measurements
from lodbench.rendering.raster import RasterRenderer
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.segmentation.oracle import Oracle
from lodbench.storage import make_folder, write_text
from lodbench.storage.disk import writable

Points = NDArray[np.float64]
# Beside the words that there is no truth, of a query whose tilt, mask or matches would come from it.
_NOT_ASKED = "not asked, for that would take the true pose"
# What flights say besides poses, one file each.
FLIGHTS_FOLDER = "flights"
# Masks are stored, and compared with the truth, at most at this width, pixels: the paper's fine size.
_MASK_WIDTH = 602
# Those of a flight are held at most at this width, pixels: of 500 drone's photos the whole have 40 GB.
_HELD_WIDTH = 2 * _MASK_WIDTH
# No query is to blame for these. A plug-in's sys.exit is a fault like others: it would end a run silently.
_ENDS_RUN = (ConfigError, InputChanged, WorkersGone, *STOPPED)


@dataclass(frozen=True, eq=False)
class Preparation:
    """How entries become queries in a run."""

    dataset: Dataset  # where the entries come from
    scene: Scene  # the city; queries are moved into its local frame
    segmenter: segmentation.Segmenter  # makes the masks
    tilt: str  # ``prior``, or ``truth`` to replace the prior's pitch and roll by the true ones
    # What is looked at of ``mask``, ``mask_on_demand``, ``instances`` and ``classes``, which the segmenter
    # makes, of the truth, ``true_pixels``, and of ``image``, which must then be fit for the camera; no more
    # is made. ``reconstruction``: photos that have a pose in one may lack a mask.
    needs: frozenset[Input] = frozenset({Input.MASK})
    city_map: CityMap | None = None  # the map that a segmenter may look at; one of its own if None

    def __post_init__(self) -> None:
        require_tilt(self.tilt, self.dataset)

    def local(self, pose: Pose) -> Pose:
        """Returns a pose of the dataset's frame in the scene's local frame."""
        return pose.shifted(-self.scene.origin)

    def in_dataset_frame(self, pose: Pose) -> Pose:
        """Returns a pose of the scene's local frame in the dataset's frame."""
        return pose.shifted(self.scene.origin)

    def prior(self, entry: Entry) -> Pose | None:
        """Returns the prior a method starts from, in the dataset's frame; None if there is none."""
        return prior_of(entry, self.dataset, self.tilt)

    def query(self, entry: Entry) -> Query:
        """Returns the query of an entry.

        Raises:
            QueryFault: The truth, camera or prior is missing, the prior is nowhere near the city, the
                photo is unreadable or of another size than the camera, or the segmenter has no mask, or
                one that is not fit for the camera.
        """
        # Without a truth a pose is wanted for its own sake, and a photo for the others of its flight.
        if self.tilt == "truth" and entry.key not in self.dataset.truth:
            raise QueryFault(_NOT_ASKED)
        if entry.camera is None:
            raise QueryFault("no camera in intrinsic.txt")
        if entry.camera.distortion:
            raise QueryFault(
                "the camera has lens distortion: undistort the image and the mask",
                "lodbench dataset init and import do.",
            )
        if fault := camera_fault(entry.camera):
            raise QueryFault(fault)
        prior = self.prior(entry)
        if prior is None:
            raise QueryFault("no prior pose")
        require_near(prior, self.scene)
        if Input.IMAGE in self.needs:
            require_photo(entry)
        camera, local = entry.camera, self.local(prior)
        needs_mask = Input.MASK in self.needs
        again = needs_mask and isinstance(self.segmenter, segmentation.MapGuidedSegmenter)
        segments = again or Input.MASK_ON_DEMAND in self.needs
        probability = None
        try:
            probability = self._probability(entry, camera, local) if needs_mask else None
        except QueryFault:
            # Its flight's reconstruction places it; why it has no mask, the method hears when it asks.
            if Input.RECONSTRUCTION not in self.needs or entry.reconstructed is None:
                raise
            segments = True
        return Query(
            name=entry.name,
            split=entry.split,
            camera=camera,
            prior=local,
            building_probability=probability,
            image=entry.image,
            hypotheses=tuple(
                self.local(tilted(pose, self.dataset.truth.get(entry.key), self.tilt))
                for pose in entry.hypotheses
            ),
            instances=self._instances(entry, camera, local) if Input.INSTANCES in self.needs else None,
            classes=self._classes(entry, camera) if Input.CLASSES in self.needs else None,
            segment=partial(self._probability, entry, camera) if segments else None,
            true_pixels=self._true_pixels(entry, camera) if Input.TRUE_PIXELS in self.needs else None,
            sequence=entry.sequence,
            reconstructed=entry.reconstructed,
            lens_percent=entry.lens_percent,
            camera_sigmas=entry.camera_sigmas,
            measured=self._measured(entry),
            time_s=None if entry.measured is None else entry.measured.time_s,
        )

    def _measured(self, entry: Entry) -> Measurements | None:
        """Returns what was measured beside a photo; the true tilt has no deviation."""
        is_held = self.tilt == "truth" and entry.measured is not None
        return entry.measured.without_sigmas((3, 4)) if is_held and entry.measured else entry.measured

    def _true_pixels(self, entry: Entry, camera: Camera) -> Callable[[Points], Points]:
        if entry.key not in self.dataset.truth:
            raise QueryFault(_NOT_ASKED)
        truth = self.local(self.dataset.truth[entry.key])
        return lambda points: camera.project((points - truth.center) @ truth.rotation.T)

    def _probability(self, entry: Entry, camera: Camera, pose: Pose) -> NDArray[np.float32]:
        """Returns the checked mask of a query, guided from a pose (scene frame) where the segmenter is."""
        if isinstance(self.segmenter, Oracle):
            probability = self._from_truth(self.segmenter, entry, camera)
        elif isinstance(self.segmenter, segmentation.MapGuidedSegmenter):
            probability = self.segmenter.segment_from(entry, pose, self._map)
        else:
            probability = self.segmenter.segment(entry)
        return segmentation.check_mask(probability, camera)

    def _instances(self, entry: Entry, camera: Camera, pose: Pose) -> NDArray[np.bool_]:
        if isinstance(self.segmenter, Oracle):
            small, truth = self._true_view(self.segmenter, entry, camera)
            (buildings,) = self._raster.buildings(small, truth.rotation[None], truth.center[None])
            return self.segmenter.from_buildings(buildings, entry.key)
        if isinstance(self.segmenter, segmentation.MapGuidedInstanceSegmenter):
            masks = self.segmenter.segment_instances_from(entry, pose, self._map)
            return segmentation.check_instances(masks, camera)
        if not isinstance(self.segmenter, segmentation.InstanceSegmenter):
            raise QueryFault(f"segmenter={self.segmenter.name} has no segment_instances")
        return segmentation.check_instances(self.segmenter.segment_instances(entry), camera)

    def _classes(self, entry: Entry, camera: Camera) -> NDArray[np.uint8]:
        if isinstance(self.segmenter, Oracle):
            small, truth = self._true_view(self.segmenter, entry, camera)
            (classes,) = self._raster.classes(small, truth.rotation[None], truth.center[None])
            return self.segmenter.from_classes(classes, entry.key)
        if not isinstance(self.segmenter, segmentation.ClassSegmenter):
            raise QueryFault(f"segmenter={self.segmenter.name} has no segment_classes")
        return segmentation.check_classes(self.segmenter.segment_classes(entry), camera)

    def _from_truth(self, oracle: Oracle, entry: Entry, camera: Camera) -> NDArray[np.float32]:
        return oracle.from_silhouette(
            self._renderer.render(*self._true_view(oracle, entry, camera)), entry.key
        )

    def _true_view(self, oracle: Oracle, entry: Entry, camera: Camera) -> tuple[Camera, Pose]:
        """Returns the camera at an oracle's width, and the true pose in the scene's frame."""
        if entry.key not in self.dataset.truth:
            raise QueryFault(_NOT_ASKED)
        width = min(oracle.params.width, camera.width)
        small = camera.scaled_to_width(width)
        return small, self.local(self.dataset.truth[entry.key])

    @cached_property
    def _renderer(self) -> SilhouetteRenderer:
        return SilhouetteRenderer(self.scene, threads=1)

    @cached_property
    def _raster(self) -> RasterRenderer:
        return RasterRenderer(self.scene, threads=1)

    @cached_property
    def _map(self) -> CityMap:
        return self.city_map or CityMap(self.scene)


def prior_of(entry: Entry, dataset: Dataset, tilt: str) -> Pose | None:
    """Returns an entry's prior, with the true pitch and roll if ``tilt`` is ``truth``; None without one."""
    return None if entry.prior is None else tilted(entry.prior, dataset.truth.get(entry.key), tilt)


def tilted(prior: Pose, truth: Pose | None, tilt: str) -> Pose:
    """Returns a prior with the true pitch and roll if ``tilt`` is ``truth`` and the truth is known."""
    return prior if truth is None or tilt == "prior" else prior.with_tilt_of(truth)


@dataclass(slots=True)
class PendingQuery:
    """A query on its way to a prediction."""

    entry: Entry  # as the dataset stores it
    streams: Streams  # its random numbers
    query: Query | None = None  # as the method sees it, once it is made
    prepare_s: float = 0.0  # how long that took, seconds
    estimate: Estimate | None = None  # the method's, if there is one
    failure: str = ""  # why there is none

    def prediction(self, preparation: Preparation, folder: Path) -> Prediction:
        """Returns what is stored: the estimate, or why there is none; an odd estimate is a fault too."""
        mask = "" if self.query is None else _stored_mask(self.query)
        if self.estimate is not None:
            with _failing(self, folder):
                return _stored_estimate(self.estimate, self.prepare_s, mask, preparation)
        return Prediction(None, writable(self.failure), hypotheses=0, mask_png=mask)


def _stored_estimate(
    estimate: Estimate, prepare_s: float, mask_png: str, preparation: Preparation
) -> Prediction:
    fault = number_fault(estimate) or uncertainty_fault(estimate) or note_fault(estimate)
    if fault:
        raise ValueError(fault)
    return Prediction(
        pose=Pose.from_matrix(preparation.in_dataset_frame(estimate.pose).cam_from_world),
        score=float(estimate.score) if math.isfinite(estimate.score) else None,
        hypotheses=int(estimate.hypotheses),
        seconds={"prepare": prepare_s, **{stage: float(spent) for stage, spent in estimate.seconds.items()}},
        trace={stage: tuple(map(float, scores)) for stage, scores in estimate.trace.items()},
        probability=None if estimate.probability is None else float(estimate.probability),
        covariance=_upper_triangle(estimate.covariance),
        alternatives=tuple(
            Pose.from_matrix(preparation.in_dataset_frame(pose).cam_from_world)
            for pose in estimate.alternatives
        ),
        alternative_probabilities=tuple(map(float, estimate.alternative_probabilities)),
        notes=tuple(map(writable, estimate.notes)),
        mask_png=mask_png,
    )


@staying_here()
def answer(
    method: Method, preparation: Preparation, city_map: CityMap, waiting: Sequence[PendingQuery], folder: Path
) -> None:
    """Fills in estimates, or why there are none."""
    for each in waiting:
        with _failing(each, folder):
            started = time.perf_counter()
            query = preparation.query(each.entry)
            each.query = _with_small_mask(query) if isinstance(method, SupportsFlights) else query
            each.prepare_s = time.perf_counter() - started
    ready = [(each, each.query) for each in waiting if each.query is not None]
    if isinstance(method, SupportsFlights) and ready:
        _answer_flight(method, city_map, ready, folder)
        return
    if isinstance(method, SupportsBatches) and len(ready) > 1:
        try:
            answers = localize_queries(
                method, [query for _, query in ready], city_map, [each.streams for each, _ in ready]
            )
        except _ENDS_RUN:
            raise
        except BaseException as error:  # one by one it shows which query it is
            keep_traceback(folder, f"batch {ready[0][0].entry.key}", error)
        else:
            for (each, _), answer in zip(ready, answers, strict=True):
                with _failing(each, folder):
                    if isinstance(answer, QueryFault):
                        raise answer
                    each.estimate = answer
            return
    for each, query in ready:
        with _failing(each, folder):
            each.estimate = localize_query(method, query, city_map, each.streams)


def _with_small_mask(query: Query) -> Query:
    """Returns a query whose mask is no larger than methods need: those of a whole flight are held."""
    if query.building_probability is None:
        return query
    small = segmentation.no_wider(query.building_probability, _HELD_WIDTH, query.camera)
    return replace(query, building_probability=small)


def _answer_flight(
    method: SupportsFlights, city_map: CityMap, ready: Sequence[tuple[PendingQuery, Query]], folder: Path
) -> None:
    """Fills in the estimates of a flight's photos; what it says besides goes to the run's folder."""
    first = ready[0][0].entry
    streams = [each.streams for each, _ in ready]
    solution = answered_flight(method, [query for _, query in ready], city_map, streams, folder, first.key)
    for (each, _), answer in zip(ready, solution.estimates, strict=True):
        with _failing(each, folder):
            if isinstance(answer, QueryFault):
                raise answer
            each.estimate = answer
    if solution.findings:
        make_folder(folder / FLIGHTS_FOLDER)
        reported = json.dumps(solution.findings, indent=1, sort_keys=True)
        write_text(folder / FLIGHTS_FOLDER / f"{flight_name(first)}.json", reported + "\n")


def flight_name(entry: Entry) -> str:
    """Returns what the files of a query's flight are called, whatever its dataset calls the sequence."""
    name = f"{entry.split}-{entry.sequence or 'all'}"
    return name.replace("%", "%25").replace("/", "%2F").replace("\\", "%5C")


@contextmanager
def _failing(each: PendingQuery, folder: Path) -> Iterator[None]:
    """Turns what is raised into a query's failure, but for what ends a run; keeps a plug-in's traceback."""
    try:
        yield
    except _ENDS_RUN:
        raise
    except LodbenchError as fault:
        each.failure = fault.message if isinstance(fault, QueryFault) else fault.message.rstrip(".")
    except BaseException as error:
        keep_traceback(folder, each.entry.key, error)
        each.failure = words_of(error)


def _stored_mask(query: Query) -> str:
    """Returns a query's mask at its own size, or at 602 pixels' width if it is larger; "" for none."""
    if query.building_probability is None:
        return ""
    height, width = query.building_probability.shape
    if width > _MASK_WIDTH:
        height, width = max(1, round(_MASK_WIDTH * height / width)), _MASK_WIDTH
    return encoded_mask(segmentation.binary_mask(query.building_probability, width, height))


def _upper_triangle(covariance: NDArray[np.float64] | None) -> tuple[float, ...]:
    """Returns the 21 numbers of a (6, 6) covariance on and above its diagonal, row by row; () for none."""
    return () if covariance is None else tuple(float(v) for v in np.asarray(covariance)[np.triu_indices(6)])
