"""Findings: defects met in input data, each with a stable code, the object's id and a count."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum


class Severity(Enum):
    """How much a finding matters: an ERROR lost data, a WARNING changed it, INFO only states it."""

    ERROR = "error"
    WARNING = "warning"
    INFO = "info"


@dataclass(frozen=True, slots=True)
class FindingCode:
    """A kind of defect, for example ``LB101 RING_TOO_SHORT``; codes never change their meaning.

    ``name`` is what its module calls it, once ``catalogue_of`` has seen that.
    """

    number: int
    severity: Severity
    meaning: str
    name: str = field(default="", init=False, compare=False)

    @property
    def code(self) -> str:
        """Returns what it is called in files and reports, ``LB101``."""
        return f"LB{self.number}"

    def __str__(self) -> str:
        return f"{self.code} {self.name}"


def graded(severity: Severity) -> Callable[[int, str], FindingCode]:
    """Returns the constructor of codes of a severity, from their number and meaning."""
    return lambda number, meaning: FindingCode(number, severity, meaning)


def catalogue_of(module: Mapping[str, object]) -> dict[str, FindingCode]:
    """Names the codes of a module, ``globals()``, as it calls them; returns them by code, in order."""
    codes = [(name, code) for name, code in module.items() if isinstance(code, FindingCode)]
    for name, code in codes:
        object.__setattr__(code, "name", name)
    return {code.code: code for _, code in sorted(codes, key=lambda item: item[1].number)}


@dataclass(frozen=True, slots=True)
class Finding:
    """One defect: its code, the id of the object it was met in, and a detail in words.

    ``polygon`` is the number of the polygon at fault among those looked at, -1 where none is; ``place`` a
    point of it, (x, y, z) in the coordinates looked at, or None.
    """

    code: FindingCode
    object_id: str
    detail: str = ""
    polygon: int = -1
    place: tuple[float, ...] | None = None


@dataclass(slots=True, repr=False)
class Findings:
    """A list of findings that only grows while a file is read."""

    items: list[Finding] = field(default_factory=list)

    def __repr__(self) -> str:
        return f"Findings({', '.join(f'{count} x {name}' for name, count in self.counts().items())})"

    def add(
        self,
        code: FindingCode,
        object_id: str,
        detail: str = "",
        *,
        polygon: int = -1,
        place: tuple[float, ...] | None = None,
    ) -> None:
        """Records one defect."""
        self.items.append(Finding(code, object_id, detail, polygon, place))

    def counts(self) -> dict[str, int]:
        """Returns ``{"LB101 RING_TOO_SHORT": 3, ...}`` in the order of the codes."""
        return dict(sorted(Counter(str(item.code) for item in self.items).items()))

    def objects(self) -> dict[str, int]:
        """Returns in how many objects each kind was met: ``{"LB101 RING_TOO_SHORT": 2, ...}``, in order."""
        pairs = {(str(item.code), item.object_id) for item in self.items if item.object_id}
        return dict(sorted(Counter(code for code, _ in pairs).items()))

    def has_errors(self) -> bool:
        """Tells whether any finding lost data."""
        return any(item.code.severity is Severity.ERROR for item in self.items)
