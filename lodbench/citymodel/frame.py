"""From the coordinates of a file to metres, east and north: axis order, plausibility, projection.

The declared axis order counts, and so does where the coordinates would lie: many files store east
first whatever their reference system says. What is decided against the declaration is a finding.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel import codes
from lodbench.citymodel.crs import (
    KnownCrs,
    is_geocentric,
    is_true_to_scale,
    metric_crs,
    require_crs,
    resolve_crs,
)
from lodbench.citymodel.options import AxisOrder
from lodbench.errors import CityModelError
from lodbench.findings import Findings

if TYPE_CHECKING:
    from pyproj import Transformer

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
            findings.add(codes.AXES_AMBIGUOUS, "", f"{known.label}: taken as {taken}; say axis_order")
    if stated == is_declared_north_first:
        return declared
    if stated is not None:
        findings.add(codes.AXES_SWAPPED, "", f"{known.label}: {'north' if stated else 'east'} first")
        return swapped
    if not declared.is_plausible:
        where = f"({middle[0]:.6g}, {middle[1]:.6g})"
        findings.add(
            codes.CRS_IMPLAUSIBLE, "", f"{known.label}: the middle {where} lies outside its area of use"
        )
        # Files of projected systems store east first more often than not.
        return swapped if known.horizontal.is_projected and is_declared_north_first else declared
    # Meshes name no system, and have x to the east: latitudes first are those of files that say so.
    if is_declared_north_first and (known.horizontal.is_projected or srs_name is None):
        findings.add(
            codes.AXES_AMBIGUOUS, "", f"{known.label} declares north first; taken as east first, as is usual"
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


def require_true_to_scale(target: KnownCrs, middle: NDArray[np.float64], findings: Findings) -> None:
    """Makes sure that a system can be measured in where a city, (east, north), is brought to.

    What is off by more than a thousandth is reported, as is a place outside of the system's area.

    Raises:
        CityModelError: Its metres are off by more than a hundredth.
    """
    place = try_order(middle, target, is_north_first=False)
    if not place.is_plausible:
        findings.add(codes.CRS_IMPLAUSIBLE, "", f"{target.label}: the city lies outside its area of use")
    if not is_true_to_scale(target, middle, findings):
        better = metric_crs(target, place.longitude_deg, place.latitude_deg)
        raise CityModelError(
            f"A metre of {target.label} is off by more than a hundredth at the city.",
            f"Name a system that is made for the place, such as {better}.",
        )


# Points moved or projected at a time: pyproj copies what it is given.
_CHUNK_POINTS = 1 << 16
# Where a city lies is decided by the median of at most twice so many points, evenly spread over the file.
_SAMPLE_POINTS = 1 << 15
# Nobody's city is wider, whatever the outermost points are, in percent.
_WIDEST_DEG, _WITHOUT_STRAYS = 60.0, (1.0, 99.0)


def to_metres(
    points: NDArray[np.float64],
    srs_name: str | None,
    override: str | None,
    findings: Findings,
    axis_order: AxisOrder = "auto",
    tells_north_first: Callable[[int], bool | None] = lambda least: None,
) -> str | None:
    """Brings points, in place, to east, north, up in metres; returns the label of their reference system.

    Args:
        points: (P, 3) float64 with the columns of the file, changed in place.
        srs_name: What the file declares, or None.
        override: What the user says instead, or None.
        findings: Receives every decision that the declaration alone does not settle.
        axis_order: What is known of the order of the columns.
        tells_north_first: Called with the least number of buildings, where both orders are plausible, whether
            northings stand first; None for no answer.

    Returns:
        A name pyproj understands, or None where the system is unknown.

    Raises:
        CityModelError: ``override`` is unknown, or the coordinates are degrees of an unknown system, or
            geocentric.
    """
    known = _settle_crs(points, srs_name, override, findings)
    if known is None:
        _check_without_crs(points, srs_name, findings)
        return None
    if len(points) == 0:
        return known.label
    _strip_zone_prefix(points, known, findings)
    _require_degrees(points, known)
    # PROJ takes southings before westings, as declared; which is which, only the place on Earth tells.
    is_south_first = declares_south_and_west(known)
    if axis_order == "auto" or is_south_first:
        order = settle_order(_middle(points), known, srs_name, findings, tells_north_first)
    else:
        order = try_order(_middle(points), known, axis_order == "north_first")
        if not order.is_plausible:
            findings.add(codes.CRS_IMPLAUSIBLE, "", f"{known.label}, {axis_order}")
    if order.is_north_first != is_south_first:
        for n in range(0, len(points), _CHUNK_POINTS):
            points[n : n + _CHUNK_POINTS, :2] = points[n : n + _CHUNK_POINTS, 1::-1].copy()
    if known.has_ellipsoidal_heights:
        findings.add(codes.HEIGHTS_ELLIPSOIDAL, "", known.label)
    # Where the coordinates lie outside of the system, nobody knows what its metres are; UTM is 4e-4 short
    # in its middle and 1e-3 long at its rim.
    is_settled = not order.is_plausible or known.horizontal.utm_zone is not None
    if known.is_metric and (is_settled or is_true_to_scale(known, _middle(points), findings)):
        points[:, 2] *= known.vertical_to_m
        return known.metric_label
    return _project(points, known, order, findings)


def _settle_crs(
    points: NDArray[np.float64], srs_name: str | None, override: str | None, findings: Findings
) -> KnownCrs | None:
    """Returns the reference system that counts, or None where none is known."""
    known = require_crs(override) if override is not None else None
    if known is None and srs_name is not None:
        known = resolve_crs(srs_name)
    if known is None:
        return None
    if known.is_mapped and known.label.startswith("EPSG:21781") and _middle(points)[0] > 2e6:
        known = require_crs(known.label.replace("21781", "2056"))  # "CH1903" on LV95 coordinates
    if known.is_mapped or known.label.startswith("EPSG:2056+"):
        why = f"; {known.lost}" if known.lost else ""
        findings.add(codes.CRS_MAPPED, "", f"{override or srs_name} read as {known.label}{why}")
    return known


def _middle(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the median of the first two columns, (2,), NaN without points."""
    if len(points) == 0:
        return np.full(2, np.nan)
    middle: NDArray[np.float64] = np.median(points[:: 1 + len(points) // (2 * _SAMPLE_POINTS), :2], axis=0)
    return middle


def _check_without_crs(points: NDArray[np.float64], srs_name: str | None, findings: Findings) -> None:
    if srs_name is None:
        findings.add(codes.CRS_MISSING, "", "")
    elif is_geocentric(srs_name):
        raise CityModelError(
            f"{srs_name} is geocentric: its metres go from the middle of the Earth, not east and north.",
            "Convert the file to a projected system first, or to EPSG:4979.",
        )
    else:
        findings.add(codes.CRS_UNKNOWN, "", srs_name)
    require_no_degrees(points)


def require_no_degrees(points: NDArray[np.float64]) -> None:
    """Makes sure that (P, 3) points without a reference system do not look like degrees.

    Raises:
        CityModelError: They do.
    """
    if len(points):
        low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        # A town in degrees: small numbers, a tiny extent, and not around the origin.
        is_degrees = np.all(np.maximum(high, -low) <= 180.0) and np.all(high - low < 1.0)
        if is_degrees and np.abs(low).max() > 5.0:
            raise CityModelError(
                "The coordinates look like degrees, but the file names no reference system that is known.",
                "Name it with `crs=EPSG:4979`, for example.",
            )


def _strip_zone_prefix(points: NDArray[np.float64], known: KnownCrs, findings: Findings) -> None:
    """Removes the zone number that some German deliveries write before the easting (32 512 345)."""
    # pyproj gives "32N", or "32N WITH PREFIX" where the false easting has the zone in it (EPSG:4647).
    zone = re.match(r"(\d+)[NS](.*)", known.horizontal.utm_zone or "")
    if zone is None:
        return
    prefix = float(zone[1]) * 1e6
    middle = _middle(points)
    if zone[2]:
        # Northings reach 1e7, so both columns below the prefix means that it was left out.
        if middle.max() < prefix:
            axes = [axis.direction.lower() for axis in known.horizontal.axis_info[:2]]
            # Of an easting and a northing the easting is the smaller one.
            column = int(np.argmin(middle)) if middle.max() > 1e6 else axes.index("east")
            findings.add(
                codes.CRS_MAPPED, "", f"the eastings lack the zone number {zone[1]}; it is put before them"
            )
            points[:, column] += prefix
        return
    column = int(np.argmax(middle))
    # The northing of Anchorage begins with the number of its zone, too.
    is_placed = any(try_order(middle, known, is_north).is_plausible for is_north in (False, True))
    if not is_placed and prefix <= middle[column] < prefix + 1e6:
        findings.add(
            codes.CRS_MAPPED, "", f"the eastings begin with the zone number {zone[1]}; it is removed"
        )
        points[:, column] -= prefix


def _require_degrees(points: NDArray[np.float64], known: KnownCrs) -> None:
    """Makes sure that what is called degrees can be: a country at most, and somewhere on Earth."""
    if known.horizontal.is_geographic:
        columns = (points[:, 0], points[:, 1])
        if (
            max(np.ptp(column) for column in columns) <= _WIDEST_DEG
            and max(float(np.maximum(column.max(), -column.min())) for column in columns) <= 360.0
        ):  # even with strays
            return
        low, high = np.percentile(points[:, :2], _WITHOUT_STRAYS, axis=0)
        # What lies on both sides of 180 degrees is as wide as the Earth.
        is_too_wide = _WIDEST_DEG < (high - low).max() < 360.0 - _WIDEST_DEG
        if max(high.max(), -low.min()) > 360.0 or is_too_wide:
            raise CityModelError(
                f"The coordinates are no degrees, although {known.label} says so.",
                "Name the right reference system with `crs=EPSG:...`",
            )


@lru_cache(maxsize=16)
def _transformer(source: str, target: str) -> Transformer:
    """Returns what brings easting and northing from one system to another; tiles share theirs."""
    from pyproj import Transformer

    return Transformer.from_crs(
        require_crs(source).horizontal, require_crs(target).horizontal, always_xy=True
    )


def _project(points: NDArray[np.float64], known: KnownCrs, order: Order, findings: Findings) -> str:
    """Projects degrees, feet or westings, in place, to a metric system around the middle of the data."""
    if not np.isfinite([order.longitude_deg, order.latitude_deg]).all():
        raise CityModelError(
            f"The coordinates lie nowhere in {known.label}.",
            "Is the reference system right? `crs=` names another.",
        )
    label = metric_crs(known, order.longitude_deg, order.latitude_deg)
    transformer = _transformer(known.label, label)
    for n in range(0, len(points), _CHUNK_POINTS):
        part = points[n : n + _CHUNK_POINTS]
        part[:, 0], part[:, 1] = transformer.transform(part[:, 0], part[:, 1])
    if not np.isfinite(points[:, :2]).all():
        raise CityModelError(
            f"Some coordinates cannot be projected from {known.label} to {label}.",
            "Is the reference system right? `crs=` names another.",
        )
    detail = f"from {known.label} to {label}"
    if known.vertical_code is None and known.height_unit_m != 1.0:
        detail += ", heights taken in the unit of the plane"
    findings.add(codes.CRS_PROJECTED, "", detail)
    points[:, 2] *= known.height_unit_m
    return label


def brought_note(label: str, target: str) -> str:
    """Returns what is stated of a city that is brought from one reference system to another: heights stay.

    Example:
        >>> brought_note("EPSG:25832+7837", "EPSG:25833+5783")
        'EPSG:25832+7837 brought to EPSG:25833+5783; its heights stay as they are'
    """
    vertical = {require_crs(each).metric_vertical_code for each in (label, target)}
    return f"{label} brought to {target}" + ("; its heights stay as they are" if len(vertical) > 1 else "")


def bring_to(points: NDArray[np.float64], label: str, target: str) -> None:
    """Brings points from one metric system to another, in place; heights stay."""
    if require_crs(label).horizontal != require_crs(target).horizontal:
        transformer = _transformer(label, target)
        points[:, 0], points[:, 1] = transformer.transform(points[:, 0], points[:, 1])
