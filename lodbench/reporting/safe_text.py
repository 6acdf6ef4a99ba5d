"""Text from elsewhere, made harmless for a terminal and for a spreadsheet."""

from __future__ import annotations

import re

# Terminal sequences whole (CSI with parameters, OSC up to its end), then any other control character.
_SEQUENCES = re.compile(r"\x1b\[[0-?]*[ -/]*[@-~]|\x1b\][^\x07\x1b]*(?:\x07|\x1b\\)?|\x9b[0-?]*[ -/]*[@-~]")
_CONTROLS = re.compile(r"[\x00-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


def plain_text(text: str) -> str:
    """Returns a text without terminal sequences, control characters and marks that turn its direction."""
    return _CONTROLS.sub(" ", _SEQUENCES.sub("", text)).strip()


def plain_lines(text: str) -> str:
    """Returns a text of several lines, pieces of lines or tables as ``plain_text`` would, spaces kept."""
    return _CONTROLS.sub(_kept, _SEQUENCES.sub("", text))


def _kept(found: re.Match[str]) -> str:
    return found[0] if found[0] in "\n\t" else " "


def csv_cell(value: object) -> str:
    """Returns a CSV cell that no spreadsheet takes for a formula.

    Numbers stay as they are, negative ones too; a text that starts with = + - or @ gets an apostrophe
    before it, except the lone dash of an unknown value. None is empty.
    """
    # Late: faults are told through this module where numpy, which storage needs, does not start.
    from lodbench.storage import hide_formula

    if value is None:
        return ""
    if isinstance(value, (int, float)):
        return repr(value)
    text = plain_text(str(value))
    return text if text == "-" else hide_formula(text)
