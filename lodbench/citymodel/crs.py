"""Names of coordinate reference systems, as city models write them, to what pyproj knows.

pyproj reads most names; the map here adds what it cannot read (the URNs of the German surveys) or
reads otherwise than meant (``CH1903`` on projected Swiss coordinates).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import SCALE_OFF
from lodbench.errors import CityModelError
from lodbench.findings import Findings

if TYPE_CHECKING:
    from pyproj import CRS

_ADV_HORIZONTAL = {
    "ETRS89_UTM31": 25831,
    "ETRS89_UTM32": 25832,
    "ETRS89_UTM33": 25833,
    "DE_DHDN_3GK2": 31466,
    "DE_DHDN_3GK3": 31467,
    "DE_DHDN_3GK4": 31468,
    "DE_DHDN_3GK5": 31469,
    "DE_42-83_3GK4": 2398,
    "DE_42-83_3GK5": 2399,
}
_ADV_VERTICAL = {
    "DE_DHHN2016_NH": 7837,
    "DE_DHHN92_NH": 5783,
    "DE_DHHN85_NOH": 5784,
    "DE_DHHN12_NOH": 7699,
    "DE_DHN92_NH": 5783,  # a misspelling found in deliveries
    "DE_HN76_NH": 5785,
    "DE_SNN76_NH": 5785,
}
_SWISS = {
    "CH1903": "EPSG:21781+5728",
    "CH1903/LV03": "EPSG:21781+5728",
    "LV03": "EPSG:21781+5728",
    "CH1903+": "EPSG:2056+5728",
    "CH1903+/LV95": "EPSG:2056+5728",
    "LV95": "EPSG:2056+5728",
}
# Heights in feet, and the same above the same zero in metres, which is what they are once they are read.
_HEIGHTS_IN_METRES = {6360: 5703, 8228: 5703, 5702: 7968, 5754: 7962, 8050: 5714, 8052: 5714}
# EPSG:25832, urn:ogc:def:crs:EPSG::7415, urn:...crs:EPSG:6.12:25833, .../def/crs/EPSG/0/6697,
# .../gml/srs/epsg.xml#4326
_EPSG_CODE = re.compile(r"EPSG(?:/[\w.]+/|:[\w.]*:|:|\.xml#)(\d{4,6})(?!\d)", re.IGNORECASE)
_COMPOUND_EPSG = re.compile(r".*EPSG(?:/[\w.]+/|:[\w.]*:|:)(\d{4,6})[+,](\d{4,6})", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class KnownCrs:
    """A reference system taken apart."""

    label: str  # name pyproj understands, vertical part included: ``"EPSG:25832+7837"``
    horizontal: CRS  # the two-dimensional part
    vertical_code: int | None  # EPSG code of the vertical part, or None
    vertical_to_m: float  # metres per unit of height
    is_mapped: bool  # whether lodbench's own map was needed to read the name
    # Whether it is a system of three dimensions (EPSG:4979), whose heights are above the ellipsoid
    has_ellipsoidal_heights: bool = False
    # What of the name is no reference system, such as the code of a datum; "" where all of it is
    lost: str = ""

    @property
    def counts_west(self) -> bool:
        """Whether coordinates grow to the west and south (Krovak, South Africa's Lo): no frame of a city."""
        return any(axis.direction.lower() == "west" for axis in self.horizontal.axis_info[:2])

    @property
    def is_metric(self) -> bool:
        """Whether coordinates are metres to the east and north."""
        unit = self.horizontal.axis_info[0].unit_conversion_factor
        return bool(self.horizontal.is_projected) and unit == 1.0 and not self.counts_west

    @property
    def height_unit_m(self) -> float:
        """Metres per unit of height: its own, or that of the plane where heights have no system."""
        if self.vertical_code is None and self.horizontal.is_projected:
            return float(self.horizontal.axis_info[0].unit_conversion_factor)
        return self.vertical_to_m

    @property
    def metric_vertical_code(self) -> int | None:
        """EPSG code of the heights once they are in metres, or None where that has none."""
        if self.vertical_code is None or self.vertical_to_m == 1.0:
            return self.vertical_code
        return _HEIGHTS_IN_METRES.get(self.vertical_code)

    @property
    def metric_label(self) -> str:
        """The label once heights are in metres; without a vertical part where those have no code.

        Example:
            >>> require_crs("EPSG:26918+6360").metric_label
            'EPSG:26918+5703'
        """
        if self.vertical_code == self.metric_vertical_code:
            return self.label
        plane = self.horizontal.to_epsg()
        if plane is None:
            return str(self.horizontal.to_wkt())
        return f"EPSG:{plane}" + (f"+{self.metric_vertical_code}" if self.metric_vertical_code else "")


def crs_label(name: str) -> tuple[str, bool]:
    """Returns the name to ask pyproj for, and whether lodbench's own map was needed.

    Example:
        >>> crs_label("urn:adv:crs:ETRS89_UTM32*DE_DHHN2016_NH*GCG2016")
        ('EPSG:25832+7837', True)
        >>> crs_label("http://www.opengis.net/def/crs/EPSG/0/6697")
        ('EPSG:6697', False)
    """
    text = name.strip()
    swiss = _SWISS.get(re.sub(r"[\s_]+", "", text).upper().replace("CH1903+LV", "CH1903+/LV"))
    if swiss is not None:
        return swiss, True
    if text.lower().startswith("urn:adv:crs:"):
        parts = text[len("urn:adv:crs:") :].split("*")
        codes = [_ADV_HORIZONTAL.get(part) or _ADV_VERTICAL.get(part) for part in parts]
        known = [str(code) for code in codes if code is not None]
        if known and parts[0] in _ADV_HORIZONTAL:
            return "EPSG:" + "+".join(known[:2]), True
        return text, False
    compound = _COMPOUND_EPSG.fullmatch(text)
    numbers = list(compound.groups()) if compound else _EPSG_CODE.findall(text)
    if numbers:
        return "EPSG:" + "+".join(numbers[:2]), False
    return text, False


@lru_cache(maxsize=64)
def resolve_crs(name: str) -> KnownCrs | None:
    """Returns the reference system a name stands for, or None when nobody knows it."""
    from pyproj import CRS, Proj
    from pyproj.exceptions import CRSError

    label, is_mapped = crs_label(name)
    lost = ""
    try:
        crs = CRS.from_user_input(label)
    except (CRSError, ValueError):
        label, lost = _plane_of(label)
        if not lost:
            return None
        crs, is_mapped = CRS.from_user_input(label), True
    if not label.startswith("EPSG:") and crs.to_epsg() is not None:
        label = f"EPSG:{crs.to_epsg()}"  # WKT, PROJJSON and the like have a short name, too
    vertical_code, vertical_to_m = None, 1.0
    horizontal = crs
    for part in crs.sub_crs_list:
        if part.is_vertical:
            vertical_code, vertical_to_m = part.to_epsg(), part.axis_info[0].unit_conversion_factor
        elif part.is_geographic or part.is_projected:
            horizontal = part
    is_solid = not crs.sub_crs_list and len(crs.axis_info) == 3
    if is_solid:
        horizontal = crs.to_2d()
        vertical_to_m = crs.axis_info[2].unit_conversion_factor
    if not (horizontal.is_geographic or horizontal.is_projected):
        return None
    try:
        Proj(horizontal)
    except CRSError:  # WKT may state a projection that PROJ has not
        return None
    return KnownCrs(label, horizontal, vertical_code, vertical_to_m, is_mapped, is_solid, lost)


def _plane_of(label: str) -> tuple[str, str]:
    """Returns the plane's system of a name of two codes that make none together, and what the other is not.

    Both are "" where neither is the system of a plane.
    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    codes = label.removeprefix("EPSG:").split("+")
    for code, other in (codes, codes[::-1]) if len(codes) == 2 else ():
        try:
            crs = CRS.from_epsg(int(code))
        except (CRSError, ValueError):
            continue
        if (crs.is_projected or crs.is_geographic) and not crs.is_compound:
            return f"EPSG:{code}", f"EPSG:{other} names no system of heights"
    return "", ""


def is_in_degrees(name: str | None) -> bool:
    """Returns whether a name is known to stand for coordinates in degrees."""
    known = None if name is None else resolve_crs(name)
    return known is not None and bool(known.horizontal.is_geographic)


def is_geocentric(name: str) -> bool:
    """Returns whether a name stands for coordinates from the middle of the Earth (EPSG:4978)."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        return bool(CRS.from_user_input(crs_label(name)[0]).is_geocentric)
    except CRSError:
        return False


def require_crs(name: str) -> KnownCrs:
    """Returns the reference system a user requested.

    Raises:
        CityModelError: Nobody knows the name, or it is no horizontal reference system.
    """
    known = resolve_crs(name)
    if known is None:
        raise CityModelError(
            f"Unknown coordinate reference system {name!r}.", "Write it as EPSG:25832 or EPSG:25832+7837."
        )
    return known


def epsg_codes(label: str) -> tuple[int, ...]:
    """Returns the codes of a system: one that says it all, else those of plane and heights; none without.

    Example:
        >>> epsg_codes("EPSG:28992+5709"), epsg_codes("EPSG:25832+7837")
        ((7415,), (25832, 7837))
    """
    from pyproj import CRS

    codes = label.removeprefix("EPSG:").split("+") if label.startswith("EPSG:") else []
    if len(codes) == 1:
        return (int(codes[0]),)
    code = CRS.from_user_input(label).to_epsg()
    return tuple(map(int, codes)) if code is None else (code,)


def metric_crs(known: KnownCrs, longitude_deg: float, latitude_deg: float) -> str:
    """Returns the metric system for a place: Japan's plane zones for Japanese data, else UTM.

    The UTM zone is in the datum of the data where EPSG has one (ETRS89, NAD83), else in WGS 84.

    Args:
        known: The system the coordinates are in; geographic, or projected in feet or to the west.
        longitude_deg: Of the middle of the data.
        latitude_deg: Likewise.

    Returns:
        A label with the vertical part of ``known``, in metres.
    """
    datum = known.horizontal.geodetic_crs.name if known.horizontal.geodetic_crs is not None else ""
    zone = int((longitude_deg + 180.0) // 6.0) % 60 + 1
    code = (32600 if latitude_deg >= 0 else 32700) + zone
    if datum.startswith("JGD"):
        code = _japan_zone(longitude_deg, latitude_deg, 6669 if datum == "JGD2011" else 2443)
    elif datum.startswith("ETRS89") and 28 <= zone <= 38:
        code = 25800 + zone
    elif datum == "NAD83" and 1 <= zone <= 23:
        code = 26900 + zone
    vertical = known.metric_vertical_code
    return f"EPSG:{code}" + (f"+{vertical}" if vertical else "")


def _japan_zone(longitude_deg: float, latitude_deg: float, first_code: int) -> int:
    """Returns the EPSG code of the plane zone around a place: the one whose origin is nearest.

    Zones follow prefectures; their bounding boxes overlap, and among those that hold the place the
    nearest central meridian is the better guess (and the smaller scale error in any case).
    """

    def distance(zone: _PlaneZone) -> tuple[bool, float]:
        is_inside = zone.west <= longitude_deg <= zone.east and zone.south <= latitude_deg <= zone.north
        return not is_inside, abs(longitude_deg - zone.meridian)

    return min(_plane_zones(first_code), key=distance).code


class _PlaneZone(NamedTuple):
    """A zone of Japan's plane coordinates: where it is used, and its central meridian, in degrees."""

    code: int
    west: float
    south: float
    east: float
    north: float
    meridian: float


@lru_cache(maxsize=2)
def _plane_zones(first_code: int) -> tuple[_PlaneZone, ...]:
    from pyproj import CRS

    zones = []
    for code in range(first_code, first_code + 19):
        crs = CRS.from_epsg(code)
        area, operation = crs.area_of_use, crs.coordinate_operation
        if area is not None and operation is not None:
            meridian = next(p.value for p in operation.params if p.name.startswith("Longitude of natural"))
            zones.append(_PlaneZone(code, *area.bounds, float(meridian)))
    return tuple(zones)


def is_same_plane(first: str, second: str) -> bool:
    """Returns whether two reference systems have the same horizontal part.

    Raises:
        CityModelError: One of them is unknown.
    """
    if first == second:
        return True
    one, other = (require_crs(name).horizontal for name in (first, second))
    return bool(one.equals(other, ignore_axis_order=True))


_MAX_SCALE_ERROR = 1e-3

_MAX_KEPT_SCALE_ERROR = 1e-2


def is_true_to_scale(known: KnownCrs, middle: NDArray[np.float64], findings: Findings) -> bool:
    """Returns whether the metres of a system are metres at a place (east, north), to a hundredth.

    A scale that errs by more than a thousandth becomes a finding. One that errs by more than a hundredth, as
    that of world Mercator, is not usable for measuring: the caller projects the city anew.
    """
    scales = _scales(known, middle)
    worst = max(abs(scale - 1.0) for scale in scales)
    if not worst > _MAX_SCALE_ERROR:
        return True
    factors = f"a metre to the east is {scales[0]:.4f} m there, to the north {scales[1]:.4f} m"
    is_kept = worst <= _MAX_KEPT_SCALE_ERROR
    findings.add(SCALE_OFF, "", f"{known.label}: {factors}{'' if is_kept else '; projected anew'}")
    return is_kept


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
