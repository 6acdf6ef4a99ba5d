"""From a stored entry to what a method is given: the one place where truth may touch a query.

Besides, what a run's numbers depend on through its method: weights, pictures, and what it prepared from them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymodel.scene import Scene
from lodbench.datasets.faults import camera_fault
from lodbench.datasets.inputs import Input, declared_inputs
from lodbench.datasets.query import Dataset, Entry, Query, Reference
from lodbench.errors import STOPPED, ConfigError, LodbenchError, QueryFault, nearest_names
from lodbench.execution.guards import single_threaded_blas, staying_here
from lodbench.geometry import Camera, Pose
from lodbench.harness.runs.requirements import require_near, require_photo
from lodbench.harness.tracebacks import keep_traceback, words_of
from lodbench.methods import Method
from lodbench.methods.localize import weight_files
from lodbench.methods.protocol import SupportsFlights, SupportsPrepare, open_workspace
from lodbench.photos.measurements import Measurements
from lodbench.rendering.raster import RasterRenderer
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.segmentation import (
    ClassSegmenter,
    InstanceSegmenter,
    MapGuidedInstanceSegmenter,
    MapGuidedSegmenter,
    Segmenter,
    check_classes,
    check_instances,
    check_mask,
)
from lodbench.segmentation.oracle import Oracle
from lodbench.storage import digest_of
from lodbench.storage.digest import content_digest

Points = NDArray[np.float64]

TILTS = ("prior", "truth")
# Beside the words that there is no truth, of a query whose tilt, mask or matches would come from it.
_NOT_ASKED = "not asked, for that would take the true pose"


@dataclass(frozen=True, eq=False)
class Preparation:
    """How entries become queries in a run.

    Attributes:
        dataset: Where the entries come from.
        scene: The city; queries are moved into its local frame.
        segmenter: Makes the masks.
        tilt: ``prior``, or ``truth`` to replace the prior's pitch and roll by the true ones.
        needs: What is looked at of ``mask``, ``mask_on_demand``, ``instances`` and ``classes``, which
            the segmenter makes, of the truth, ``true_pixels``, and of ``image``, which must then be fit for
            the camera; no more is made.
        city_map: The map that a segmenter may look at; one of its own if None.
    """

    dataset: Dataset
    scene: Scene
    segmenter: Segmenter
    tilt: str
    needs: frozenset[Input] = frozenset({Input.MASK})
    city_map: CityMap | None = None

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
        again = needs_mask and isinstance(self.segmenter, MapGuidedSegmenter)
        segments = again or Input.MASK_ON_DEMAND in self.needs
        return Query(
            name=entry.name,
            split=entry.split,
            camera=camera,
            prior=local,
            building_probability=self._probability(entry, camera, local) if needs_mask else None,
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
            found = self._from_truth(self.segmenter, entry, camera)
        elif isinstance(self.segmenter, MapGuidedSegmenter):
            found = self.segmenter.segment_from(entry, pose, self._map)
        else:
            found = self.segmenter.segment(entry)
        return check_mask(found, camera)

    def _instances(self, entry: Entry, camera: Camera, pose: Pose) -> NDArray[np.bool_]:
        if isinstance(self.segmenter, Oracle):
            small, truth = self._true_view(self.segmenter, entry, camera)
            (seen,) = self._raster.buildings(small, truth.rotation[None], truth.center[None])
            return self.segmenter.from_buildings(seen, entry.key)
        if isinstance(self.segmenter, MapGuidedInstanceSegmenter):
            found = self.segmenter.segment_instances_from(entry, pose, self._map)
            return check_instances(found, camera)
        if not isinstance(self.segmenter, InstanceSegmenter):
            raise QueryFault(f"segmenter={self.segmenter.name} has no segment_instances")
        return check_instances(self.segmenter.segment_instances(entry), camera)

    def _classes(self, entry: Entry, camera: Camera) -> NDArray[np.uint8]:
        if isinstance(self.segmenter, Oracle):
            small, truth = self._true_view(self.segmenter, entry, camera)
            (seen,) = self._raster.classes(small, truth.rotation[None], truth.center[None])
            return self.segmenter.from_classes(seen, entry.key)
        if not isinstance(self.segmenter, ClassSegmenter):
            raise QueryFault(f"segmenter={self.segmenter.name} has no segment_classes")
        return check_classes(self.segmenter.segment_classes(entry), camera)

    def _from_truth(self, oracle: Oracle, entry: Entry, camera: Camera) -> NDArray[np.float32]:
        """Returns what an oracle makes of the silhouette at the truth."""
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


def require_choices(tilt: str, limit: int | None = None) -> None:
    """Makes sure of what can be checked of a run's settings before any dataset is opened, or built.

    Raises:
        ConfigError: A tilt is none of ``TILTS``, or no query is requested.
    """
    if tilt not in TILTS:
        raise ConfigError(f"tilt={tilt} is not known.", nearest_names(tilt, TILTS))
    if limit is not None and limit < 1:
        raise ConfigError(f"limit={limit} is not a number of queries.")


def require_tilt(tilt: str, dataset: Dataset) -> None:
    """Makes sure that a tilt is one of ``TILTS``, and that a dataset has it.

    Raises:
        ConfigError: It is not, or the true one is requested and there is no truth.
    """
    require_choices(tilt)
    if tilt == "truth" and not dataset.truth:
        raise ConfigError("tilt=truth needs a truth, and the dataset has none.", "Leave it out.")


def prior_of(entry: Entry, dataset: Dataset, tilt: str) -> Pose | None:
    """Returns an entry's prior, with the true pitch and roll if ``tilt`` is ``truth``; None without one."""
    return None if entry.prior is None else tilted(entry.prior, dataset.truth.get(entry.key), tilt)


def tilted(prior: Pose, truth: Pose | None, tilt: str) -> Pose:
    """Returns a prior with the true pitch and roll if ``tilt`` is ``truth`` and the truth is known."""
    return prior if truth is None or tilt == "prior" else prior.with_tilt_of(truth)


# What a workspace's content depends on, of a run's inputs.
_PREPARED_FROM = ("scene", "roofs", "code", "weights", "references", "textured_map")


def method_inputs(method: Method, dataset: Dataset, entries: Sequence[Entry]) -> dict[str, str]:
    """Returns digests of the weights, photos and references that a method uses; nothing for what it does not.

    Raises:
        ConfigError: A file of weights is missing.
    """
    requires = declared_inputs(method, "requires", {Input.MASK})
    weights = weight_files(method)
    inputs = {}
    if weights:
        inputs["weights"] = digest_of([content_digest(file) for file in weights])
    # Methods for flights look at photos where there are any; of the same photos all have the same digest.
    shown = [entry for entry in entries if entry.image is not None]
    if shown and (Input.IMAGE in requires or isinstance(method, SupportsFlights)):
        inputs["images"] = digest_of([[entry.key, content_digest(entry.image)] for entry in shown])
    if Input.REFERENCES in requires:
        inputs["references"] = digest_of([_identity(reference) for reference in dataset.references])
    return inputs


@staying_here()
def prepare_method(
    method: Method,
    params: object,
    inputs: Mapping[str, str],
    city_map: CityMap,
    references: Sequence[Reference],
    folder: Path,
) -> None:
    """Lets a method prepare, if it does, in the workspace of this content; a second time it finds it filled.

    Args:
        method: The method.
        params: Its parameters, as JSON values.
        inputs: Digests of the run's inputs.
        city_map: The map.
        references: Posed pictures in the dataset's frame.
        folder: The run's, for the traceback of a fault.

    Raises:
        LodbenchError: It cannot prepare: in the method's words, or, for a fault of its code, with the
            traceback's file.
    """
    if not isinstance(method, SupportsPrepare):
        return
    content = {name: inputs[name] for name in _PREPARED_FROM if name in inputs}
    workspace = open_workspace(method.name, digest_of([method.name, params, content]))
    local = [replace(r, pose=r.pose.shifted(-city_map.scene.origin)) for r in references]
    try:
        single_threaded_blas(method.prepare)(city_map, local, workspace)
    except (LodbenchError, *STOPPED):
        raise
    except BaseException as error:  # a plug-in's code may raise anything
        file = keep_traceback(folder, "prepare", error)
        raise ConfigError(
            f"method={method.name} cannot prepare: {words_of(error)}", f"See {file}."
        ) from error


def _identity(reference: Reference) -> list[object]:
    pose = [float(v) for v in reference.pose.cam_from_world[:3].ravel()]
    return [reference.name, repr(reference.camera), pose, content_digest(reference.image)]
