"""Findings: defects met in input data, each with a stable code; checks of machines and plug-ins."""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum

from lodbench.errors import LodbenchError


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


OK, FAULT = "ok", "fault"
# Slips of whoever wrote the code; anything else may be raised on purpose.
_SLIPS = (TypeError, AttributeError, NameError, ImportError, SyntaxError, AssertionError)


@dataclass(frozen=True, slots=True)
class Check:
    """One thing looked at.

    Attributes:
        section: ``machine``, ``packages``, ``extras``, ``folders``, ``renderers``, ``networks`` or
            ``traps``; of a method ``plug-in`` or ``answers``.
        name: What it is.
        status: ``ok``, ``absent`` (optional, not installed) or ``broken``; of a method ``ok`` or ``fault``.
        detail: What was found.
        hint: What to do about it; empty when there is nothing to do.
        is_base: Whether lodbench is of no use without it.
        traceback: Of the plug-in's own code where that raised; empty otherwise.
    """

    section: str
    name: str
    status: str
    detail: str
    hint: str = ""
    is_base: bool = False
    traceback: str = ""


def fault_of(error: BaseException, section: str, name: str, on_purpose: str = "") -> Check:
    """Returns the fault that somebody's code raised: in its own words if it is an error of lodbench.

    Args:
        error: What it raised.
        section: Of the check.
        name: Likewise.
        on_purpose: What to do where it was meant to be raised; stated unless it is a plain slip.
    """
    if isinstance(error, LodbenchError):
        return Check(section, name, FAULT, error.message, error.hint or on_purpose)
    words = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    meant = "" if not on_purpose or isinstance(error, _SLIPS) else f" {on_purpose}"
    traced = "".join(traceback.format_exception(error))
    return Check(section, name, FAULT, words, f"Its traceback is below.{meant}", traceback=traced)
