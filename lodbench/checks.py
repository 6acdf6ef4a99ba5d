"""What was found when something was looked at: of a machine by `doctor`, of a method by `check-method`."""

from __future__ import annotations

import traceback
from dataclasses import dataclass

from lodbench.errors import LodbenchError

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
        on_purpose: What to do where it was meant to be raised; told unless it is a plain slip.
    """
    if isinstance(error, LodbenchError):
        return Check(section, name, FAULT, error.message, error.hint or on_purpose)
    words = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    meant = "" if not on_purpose or isinstance(error, _SLIPS) else f" {on_purpose}"
    traced = "".join(traceback.format_exception(error))
    return Check(section, name, FAULT, words, f"Its traceback is below.{meant}", traceback=traced)
