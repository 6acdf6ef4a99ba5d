"""CSV cells that no spreadsheet takes for a formula, and back again without loss."""

from __future__ import annotations

import re

_HIDDEN = re.compile(r"'*[=+\-@]")


def hide_formula(text: str) -> str:
    """Returns a text with an apostrophe before what a spreadsheet would compute: = + - or @ at its front.

    Texts that look hidden already get one more, so that ``show_formula`` restores every text.
    """
    return f"'{text}" if _HIDDEN.match(text) else text


def show_formula(text: str) -> str:
    """Returns the text that ``hide_formula`` was given."""
    return text[1:] if text.startswith("'") and _HIDDEN.match(text) else text
