"""What was found when something was looked at: of a machine by `doctor`, of a method by `check-method`."""

from __future__ import annotations

from dataclasses import dataclass

OK, FAULT = "ok", "fault"


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
