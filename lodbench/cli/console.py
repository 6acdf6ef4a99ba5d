"""What the command line says about a fault, and about things looked at one by one."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from lodbench.errors import LodbenchError

if TYPE_CHECKING:
    from lodbench.checks import Check


def report_fault(fault: LodbenchError) -> None:
    """Writes a fault to standard error: one line, and its hint below."""
    sys.stderr.write(f"lodbench: {fault.message}\n")
    if fault.hint:
        sys.stderr.write(f"  hint: {fault.hint}\n")


def check_lines(checks: Sequence[Check]) -> Iterator[str]:
    """Yields a line per check, below the name of its section, and its hint below that."""
    width = max(len(check.name) for check in checks)
    section = ""
    for check in checks:
        if check.section != section:
            section = check.section
            yield f"{section}:"
        yield f"  {check.status:6}  {check.name.ljust(width)}  {check.detail}"
        if check.hint:
            yield f"  {'':6}  {'':{width}}  -> {check.hint}"
