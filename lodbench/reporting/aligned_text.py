"""Aligned rows for terminals, and texts from elsewhere that steer neither a terminal nor a spreadsheet."""

from __future__ import annotations

import re
from collections.abc import Sequence

# Terminal sequences whole (CSI with parameters, OSC up to its end), then any other control character.
_SEQUENCES = re.compile(r"\x1b\[[0-?]*[ -/]*[@-~]|\x1b\][^\x07\x1b]*(?:\x07|\x1b\\)?|\x9b[0-?]*[ -/]*[@-~]")
_CONTROLS = re.compile(r"[\x00-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


def count_of(number: int | str, things: str) -> str:
    """Returns how many things there are, given their plural.

    Example:
        >>> count_of(1, "queries"), count_of(1, "views"), count_of(20, "queries")
        ('1 query', '1 view', '20 queries')
    """
    if str(number) != "1":
        return f"{number} {things}"
    return f"1 {things[:-3]}y" if things.endswith("ies") else f"1 {things.removesuffix('s')}"


def already_there(number: int, things: str = "") -> str:
    """Returns what is said of work that an earlier process did, in brackets; "" where it did none.

    Example:
        >>> already_there(1, "queries"), already_there(20, "queries"), already_there(0)
        (' (1 query was there already)', ' (20 queries were there already)', '')
    """
    if not number:
        return ""
    return f" ({count_of(number, things).strip()} {'was' if number == 1 else 'were'} there already)"


def format_columns(rows: Sequence[Sequence[str]]) -> str:
    """Returns rows of cells as lines of text: first column flush left, the others flush right."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [row[0].ljust(widths[0])]
        cells += [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def plain_text(text: str) -> str:
    """Returns a text without terminal sequences, control characters and marks that turn its direction."""
    return _CONTROLS.sub(" ", _SEQUENCES.sub("", text)).strip()


def plain_lines(text: str) -> str:
    """Returns a text of several lines, pieces of lines or tables as ``plain_text`` would, spaces kept."""
    return _CONTROLS.sub(_kept, _SEQUENCES.sub("", text))


def _kept(match: re.Match[str]) -> str:
    return match[0] if match[0] in "\n\t" else " "


def csv_cell(value: object) -> str:
    """Returns a CSV cell that no spreadsheet takes for a formula.

    Numbers stay as they are, negative ones too; a text that starts with = + - or @ gets an apostrophe
    before it, except the lone dash of an unknown value. None is empty.
    """
    # Late: faults are reported through this module where numpy, which storage needs, does not start.
    from lodbench.storage import hide_formula

    if value is None:
        return ""
    if isinstance(value, (int, float)):
        return repr(value)
    text = plain_text(str(value))
    return text if text == "-" else hide_formula(text)
