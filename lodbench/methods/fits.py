"""The fits that a method may use, by name, and poses scored by one: of a query's mask or its photo.

iou: the paper's. soft_iou: with the probabilities as they are. confident_iou: the mask, each pixel weighted
by how sure the network is. boundary: chamfer distance of outlines. region, of ``methods.region``: no mask,
what the photo looks like inside and outside. semantic_iou: of roofs and of walls, with a mask of classes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self, cast

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.inputs import Input
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Query
from lodbench.errors import ConfigError, QueryFault
from lodbench.geometry import Camera, rotations_at_yaws
from lodbench.kernels.arguments import GUARD_PX
from lodbench.photos.measurements import Measurements
from lodbench.photos.pictures import read_picture
from lodbench.plugins import load_plugin
from lodbench.rendering import BoundaryFit, Fit, IouFit, SoftIouFit
from lodbench.segmentation import BUILDING_THRESHOLD, resized, resized_classes

if TYPE_CHECKING:
    from lodbench.citymap import CityMap
    from lodbench.estimation.edge_alignment import PhotoEdges

Probability = NDArray[np.float32]
Photo = NDArray[Any]
Floats = NDArray[np.float64]


class NothingFits(QueryFault):
    """No hypothesis about a query fits it at all."""


def nothing_fits(what: str) -> NothingFits:
    """Returns the fault of a query none of whose hypotheses does what is named, and what to check."""
    return NothingFits(
        f"{what}: the prior may be far from the city, or look past it",
        "lodbench city info FILE says where the city is, and in which reference system; a gimbal's pitch is "
        "0 at the horizon and -90 straight down.",
    )


def iou(probability: Probability) -> Fit:
    """Returns the intersection over union with the mask."""
    return IouFit(probability >= BUILDING_THRESHOLD)


def confident_iou(probability: Probability) -> Fit:
    """Returns the IoU with the mask, pixels weighted by ``|2 p - 1|``.

    Raises:
        QueryFault: All weights are 0.
    """
    # A pixel that the network cannot tell counts for nothing; on a mask of 0 and 1 this is the IoU.
    confidence = np.abs(2.0 * probability.astype(np.float64) - 1.0)
    if not confidence.any():
        raise QueryFault("the mask is 0.5 everywhere: no information")
    return SoftIouFit((probability >= BUILDING_THRESHOLD).astype(np.float64), confidence)


def boundary(probability: Probability) -> Fit:
    """Returns the chamfer similarity to the mask's outline."""
    return BoundaryFit(probability >= BUILDING_THRESHOLD)


def fit_input(name: str) -> Input:
    """Returns what the fit of a name looks at: the mask, a mask of classes, or the photo.

    Raises:
        ConfigError: There is no such fit, or it is broken or looks at something else.
    """
    wanted = getattr(load_plugin("fits", name), "input", Input.MASK)
    if wanted not in (Input.MASK, Input.CLASSES, Input.IMAGE):
        raise ConfigError(f"The fit {name} looks at {wanted!r}, which is neither mask nor classes nor image.")
    return Input(wanted)


def make_fit(name: str, query: Query, size: tuple[int, int]) -> Fit:
    """Returns the fit of a name for a query, at a working size (width, height) in pixels.

    Args:
        name: An entry point under ``lodbench.fits``: makes a fit of a (height, width) probability, or, where
            it says ``input = "classes"``, of (height, width) classes, or, where it says ``input = "image"``,
            of a photo as of ``read_picture`` and the size.
        query: Has a mask, a mask of classes, or a photo.
        size: Width and height of the silhouettes to compare.

    Raises:
        ConfigError: There is no such fit, or it is broken.
        QueryFault: No pixel is more likely building than not, or the photo cannot be read.
    """
    make = load_plugin("fits", name)
    if fit_input(name) == Input.IMAGE:
        return cast("Fit", make(query_photo(query), size))
    if fit_input(name) == Input.CLASSES:
        if query.classes is None:
            raise QueryFault("there is no mask of roofs and walls")
        classes = resized_classes(query.classes, *size)
        if not classes.any():
            raise QueryFault("the mask holds neither roof nor wall", "Roofs are 1 in it, walls are 2.")
        return cast("Fit", make(classes))
    # Averaging in float32 may step out of [0, 1] by rounding.
    small = np.clip(resized(query.mask, *size), np.float32(0), np.float32(1))
    if not (small >= BUILDING_THRESHOLD).any():
        raise QueryFault(
            "the mask holds no building", "Buildings are white (255) in a mask, all else is black."
        )
    return cast("Fit", make(small))


def query_photo(query: Query) -> Photo:
    """Returns a query's photo, (H, W, 3) BGR of 8 bits.

    Raises:
        QueryFault: There is none, it cannot be decoded, or shows nothing.
    """
    if query.image is None:
        raise QueryFault("there is no photo")
    photo = read_picture(query.image)
    if photo is None:
        raise QueryFault(f"the photo {query.image.name} cannot be decoded")
    # First by some of the pixels: nearly all photos end there.
    if all((part == photo[0, 0]).all() for part in (photo[::32, ::32], photo)):
        raise QueryFault(f"the photo {query.image.name} has one colour everywhere")
    return photo


# Edges are looked at in photos so wide, pixels.
EDGES_WIDTH = 1200


def photo_edges(query: Query) -> PhotoEdges | None:
    """Returns the edges of a query's photo, up to 1200 pixels wide; None where none can be decoded.

    The last photo's are kept: what finds a pose and what doubts it look at the same.
    """
    if query.image is None:
        return None
    try:
        stat = query.image.stat()
    except OSError:
        return None
    small = query.camera.scaled_to_width(min(EDGES_WIDTH, query.camera.width))
    return _photo_edges(query.image, (stat.st_mtime_ns, stat.st_size), (small.width, small.height))


@lru_cache(1)
def _photo_edges(path: Path, stamp: tuple[int, int], size: tuple[int, int]) -> PhotoEdges | None:
    picture = read_picture(path)
    if picture is None:
        return None
    from lodbench.estimation.edge_alignment import PhotoEdges

    return PhotoEdges(picture, size)


class Particles(NamedTuple):
    """Poses of one tilt, and how well each fits.

    Attributes:
        centers: (N, 3) camera centres, scene metres.
        yaws_deg: (N,) yaw, degrees.
        scores: (N,) IoU, or another fit.
    """

    centers: Floats
    yaws_deg: Floats
    scores: Floats


# From camera centres, (N, 3) scene metres, and yaws, (N,) degrees, to the poses with their scores.
Scoring = Callable[[Floats, Floats], Particles]


class PoseScorer:
    """Scores poses of the prior's tilt against the query at one working size (paper equation 2: IoU)."""

    def __init__(self, query: Query, city_map: CityMap, size: tuple[int, int], fit: str = "iou") -> None:
        self.camera: Camera = query.camera.scaled(*size)
        self.fit = make_fit(fit, query, size)
        self.pitch_deg, self.roll_deg, _ = query.prior.euler
        self._city_map = city_map

    def __call__(self, centers: Floats, yaws_deg: Floats) -> Particles:
        """Returns the poses with their scores."""
        rotations = rotations_at_yaws(self.pitch_deg, self.roll_deg, yaws_deg)
        scores = self._city_map.fit(self.camera, rotations, centers, self.fit)
        return Particles(centers, yaws_deg, scores)


# A search looks so many of the prior's stated standard deviations to either side.
REACH = 3.0


def set_sizes(params: object, names: Iterable[str], least_px: int = 1) -> None:
    """Makes pairs of whole numbers of some settings of a frozen dataclass: widths and heights, pixels.

    OmegaConf hands over lists where a tuple is declared, and checks neither lengths nor ranges.

    Raises:
        ConfigError: One is no pair, or a side is out of what can be drawn.
    """
    for name in names:
        size = tuple(int(side) for side in getattr(params, name))
        if len(size) != 2 or min(size) < least_px or max(size) > GUARD_PX:
            sides = f"{least_px} to {GUARD_PX} px"
            raise ConfigError(f"method.{name} is a width and a height, {sides}, not {list(size)}.")
        object.__setattr__(params, name, size)


class SearchRange:
    """What parameters with full widths of the prior's error have in common; metres and degrees."""

    __slots__ = ()
    range_x_m: float
    range_y_m: float
    range_z_m: float
    range_yaw_deg: float
    range_tilt_deg: float

    def for_prior(self, prior: UniformPrior) -> Self:
        """Returns these parameters for a prior's error of other half widths."""
        ranges: dict[str, Any] = ranges_of(prior) | {"range_tilt_deg": prior.pitch_deg + prior.roll_deg}
        return replace(self, **ranges)  # type: ignore[type-var]

    def over_measured(self, measured: Measurements | None) -> Self:
        """Returns these parameters with ranges as wide as stated deviations of a photo's prior say.

        Eq. (M8) of docs/methods/index.md.
        """
        if measured is None:
            return self
        x, y, z, pitch, roll, yaw = measured.sigmas
        names = ("range_x_m", "range_y_m", "range_z_m", "range_yaw_deg")
        widths = {
            name: 2.0 * REACH * s for name, s in zip(names, (x, y, z, yaw), strict=True) if s is not None
        }
        if "range_yaw_deg" in widths:
            widths["range_yaw_deg"] = min(widths["range_yaw_deg"], 360.0)
        if pitch is not None or roll is not None:
            halves = [0.5 * self.range_tilt_deg if s is None else REACH * s for s in (pitch, roll)]
            widths["range_tilt_deg"] = 2.0 * max(halves)
        return replace(self, **widths) if widths else self  # type: ignore[type-var]

    def half_widths(self) -> tuple[float, ...]:
        """Returns the half widths of x, y, z, pitch, roll and yaw; at least 1 mm and 0.0001 degrees."""
        place = (self.range_x_m, self.range_y_m, self.range_z_m)
        turn = (self.range_tilt_deg, self.range_tilt_deg, self.range_yaw_deg)
        return (*(max(0.5 * w, 1e-3) for w in place), *(max(0.5 * w, 1e-4) for w in turn))

    def reach(self) -> tuple[float, float]:
        """Returns how far from the prior the camera may be, metres, and how far turned, degrees.

        Full widths, where half would do: steps may lead out of the range, though the prior calls back.
        """
        reach_m = math.hypot(self.range_x_m, self.range_y_m, self.range_z_m)
        return reach_m, self.range_yaw_deg + 2.0 * self.range_tilt_deg


def ranges_of(prior: UniformPrior) -> dict[str, Any]:
    """Returns the full widths of all that a prior leaves open, metres and degrees, as settings call them."""
    return {
        "range_x_m": 2.0 * prior.x_m,
        "range_y_m": 2.0 * prior.y_m,
        "range_z_m": 2.0 * prior.z_m,
        "range_yaw_deg": 2.0 * prior.yaw_deg,
    }
