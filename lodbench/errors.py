"""The one exception family of lodbench: a message for the reader and a hint at what to do."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable


class LodbenchError(Exception):
    """A fault the user can understand and mend: printed as one line and a hint, exit code 2.

    Args:
        message: One sentence that names the file, line, building or key at fault.
        hint: One sentence that says what to do about it; empty when there is nothing to add.
    """

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint

    def __str__(self) -> str:
        return self.message


class CityModelError(LodbenchError):
    """A city model cannot be read, or has no geometry at the requested level of detail."""


class DatasetError(LodbenchError):
    """A dataset is missing, incomplete or malformed."""


class InputChanged(DatasetError):
    """A file is no longer what it was when the work began: the work ends, no query fails."""


class ConfigError(LodbenchError):
    """A command line or configuration value is unknown or out of range."""


class RenderingError(LodbenchError):
    """A renderer cannot do what was asked, or a library it needs is absent."""


class QueryFault(LodbenchError):
    """A fault of one query: recorded as a failed row with this reason; the run goes on."""


class WorkersGone(LodbenchError):
    """Workers cannot begin, keep dying or hang, or the scheduler is gone: the run ends, no query fails."""


# What ends whatever runs, and is no fault of the code that it came up in: before ``except BaseException``.
STOPPED = (KeyboardInterrupt, GeneratorExit)


def nearest_names(wanted: str, known: Iterable[str]) -> str:
    """Returns a hint that lists the known names closest to a misspelt one, or all of them."""
    names = sorted(known)
    close = difflib.get_close_matches(wanted, names, n=3, cutoff=0.5)
    if close:
        return "Did you mean " + " or ".join(close) + "?"
    return "Known: " + ", ".join(names) + "." if names else ""


def require_choice(name: str, value: str, known: Iterable[str]) -> None:
    """Makes sure that a setting is one of the known names.

    Raises:
        ConfigError: It is not; the hint lists the nearest.
    """
    choices = list(known)
    if value not in choices:
        raise ConfigError(f"{name}={value} is not known.", nearest_names(value, choices))


def require_within(
    name: str, value: float | Iterable[float] | None, low: float, high: float = math.inf, ends: str = "[]"
) -> None:
    """Makes sure that a setting, or each of its values, is a finite number within bounds; None is.

    Args:
        name: What it is called on a command line.
        value: It.
        low: Lower bound; minus infinity for none.
        high: Upper bound.
        ends: Whether the bounds belong to it, as intervals are written: ``(]`` has no lower one.

    Raises:
        ConfigError: A value is not.
    """
    for number in value if isinstance(value, Iterable) else [value]:
        if number is None or (
            math.isfinite(number)
            and (low < number if ends[0] == "(" else low <= number)
            and (number < high if ends[1] == ")" else number <= high)
        ):
            continue
        if low == -math.inf and high == math.inf:
            bounds = "finite"
        elif high == math.inf:
            lowest = f"{'above' if ends[0] == '(' else 'at least'} {low:g}"
            bounds = lowest if math.isfinite(number) else f"finite and {lowest}"
        else:
            is_closed = ends == "[]"
            bounds = f"within {low:g} to {high:g}" if is_closed else f"in {ends[0]}{low:g}, {high:g}{ends[1]}"
        raise ConfigError(f"{name}={number:g} is not {bounds}.")


def require_numbers(
    params: object, section: str, names: Iterable[str], low: float, high: float = math.inf, ends: str = "[]"
) -> None:
    """Makes sure of several settings what ``require_within`` does of one.

    Args:
        params: Has them as attributes.
        section: Their section of a command line, as in ``method.steps``; "" for none.
        names: The attributes.
        low: As for ``require_within``.
        high: Likewise.
        ends: Likewise.

    Raises:
        ConfigError: One is not.
    """
    for name in names:
        require_within(f"{section}.{name}" if section else name, getattr(params, name), low, high, ends)
