"""Parameters of the joint alignment of flights; docs/methods/flight.md says where defaults come from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import ConfigError, nearest_names, require_numbers
from lodbench.geometry.camera import STATED, CameraSigmas
from lodbench.methods.contour_alignment import ContourAlignmentParams
from lodbench.methods.region import RegionParams
from lodbench.photos.measurements import Measurements

Floats = NDArray[np.float64]

SINGLE_METHODS = ("contour_alignment", "region")
RELATIVE_POSES = ("auto", "reconstruction", "tracks", "none")
_AS_DECLARED: Floats = np.ones(6)
# Standard deviations of heights beside edges, metres: of all roofs alike, each roof, and parts of one.
_EDGES_ROOFS_M, _EDGES_ROOF_M, _EDGES_PART_M = 0.5, 0.7, 0.5
# The same of the principal point, shares of the width: masks alone do not tell it from the tilt.
_EDGES_CENTER = 0.0035
# Of a Gaussian: its deviation per median absolute one; fewer photos say nothing of how they scatter.
_MAD, _FEWEST_TO_SCATTER = 1.4826, 5


@dataclass(frozen=True, slots=True)
class FlightParams:
    """The settings of ``method=flight``.

    Errors are half widths of what is uniform, or standard deviations where that is said. An error of 0
    is switched off: that number is held at the prior's.

    Attributes:
        name: Name to report.
        shared_m: Error of all of a flight's positions, east and north, metres.
        own_m: Error of each photo's position, east, north and up, metres.
        shared_height_m: Error of all of a flight's heights, metres.
        shared_tilt_deg: Error of the gimbal's pitch and roll, degrees.
        own_tilt_deg: The same of each photo.
        shared_yaw_deg: Error of the compass, degrees.
        own_yaw_deg: The same of each photo.
        focal: Standard deviation of the focal length, as a share of it.
        distortion: Standard deviation of the lens's radial distortion k1, of normalised coordinates.
        center: Standard deviation of the principal point to the right and down, shares of the width.
        mask_px: Standard deviation of how much masks are grown or shrunk, pixels of the fine size.
        roofs_m: Standard deviation of what all roofs of the map are wrong about alike, metres.
        roof_m: Standard deviation of each building's height in the map, metres.
        part_m: Standard deviation of the height of parts of a roof around it, metres.
        feet_m: Standard deviation of where all walls of the map end, alike, metres.
        foot_m: The same of parts of them, metres.
        footprint_m: Standard deviation of where each building's footprint lies in the map, east and north,
            metres: what cameras over few buildings err by with them.
        part_width_m: Width of a part, metres.
        view_roof_m: The same as one view sees it: a ridge from here, eaves from there.
        heat: By how much less outlines say than their covariance has it: the model is not the whole truth.
        single: How each photo is found by itself: ``contour_alignment``, by its mask; or ``region``, by its
            pixels: masks are then made of what roofs, walls and ground look like in all photos of a flight.
        relative_poses: What ties photos to each other: ``reconstruction``, a model of the flight (COLMAP) up
            to a similarity; ``tracks``, features of neighbouring photos; ``none``; or ``auto`` for all there
            is of both.
        reconstruction_m: Standard deviation of poses within a reconstruction, metres.
        reconstruction_deg: The same of their turn, degrees.
        reconstruction_mount_deg: The same of a turn of all its cameras alike, about their own axes, degrees.
        steps: Joint steps with robust kernels that narrow, and as many final ones.
        votes: Most photos whose own answers are tried as the flight's error, and that judge them.
        restarts: Other starts around the answer, at most 4: how far apart they end is part of what poses
            err by.
        narrows: Whether the flight says by how much less map and relative poses err than is declared here
            (variance components); never where masks are made with the map, for these agree with it.
        lost_sigmas: A photo this far from what the flight says of it is lost.
    """

    name: str = "flight"
    shared_m: float = 8.0
    own_m: float = 2.0
    shared_height_m: float = 28.0
    shared_tilt_deg: float = 0.8
    own_tilt_deg: float = 0.3
    shared_yaw_deg: float = 5.0
    own_yaw_deg: float = 2.5
    focal: float = 0.01
    distortion: float = 0.01
    center: float = 0.0
    mask_px: float = 0.5
    roofs_m: float = 1.5
    roof_m: float = 2.0
    part_m: float = 2.0
    feet_m: float = 1.0
    foot_m: float = 1.5
    footprint_m: float = 1.0
    part_width_m: float = 20.0
    view_roof_m: float = 0.5
    heat: float = 1.5
    single: str = "contour_alignment"
    relative_poses: str = "auto"
    reconstruction_m: float = 0.15
    reconstruction_deg: float = 0.05
    reconstruction_mount_deg: float = 0.4
    steps: int = 8
    votes: int = 24
    restarts: int = 4
    narrows: bool = True
    lost_sigmas: float = 6.0

    def __post_init__(self) -> None:
        require_numbers(self, "method", self.__slots__[1:21], 0)
        reconstruction = ("reconstruction_m", "reconstruction_deg", "reconstruction_mount_deg")
        positive = ("part_width_m", "heat", *reconstruction, "lost_sigmas")
        require_numbers(self, "method", positive, 0, ends="(]")
        for name, known in (("relative_poses", RELATIVE_POSES), ("single", SINGLE_METHODS)):
            if getattr(self, name) not in known:
                near = nearest_names(getattr(self, name), known)
                raise ConfigError(f"method.{name}={getattr(self, name)} is not known.", near)
        if self.steps < 1 or self.votes < 1:
            raise ConfigError("`method.steps` and `method.votes` are at least 1.")
        if not 0 <= self.restarts <= 4:
            raise ConfigError(f"method.restarts lies within 0 and 4, not {self.restarts}.")

    def shared_sigmas(self) -> Floats:
        """Returns (6,) standard deviations of the flight's x, y, z, pitch, roll and yaw."""
        widths = (self.shared_m, self.shared_m, self.shared_height_m)
        return _sigmas(*widths, self.shared_tilt_deg, self.shared_tilt_deg, self.shared_yaw_deg)

    def own_sigmas(self) -> Floats:
        """Returns (6,) standard deviations of each photo's x, y, z, pitch, roll and yaw."""
        widths = (self.own_m, self.own_m, self.own_m)
        return _sigmas(*widths, self.own_tilt_deg, self.own_tilt_deg, self.own_yaw_deg)

    def with_scatter(self, gaps: Floats) -> FlightParams:
        """Returns the parameters with photos' own errors as large as they scatter, or as declared.

        Eq. (F13) of docs/methods/flight.md; (P, 6) where a block of photos has each, less what sensors say.
        """
        if len(gaps) < _FEWEST_TO_SCATTER:
            return self
        scatter = _MAD * np.median(np.abs(gaps - np.median(gaps, axis=0)), axis=0)
        widths = math.sqrt(3.0) * scatter
        return replace(
            self,
            own_m=max(self.own_m, float(widths[:3].max())),
            own_tilt_deg=max(self.own_tilt_deg, float(widths[3:5].max())),
            own_yaw_deg=max(self.own_yaw_deg, float(widths[5])),
        )

    def with_measured(self, measured: Sequence[Measurements | None]) -> FlightParams:
        """Returns the parameters with shared errors as large as all photos of a flight state theirs, at most.

        Eq. (F25) of docs/methods/flight.md: receivers of one flight may err alike.
        """
        stated = [(None,) * 6 if each is None else each.sigmas for each in measured]

        def shared(usual: float, *axes: int) -> float:
            known = [sigmas[k] for sigmas in stated for k in axes]
            return usual if None in known else math.sqrt(3.0) * max(sigma or 0.0 for sigma in known)

        return replace(
            self,
            shared_m=shared(self.shared_m, 0, 1),
            shared_height_m=shared(self.shared_height_m, 2),
            shared_tilt_deg=shared(self.shared_tilt_deg, 3, 4),
            shared_yaw_deg=shared(self.shared_yaw_deg, 5),
        )

    def with_cameras(self, cameras: Sequence[CameraSigmas | None]) -> FlightParams:
        """Returns the parameters with the camera as well known as a flight's photos have it, if that is less.

        Deviations that a person states are taken as they are, smaller ones too; the principal point is held
        where masks place the photos, which do not show it.
        """
        known = [camera for camera in cameras if camera is not None]
        if not known:
            return self
        worst = max(known, key=lambda camera: camera.focal_percent)
        focal, distortion = 0.01 * worst.focal_percent, worst.k1
        # What a person leaves out of it is no statement that it is known exactly.
        if worst.source != STATED or not focal:
            focal = max(self.focal, focal)
        if worst.source != STATED or not distortion:
            distortion = max(self.distortion, distortion)
        center = 0.01 * worst.center_percent if self.single == "region" else 0.0
        return replace(self, focal=focal, distortion=distortion, center=max(self.center, center))

    def constant_sigmas(self, scales: Floats = _AS_DECLARED) -> Floats:
        """Returns (13,) standard deviations beforehand of what photos share, in the order of ``joint``.

        Roofs, feet of walls and more err by shares of what is declared.
        """
        map_m = scales[0] * self.roofs_m, scales[2] * self.feet_m
        lens = (self.focal, self.distortion, self.center, self.center, self.mask_px)
        return np.concatenate([self.shared_sigmas(), np.maximum([*lens, *map_m], 1e-7)])

    def reconstruction_information(self) -> Floats:
        """Returns (6, 6) how well poses are known in a reconstruction: of metres, then radians."""
        sigmas = np.repeat([self.reconstruction_m, math.radians(self.reconstruction_deg)], 3)
        return np.asarray(np.diag(sigmas**-2.0))

    def mount_precision(self) -> float:
        """Returns how surely a reconstruction's cameras are turned right, per square radian."""
        return float(math.radians(self.reconstruction_mount_deg) ** -2.0)

    def trust(self) -> tuple[float, float]:
        """Returns ``view_roof_m`` and ``heat``: how far one view's outlines are believed."""
        return self.view_roof_m, self.heat

    def for_edges(self) -> FlightParams:
        """Returns the parameters where edges of photos say the poses: they lie on roofs, no mask's stairs do.

        Heights of roofs err as ``region`` has it; single roofs may still be wrong by much (Student's t).
        """
        return replace(
            self,
            center=max(self.center, _EDGES_CENTER),
            roofs_m=min(self.roofs_m, _EDGES_ROOFS_M),
            roof_m=min(self.roof_m, _EDGES_ROOF_M),
            part_m=min(self.part_m, _EDGES_PART_M),
        )

    def photo(self) -> ContourAlignmentParams:
        """Returns the parameters by which each photo is aligned alone, over all that is left open."""
        # What roofs leave open to one photo the others tell.
        return replace(ContourAlignmentParams(), pitched_lower_m=0.0, **self._ranges())

    def region(self) -> RegionParams:
        """Returns the same for photos that are found by their pixels."""
        # The best pose on the map as it is: what one photo leaves open the others tell, roofs as well.
        # Without those, lines count where the map is exact (docs/adr/0011, point 5).
        exact = RegionParams(roofs_m=0.0, pitched_lower_m=0.0, own_roofs_m=0.0, feet_m=0.0, eaves_m=0.0)
        # The edges of all photos together refine them.
        as_it_is = replace(exact, place_sigma_m=0.0, edges=False)
        return replace(as_it_is, lines_weight=0.1, least_sharpness=0.7, **self._ranges())

    def _ranges(self) -> dict[str, Any]:
        plane = 2.0 * (self.shared_m + self.own_m)
        return {
            "range_x_m": plane,
            "range_y_m": plane,
            "range_z_m": 2.0 * (self.shared_height_m + self.own_m),
            "range_yaw_deg": 2.0 * (self.shared_yaw_deg + self.own_yaw_deg),
            "range_tilt_deg": 2.0 * (self.shared_tilt_deg + self.own_tilt_deg),
        }


def _sigmas(*widths: float) -> Floats:
    # What is held is held to a tenth of a millimetre, or of a thousandth of a degree.
    return np.maximum(np.array(widths) / math.sqrt(3.0), 1e-4)
