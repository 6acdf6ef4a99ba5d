"""Which of the first two columns of a city is the easting, and where on Earth each order puts it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import AXES_AMBIGUOUS, AXES_SWAPPED, CRS_IMPLAUSIBLE, SCALE_OFF
from lodbench.citymodel.crs import KnownCrs, metric_crs
from lodbench.citymodel.lods import select_polygons
from lodbench.citymodel.model import Polygons
from lodbench.citymodel.triangulate import newell
from lodbench.errors import CityModelError
from lodbench.findings import Findings

# Areas of use are bounding boxes of countries and zones; tiles at their rim reach a little out.
_AREA_MARGIN_DEG = 0.5
# No town lies further south or north; it tells latitudes from longitudes where the area is the world.
_INHABITED_LATITUDES_DEG = (-56.0, 80.0)

# So many houses are hardly all inside out, and overrule a name that promises the order of its authority.
_MANY_BUILDINGS = 10


@dataclass(frozen=True, slots=True)
class Order:
    """One reading of the first two columns, and whether it puts the data where it should be."""

    is_north_first: bool
    is_plausible: bool
    longitude_deg: float
    latitude_deg: float


def settle_order(
    middle: NDArray[np.float64],
    known: KnownCrs,
    srs_name: str | None,
    findings: Findings,
    tells_north_first: Callable[[int], bool | None],
) -> Order:
    """Returns how to read the first two columns.

    Args:
        middle: (2,) of the data.
        known: Their reference system.
        srs_name: Under which the file itself names it, or None.
        findings: Receives what is decided against the declaration, or not at all.
        tells_north_first: Called with the least number of buildings, where both orders are plausible; None
            for no answer.
    """
    axes = [axis.direction.lower() for axis in known.horizontal.axis_info[:2]]
    is_declared_north_first = axes[0].startswith("north") or axes[0] == "south"
    declared = try_order(middle, known, is_declared_north_first)
    swapped = try_order(middle, known, not is_declared_north_first)
    stated = None
    if declared.is_plausible != swapped.is_plausible:
        stated = declared.is_north_first if declared.is_plausible else swapped.is_north_first
    elif declared.is_plausible and is_declared_north_first:
        stated = tells_north_first(1)
        if stated is False and srs_name is not None and _promises_order(srs_name):
            stated = tells_north_first(_MANY_BUILDINGS) is not False
            taken = (
                "north first, as declared, though walls face inwards"
                if stated
                else "east first, as walls show"
            )
            findings.add(AXES_AMBIGUOUS, "", f"{known.label}: taken as {taken}; say axis_order")
    if stated == is_declared_north_first:
        return declared
    if stated is not None:
        findings.add(AXES_SWAPPED, "", f"{known.label}: {'north' if stated else 'east'} first")
        return swapped
    if not declared.is_plausible:
        where = f"({middle[0]:.6g}, {middle[1]:.6g})"
        findings.add(CRS_IMPLAUSIBLE, "", f"{known.label}: the middle {where} lies outside its area of use")
        # Files of projected systems store east first more often than not.
        return swapped if known.horizontal.is_projected and is_declared_north_first else declared
    # Meshes name no system, and have x to the east: latitudes first are those of files that say so.
    if is_declared_north_first and (known.horizontal.is_projected or srs_name is None):
        findings.add(
            AXES_AMBIGUOUS, "", f"{known.label} declares north first; taken as east first, as is usual"
        )
        return swapped
    return declared


def _promises_order(srs_name: str) -> bool:
    """Tells whether a name is OGC's URN or URI; of others (``EPSG:4979``, ``epsg.xml#4979``) nobody knows."""
    return "urn:ogc:def:crs" in srs_name.lower() or "opengis.net/def/crs" in srs_name.lower()


def declares_south_and_west(known: KnownCrs) -> bool:
    """Returns whether a system has southings before westings."""
    return known.counts_west and known.horizontal.axis_info[0].direction.lower() == "south"


def try_order(middle: NDArray[np.float64], known: KnownCrs, is_north_first: bool) -> Order:
    """Returns where on Earth one order puts the middle of the data, (2,), and whether that may be."""
    is_swapped = is_north_first != declares_south_and_west(known)
    east, north = (middle[1], middle[0]) if is_swapped else (middle[0], middle[1])
    longitude, latitude = float(east), float(north)
    if known.horizontal.is_projected:
        from pyproj import Proj

        longitude, latitude = Proj(known.horizontal)(east, north, inverse=True)
    area = known.horizontal.area_of_use
    low, high = _INHABITED_LATITUDES_DEG
    is_plausible = bool(np.isfinite(longitude) and np.isfinite(latitude)) and low <= latitude <= high
    is_plausible = is_plausible and -180.0 <= longitude <= 180.0
    if area is not None and is_plausible:
        is_plausible = (
            area.south - _AREA_MARGIN_DEG <= latitude <= area.north + _AREA_MARGIN_DEG
            and _longitude_within(longitude, area.west, area.east)
        )
    return Order(is_north_first, is_plausible, longitude, latitude)


def _longitude_within(longitude_deg: float, west_deg: float, east_deg: float) -> bool:
    width = (east_deg - west_deg) % 360.0 or 360.0
    return (longitude_deg - west_deg + _AREA_MARGIN_DEG) % 360.0 <= width + 2 * _AREA_MARGIN_DEG


# So many buildings are enough to decide.
_SAMPLE_BUILDINGS = 4096
# A wall covers less of the square around it in plan. Roofs and footprints are drawn this way and that.
_WALL_SHARE = 0.1
# Of walls that all look outside each adds to the area of the plan; of walls drawn at random they cancel out.
_LEAST_SHARE = 0.5
# So many of the buildings with a result must agree.
_LEAST_AGREEING = 0.9


def faces_tell_north_first(polygons: Polygons, least_buildings: int = 1) -> bool | None:
    """Returns whether northings stand first: exchanged columns mirror houses, whose walls then look inside.

    Args:
        polygons: In the coordinates of the file.
        least_buildings: So many must have a result.

    Returns:
        None where walls do not decide: footprints have none, some publishers draw them at random.
    """
    step = 1 + int(polygons.building.max(initial=0)) // _SAMPLE_BUILDINGS
    chosen = select_polygons(polygons, np.flatnonzero(polygons.building % step == 0))
    if len(chosen) == 0:
        return None
    vectors, _ = newell(chosen)
    first = chosen.ring_starts[chosen.polygon_starts[:-1]]
    plan = chosen.points[:, :2]
    sides = np.maximum.reduceat(plan, first) - np.minimum.reduceat(plan, first)
    is_wall = np.abs(vectors[:, 2]) < _WALL_SHARE * (sides**2).sum(axis=1)
    _, building = np.unique(chosen.building, return_inverse=True)
    counts = np.bincount(building)
    middles = np.stack([np.bincount(building, plan[first, k]) / counts for k in (0, 1)], axis=1)
    areas = is_wall * ((plan[first] - middles[building]) * vectors[:, :2]).sum(axis=1)
    total, largest = np.bincount(building, areas), np.bincount(building, np.abs(areas))
    is_outside, is_inside = total > _LEAST_SHARE * largest, total < -_LEAST_SHARE * largest
    if is_inside.sum() + is_outside.sum() < least_buildings:
        return None
    share = is_inside.sum() / max(is_inside.sum() + is_outside.sum(), 1)
    if share >= _LEAST_AGREEING:
        return True
    return False if is_outside.any() and share <= 1.0 - _LEAST_AGREEING else None


_MAX_SCALE_ERROR = 1e-3
_MAX_KEPT_SCALE_ERROR = 1e-2


def is_true_to_scale(known: KnownCrs, middle: NDArray[np.float64], findings: Findings) -> bool:
    """Returns whether the metres of a system are metres at a place (east, north), to a hundredth.

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

    What is off by more than a thousandth is reported, as is a place outside of the system's area.

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
