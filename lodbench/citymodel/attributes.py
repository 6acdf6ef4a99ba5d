"""What the attributes of city objects say: whether each exists at a date, its roof and its height."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import date, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import CREATED_LATER, NOT_STANDING
from lodbench.citymodel.model import TALLEST_M, CityObjects, Period, Solids
from lodbench.findings import Findings

# Names of the record's and of the real object's days. A year ends with its last day.
ENDS = ("terminationDate", "validTo", "dateOfDemolition", "yearOfDemolition")
BEGINNINGS = ("validFrom",)
NAMES = (*ENDS, *BEGINNINGS, "creationDate")
_DAY = re.compile(r"\s*(\d{4})(?:-(\d\d)(?:-(\d\d))?)?(?!\d)")
_OPEN_YEAR = 9999  # how registers write that there is no end

_ALWAYS: Period = (date.min.isoformat(), date.max.isoformat())


def today() -> str:
    """Returns the date of today, ``YYYY-MM-DD``."""
    return date.today().isoformat()


class Lifespans:
    """Decides which objects exist at a date, and collects the period in which that set does not change.

    Args:
        day: The date that counts, ``YYYY-MM-DD``; None for today.
        findings: Receives what does not stand.

    Attributes:
        day: That date.
    """

    def __init__(self, day: str | None, findings: Findings) -> None:
        self.day = day or today()
        self._findings = findings
        self._events: set[str] = set()

    def stands(self, object_id: str, attributes: Mapping[str, Any]) -> bool:
        """Tells whether an object stands, by what it says under any of ``NAMES``; what does not is a finding.

        A creation date may be that of the record: a later one is a finding, and the object stays.
        """
        days = {name: _day_of(name, attributes[name]) for name in NAMES if attributes.get(name) is not None}
        end = min(((day, name) for name in ENDS if (day := days.get(name))), default=None)
        begin = max(((day, name) for name in BEGINNINGS if (day := days.get(name))), default=None)
        self._events.update(event[0] for event in (end, begin) if event is not None)
        name = None
        if end is not None and end[0] <= self.day:
            name = end[1]
        elif begin is not None and begin[0] > self.day:
            name = begin[1]
        if name is not None:
            self._findings.add(NOT_STANDING, object_id, f"{name} {str(attributes[name]).strip()[:40]}")
        elif (days.get("creationDate") or "") > self.day:
            self._findings.add(
                CREATED_LATER, object_id, f"creationDate {str(attributes['creationDate'])[:40]}"
            )
        return name is None

    def none_stands(self) -> str:
        """Returns in words that no object stands, for a city that has no other; "" where there was none."""
        count = sum(item.code is NOT_STANDING for item in self._findings.items)
        return f"has no building that exists on {self.day}; {count} ended or begin later" if count else ""

    def period(self) -> Period | None:
        """Returns the days around the date between which nothing begins or ends; None where nothing does."""
        if not self._events:
            return None
        first = max((event for event in self._events if event <= self.day), default=_ALWAYS[0])
        return first, min((event for event in self._events if event > self.day), default=_ALWAYS[1])


def _day_of(name: str, value: Any) -> str | None:
    """Returns the day from which on a beginning or an end holds, None where a value is none."""
    match = _DAY.match(str(value))
    if match is None or int(match[1]) >= _OPEN_YEAR:
        return None
    year, month, day = int(match[1]), int(match[2] or 1), int(match[3] or 1)
    try:
        if name in ENDS and match[3] is None:  # the first day after the year, or after the month
            year, month = (year + 1, 1) if match[2] is None or month == 12 else (year, month + 1)
        return date(year, month, day).isoformat()
    except ValueError:
        return None


def common_period(periods: Iterable[Period | None]) -> Period | None:
    """Returns the period in which those of several tiles overlap.

    Example:
        >>> common_period([("2015-06-30", "9999-12-31"), None, ("0001-01-01", "2031-01-01")])
        ('2015-06-30', '2031-01-01')
    """
    known = [period for period in periods if period is not None]
    return (max(first for first, _ in known), min(last for _, last in known)) if known else None


def holds_on(period: Period | None, day: str | None) -> bool:
    """Returns whether what stands in a period stands on a day, None for today."""
    return period is None or period[0] <= (day or today()) < period[1]


def period_of(stored: Any) -> Period | None:
    """Returns a period as it is stored, a list of two days or None.

    Raises:
        TypeError, ValueError: It is none.
    """
    if stored is None:
        return None
    first, end = (date.fromisoformat(day).isoformat() for day in stored)
    return first, end


def date_in(period: Period) -> str:
    """Returns a date in a period that does not depend on when it was computed.

    Example:
        >>> date_in(("2015-06-30", "9999-12-31")), date_in(("0001-01-01", "2031-01-01"))
        ('2015-06-30', '2030-12-31')
    """
    first, end = period
    return first if first != _ALWAYS[0] else (date.fromisoformat(end) - timedelta(days=1)).isoformat()


@dataclass(slots=True)
class ObjectTable:
    """Grows the objects and solids of a city while it is read.

    Faces name polygons by serial numbers, which count all polygons met, dropped ones included.
    """

    has_details: bool
    ids: list[str] = field(default_factory=list)
    types: list[str] = field(default_factory=list)
    parents: list[int] = field(default_factory=list)
    building: list[int] = field(default_factory=list)
    attributes: list[dict[str, Any]] = field(default_factory=list)
    solids: list[tuple[int, list[list[tuple[int, bool]]], int]] = field(default_factory=list)
    num_composites: int = 0
    polygon_ids: dict[int, str] = field(default_factory=dict)
    num_polygons: int = 0
    roof_types: list[tuple[int, str]] = field(default_factory=list)
    measured_m: dict[int, float] = field(default_factory=dict)

    def add(
        self,
        object_id: str,
        type_: str,
        parent: int,
        building: int,
        attributes: dict[str, Any] | None = None,
        roof_type: str = "",
        height_m: float | None = None,
    ) -> int:
        """Returns the index of a new object; its roof type and height count for its building."""
        if roof_type:
            self.roof_types.append((building, roof_type))
        if height_m is not None and 0 < height_m < TALLEST_M:  # of parts the highest
            self.measured_m[building] = max(height_m, self.measured_m.get(building, 0.0))
        self.ids.append(object_id)
        self.types.append(type_)
        self.parents.append(parent)
        self.building.append(building)
        if self.has_details:
            self.attributes.append(attributes or {})
        return len(self.ids) - 1

    @property
    def is_plain(self) -> bool:
        """Whether there are buildings only, of which nothing but their ids is reported."""
        return not self.has_details and self.types.count("Building") == len(self.types)

    def heights(self, count: int) -> NDArray[np.float64] | None:
        """Returns (count,) measured heights of buildings, metres, NaN for none; None where no one has any."""
        heights = [self.measured_m.get(building, np.nan) for building in range(count)]
        return np.asarray(heights) if self.measured_m else None

    def finish(self) -> CityObjects:
        """Returns the objects."""
        return CityObjects(
            tuple(self.ids),
            tuple(self.types),
            np.asarray(self.parents, np.int32),
            np.asarray(self.building, np.int32),
            tuple(self.attributes),
        )

    def finish_solids(self, serials: NDArray[np.int64]) -> tuple[Solids, tuple[str, ...]]:
        """Returns the solids, and an id or "" for each polygon.

        Args:
            serials: (N,) serial number of each polygon that is there; -1 for copies.
        """
        size = int(serials.max(initial=-1)) + 1
        index = np.full(size + 1, -1, np.int64)
        index[serials[serials >= 0]] = np.flatnonzero(serials >= 0)
        shells = [shell for _, solid, _ in self.solids for shell in solid]
        faces = np.asarray([number for shell in shells for number, _ in shell], np.int64)
        solids = Solids(
            np.asarray([part for part, _, _ in self.solids], np.int32),
            np.cumsum([0, *(len(solid) for _, solid, _ in self.solids)]).astype(np.int64),
            np.cumsum([0, *map(len, shells)]).astype(np.int64),
            index[np.where(faces < size, faces, size)],
            np.asarray([is_flipped for shell in shells for _, is_flipped in shell], np.bool_),
            np.asarray([composite for _, _, composite in self.solids], np.int32),
        )
        return solids, tuple(self.polygon_ids.get(number, "") for number in serials.tolist())


# Attributes that name the kind of a roof: of CityGML and CityJSON, 3DBAG, OpenStreetMap, and ALKIS.
ATTRIBUTES = ("roofType", "b3_dak_type", "dak_type", "roof:shape", "roof_shape", "dachform")

# Of the surveying authorities of Germany (2100 to 3800) and of SIG 3D (1010 to 1100, 1120): single pitches,
# gables, hips, mansards, tents, cones, saw teeth, mixed forms. Flat, arched, combined and other ones are not.
_CODES = frozenset(
    {"2100", "2200", "3100", "3200", "3300", "3400", "3500", "3600", "3800", "5000"}
    | {"1010", "1020", "1030", "1040", "1050", "1060", "1070", "1080", "1100", "1120"}
)  # fmt: skip

# Four digits at the end: of the code itself, or of an address or a name, ".../roofType.xml#3100".
_CODE = re.compile(r"(?<!\d)(\d{4})(?:\.0)?\s*$")

# Parts of words, in lower case; what says that there is no pitch goes before.
_WORDS = (
    "slanted", "pitch", "gable", "hipped", "gambrel", "mansard", "pyramid", "skillion", "saltbox", "pavilion",
    "cone", "conical", "sawtooth", "sattel", "walm", "pultd", "zeltd", "kegeld", "sheddach", "zadeldak",
    "schilddak", "lessenaar", "tentdak",
)  # fmt: skip

_LEVEL_WORDS = ("flat", "unpitched", "not pitched")


def is_pitched(roof_type: str) -> bool:
    """Returns whether a word or code says that a roof is pitched; of unknown ones nothing is known.

    Example:
        >>> is_pitched("3100"), is_pitched("SATTELDACH"), is_pitched("multiple horizontal")
        (True, True, False)
    """
    words = roof_type.lower()
    code = _CODE.search(words)
    if code is not None:
        return code[1] in _CODES
    return any(word in words for word in _WORDS) and not any(word in words for word in _LEVEL_WORDS)


def roof_type_of(attributes: Mapping[str, Any]) -> str:
    """Returns the word or code under which an object's attributes describe its roof, or ""."""
    return next(filter(None, (word_of(attributes.get(name)) for name in ATTRIBUTES)), "")


def word_of(value: object) -> str:
    """Returns a value as a word or code, "" where it is none; codes may be numbers with a decimal point."""
    if isinstance(value, float):
        return str(int(value)) if value.is_integer() else ""
    return str(value).strip() if isinstance(value, str | int) and not isinstance(value, bool) else ""


def pitched_buildings(stated: Iterable[tuple[int, str]], count: int) -> NDArray[np.bool_] | None:
    """Returns (B,) which buildings have pitched roofs: at least half of what is stated of them says so.

    None where no building has.

    Args:
        stated: Buildings and words or codes; of those with parts, of each.
        count: Number of buildings, B.
    """
    balance, is_any = np.zeros(count, np.int64), np.zeros(count, np.bool_)
    for building, roof_type in stated:
        has_pitch = is_pitched(roof_type)
        balance[building] += 1 if has_pitch else -1
        is_any[building] |= has_pitch
    is_any &= balance >= 0
    return is_any if is_any.any() else None


def take_measured_height(values: dict[str, Any]) -> None:
    """Puts what measuredHeight became in CityGML 3 under its name: of several heights that with its ends."""
    given = values.get("height")
    heights = given if isinstance(given, list) else [given]
    inner = [one.get("Height") if isinstance(one, dict) else None for one in heights]
    measured = [one for one in inner if isinstance(one, dict) and one.get("status") == "measured"]
    if not measured:
        return
    chosen = max(measured, key=_is_overall)
    values["measuredHeight"] = chosen.get("value")
    if _is_overall(chosen):
        rest = [one for one, height in zip(heights, inner, strict=True) if height is not chosen]
        values["height"] = rest if len(rest) > 1 else next(iter(rest), None)
        if not rest:
            del values["height"]


def overall_height(attributes: Mapping[str, Any]) -> float | None:
    """Returns the measured height among an object's attributes, else that of its storeys above the ground."""
    for name in ("measuredHeight", "storeyHeightsAboveGround"):
        values = attributes[name] if isinstance(attributes.get(name), list) else [attributes.get(name)]
        if values and all(type(value) in (int, float) for value in values):
            return float(sum(values))
    return None


def _is_overall(height: dict[str, Any]) -> bool:
    return (height.get("lowReference"), height.get("highReference")) == (
        "lowestGroundPoint",
        "highestRoofEdge",
    )
