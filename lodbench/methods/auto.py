"""``method=auto``: a pose from the photo's own pixels; where they leave it open, from a mask as well.

It is what ``lodbench localize`` does with a single photo.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from lodbench.citymap import CityMap
from lodbench.datasets.inputs import Input
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Query
from lodbench.errors import QueryFault, require_numbers
from lodbench.estimation.state_vector import TRUSTED
from lodbench.geometry import Pose
from lodbench.methods.assessment import assessed
from lodbench.methods.contour_alignment import ContourAlignment, ContourAlignmentParams
from lodbench.methods.fits import SearchRange
from lodbench.methods.protocol import Estimate, Streams
from lodbench.methods.region import Region, RegionParams

# Two answers within 2 m and 2 degrees of the truth are no farther from each other than this.
_TOGETHER_M, _TOGETHER_DEG = 4.0, 4.0
# What a mask's probability is worth where the pixels say another place (docs/adr/0013, point 4).
_ALONE = 0.5


_RANGES = ("range_x_m", "range_y_m", "range_z_m", "range_yaw_deg", "range_tilt_deg")


@dataclass(frozen=True, slots=True)
class AutoParams(SearchRange):
    """What both methods search; all else is at the defaults of ``region`` and ``contour_alignment``.

    Attributes:
        name: Name to report.
        range_x_m: Full width of the search east and west of the prior, metres.
        range_y_m: The same north and south.
        range_z_m: The same up and down.
        range_yaw_deg: The same in heading, degrees.
        range_tilt_deg: The same in pitch and roll; 0 holds them at the prior's.
    """

    name: str = "auto"
    range_x_m: float = 20.0
    range_y_m: float = 20.0
    range_z_m: float = 60.0
    range_yaw_deg: float = 15.0
    range_tilt_deg: float = 2.0

    def __post_init__(self) -> None:
        require_numbers(self, "method", _RANGES, 0)

    def by_pixels(self) -> RegionParams:
        """Returns the parameters of ``region``."""
        return replace(RegionParams(), **self._ranges())

    def by_mask(self) -> ContourAlignmentParams:
        """Returns the parameters of ``contour_alignment``."""
        return replace(ContourAlignmentParams(), **self._ranges())

    def _ranges(self) -> dict[str, Any]:
        return {name: value for name, value in asdict(self).items() if name in _RANGES}


class Auto:
    """Takes ``region``'s answer; where it is not to be trusted, the more probable of it and one by a mask."""

    params_type = AutoParams
    name = "auto"
    requires = frozenset({Input.IMAGE, Input.MASK_ON_DEMAND})

    def __init__(self, params: AutoParams | None = None) -> None:
        self.params = params or AutoParams()
        self._by_pixels = Region(self.params.by_pixels())
        self._by_mask = ContourAlignment(self.params.by_mask())

    def params_for_prior(self, prior: UniformPrior) -> AutoParams:
        """Returns the parameters that search all that such a prior leaves open, tilt included."""
        return self.params.for_prior(prior)

    def params_for_true_tilt(self) -> AutoParams:
        """Returns the parameters for priors of the true pitch and roll: a range of 0 holds them."""
        return replace(self.params, range_tilt_deg=0.0)

    def localize(self, query: Query, city_map: CityMap, streams: Streams) -> Estimate:
        """Returns the more probable of two answers; the mask is made only where the pixels' is doubtful.

        The answer is assessed already, as the two had to be compared.

        Raises:
            QueryFault: There is no photo, it cannot be decoded, or it fits no view of the map.
            ConfigError: The segmenter's weights are missing or no network.
        """
        estimate = self._by_pixels.localize(query, city_map, streams)
        by_pixels = assessed(estimate, query, city_map, self._by_pixels.params)
        if query.segment is None or (by_pixels.probability or 0.0) >= TRUSTED:
            return by_pixels
        try:
            query = replace(query, building_probability=query.segment(query.prior))
            estimate = self._by_mask.localize(query, city_map, streams)
        except QueryFault as fault:
            note = f"a mask was tried as well, without result: {fault.message.rstrip('.')}"
            return replace(by_pixels, notes=(*by_pixels.notes, note))
        by_mask = assessed(estimate, query, city_map, self._by_mask.params)
        return fuse_estimates(by_pixels, replace(by_mask, mask=query.building_probability))


def fuse_estimates(by_pixels: Estimate, by_mask: Estimate) -> Estimate:
    """Returns the answer by pixels, or the one by a mask where that is more probable, with a note.

    Both are assessed, in the scene's frame. Where the two lie apart, the mask's probability counts half
    (docs/adr/0013, point 4), and the pose by pixels is the first of the alternatives. Stages of the mask's
    are named ``mask: STAGE``.
    """
    weight = 1.0 if _are_together(by_pixels.pose, by_mask.pose) else _ALONE
    own, probability = by_pixels.probability or 0.0, (by_mask.probability or 0.0) * weight
    seconds = by_pixels.seconds | {f"mask: {stage}": s for stage, s in by_mask.seconds.items()}
    if probability <= own:
        return replace(by_pixels, seconds=seconds)
    note = (
        "this pose is from a segmenter's mask (method contour_alignment); the pose from the photo's own "
        f"pixels had a probability of {100.0 * own:.0f} %"
    )
    return replace(
        by_mask,
        probability=probability,
        notes=(*by_mask.notes, note),
        alternatives=(by_pixels.pose, *by_mask.alternatives),
        alternative_probabilities=(own, *by_mask.alternative_probabilities),
        seconds=seconds,
    )


def _are_together(first: Pose, second: Pose) -> bool:
    cosine = 0.5 * (np.trace(first.rotation.T @ second.rotation) - 1.0)
    apart_deg = np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return bool(np.linalg.norm(first.center - second.center) <= _TOGETHER_M and apart_deg <= _TOGETHER_DEG)
