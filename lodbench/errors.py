"""The one exception family of lodbench: a message for the reader and a hint at what to do."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True)
class Option:
    """An option of a command that a message names.

    Attributes:
        name: As settings have it: ``dataset.root``; ``prior_height`` of ``--prior-height``.
        value: ``FILE``; "" where the message names none.
        words: As the message has it: ``dataset.root=FILE``, ``--prior-height METRES``.
    """

    name: str
    value: str
    words: str

    @property
    def is_flag(self) -> bool:
        """Whether it is written as a flag."""
        return self.words.startswith("--")


class Words(str):
    """A text for the reader that knows which options it names: each command writes them in its own syntax.

    Example:
        >>> hint = Words("Set `city=FILE`, or give `--crs CODE`.")
        >>> str(hint)
        'Set city=FILE, or give --crs CODE.'
        >>> hint.rewritten(lambda option: f"--{option.name} {option.value}")
        'Set --city FILE, or give --crs CODE.'
    """

    _pieces: tuple[str | Option, ...]

    def __new__(cls, text: str) -> Words:
        """Returns a text whose options stand between backticks."""
        if isinstance(text, Words):
            return text
        *parts, last = text.split("`")
        pieces = [_option(part) if k % 2 else part for k, part in enumerate(parts)]
        pieces.append(f"`{last}" if len(parts) % 2 else last)
        return cls._of(pieces)

    @classmethod
    def _of(cls, pieces: Iterable[str | Option]) -> Words:
        kept = tuple(pieces)
        words = super().__new__(cls, "".join(p.words if isinstance(p, Option) else p for p in kept))
        words._pieces = kept
        return words

    @property
    def marked(self) -> str:
        """The text with its options between backticks, to make another of."""
        return "".join(f"`{p.words}`" if isinstance(p, Option) else p for p in self._pieces)

    def rewritten(self, write: Callable[[Option], str]) -> Words:
        """Returns the text with each option as a command writes it."""
        return self._of(replace(p, words=write(p)) if isinstance(p, Option) else p for p in self._pieces)


def _option(text: str) -> Option | str:
    """Returns the option that stands between backticks, or the text as it was: it may be anybody's."""
    flag = text.removeprefix("--")
    is_spaced = flag != text and " " in flag.partition("=")[0]
    name, _, value = flag.partition(" " if is_spaced else "=")
    known = name.replace("-", "_") if flag != text else name
    is_option = known.partition("[")[0].replace(".", "").isidentifier()
    return Option(known, value, text) if is_option else f"`{text}`"


class LodbenchError(Exception):
    """A fault the user can understand and mend: printed as one line and a hint, exit code 2.

    Args:
        message: One sentence that names the file, line, building or key at fault; options stand between
            backticks, as of ``Words``.
        hint: One sentence that says what to do about it; empty when there is nothing to add.
    """

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.message = Words(message)
        self.hint = Words(hint)

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
        raise ConfigError(f"`{name}={value}` is not known.", nearest_names(value, choices))


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
        raise ConfigError(f"`{name}={number:g}` is not {bounds}.")


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
