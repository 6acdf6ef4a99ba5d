"""Rows of cells as aligned text."""

from __future__ import annotations

from collections.abc import Sequence


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
