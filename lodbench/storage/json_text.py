"""JSON that others write or read, and CSV cells that no spreadsheet takes for a formula."""

from __future__ import annotations

import json
import math
import re
from typing import Any


def parse_json(text: str | bytes, is_strict: bool = False) -> Any:
    """Returns the value of a JSON text.

    Args:
        text: One document; bytes are UTF-8.
        is_strict: Refuse NaN and Infinity, which Python reads and JSON does not know.

    Raises:
        ValueError: It is no JSON, or is nested more deeply than Python can follow.
    """
    try:
        return json.loads(text, parse_constant=_refuse if is_strict else None)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def finite(value: Any) -> Any:
    """Returns plain values with None for numbers that JSON does not know: NaN and infinities."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def list_or_empty(value: Any) -> list[Any]:
    """Returns a list as it is, and an empty one for anything else."""
    return value if isinstance(value, list) else []


def _refuse(word: str) -> float:
    raise ValueError(f"{word} is not a number of JSON")


_HIDDEN = re.compile(r"'*[=+\-@]")


def hide_formula(text: str) -> str:
    """Returns a text with an apostrophe before what a spreadsheet would compute: = + - or @ at its front.

    Texts that look hidden already get one more, so that ``show_formula`` restores every text.
    """
    return f"'{text}" if _HIDDEN.match(text) else text


def show_formula(text: str) -> str:
    """Returns the text that ``hide_formula`` was given."""
    return text[1:] if text.startswith("'") and _HIDDEN.match(text) else text
