"""Are the metres of a projected system metres where the data lies?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.axis_order import try_order
from lodbench.citymodel.codes import CRS_IMPLAUSIBLE, SCALE_OFF
from lodbench.citymodel.crs import KnownCrs, metric_crs
from lodbench.errors import CityModelError
from lodbench.findings import Findings

_MAX_SCALE_ERROR = 1e-3
_MAX_KEPT_SCALE_ERROR = 1e-2


def is_true_to_scale(known: KnownCrs, middle: NDArray[np.float64], findings: Findings) -> bool:
    """Tells whether the metres of a system are metres at a place (east, north), to a hundredth.

    What is off by more than a thousandth is told, and what is off by a hundredth, as Mercator of the whole
    world is, does for no measuring: it is projected anew.
    """
    scales = _scales(known, middle)
    worst = max(abs(scale - 1.0) for scale in scales)
    if not worst > _MAX_SCALE_ERROR:
        return True
    factors = f"a metre to the east is {scales[0]:.4f} m there, to the north {scales[1]:.4f} m"
    is_kept = worst <= _MAX_KEPT_SCALE_ERROR
    findings.add(SCALE_OFF, "", f"{known.label}: {factors}{'' if is_kept else '; projected anew'}")
    return is_kept


def require_true_to_scale(target: KnownCrs, middle: NDArray[np.float64], findings: Findings) -> None:
    """Makes sure that a system can be measured in where a city, (east, north), is brought to.

    What is off by more than a thousandth is told, as is a place outside of the system's area.

    Raises:
        CityModelError: Its metres are off by more than a hundredth.
    """
    place = try_order(middle, target, is_north_first=False)
    if not place.is_plausible:
        findings.add(CRS_IMPLAUSIBLE, "", f"{target.label}: the city lies outside its area of use")
    if not is_true_to_scale(target, middle, findings):
        better = metric_crs(target, place.longitude_deg, place.latitude_deg)
        raise CityModelError(
            f"A metre of {target.label} is off by more than a hundredth at the city.",
            f"Name a system that is made for the place, such as {better}.",
        )


def _scales(known: KnownCrs, middle: NDArray[np.float64]) -> tuple[float, float]:
    """Returns how long a metre on the ground is in a projected system, along x and y; NaN outside of it."""
    from pyproj import Proj

    geod, step_m = known.horizontal.get_geod(), 50.0
    if geod is None:
        return 1.0, 1.0
    x, y = middle
    ends = ((x - step_m, y), (x + step_m, y)), ((x, y - step_m), (x, y + step_m))
    project, lengths = Proj(known.horizontal), []
    for first, last in ends:
        degrees = *project(*first, inverse=True), *project(*last, inverse=True)
        lengths.append(geod.inv(*degrees)[2] if np.isfinite(degrees).all() else np.nan)
    return 2 * step_m / lengths[0], 2 * step_m / lengths[1]
