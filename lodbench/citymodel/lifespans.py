"""Which city objects exist at a date, by the dates of creation and demolition in CityGML and CityJSON."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from datetime import date, timedelta
from typing import Any

from lodbench.citymodel.codes import CREATED_LATER, NOT_STANDING
from lodbench.findings import Findings

# Names of the record's and of the real object's days. A year ends with its last day.
ENDS = ("terminationDate", "validTo", "dateOfDemolition", "yearOfDemolition")
BEGINNINGS = ("validFrom",)
NAMES = (*ENDS, *BEGINNINGS, "creationDate")
_DAY = re.compile(r"\s*(\d{4})(?:-(\d\d)(?:-(\d\d))?)?(?!\d)")
_OPEN_YEAR = 9999  # how registers write that there is no end

# First day, and the day after the last, between which the same objects stand; None where none has an end.
Period = tuple[str, str]
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
