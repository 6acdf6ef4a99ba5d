"""What the command line says about a fault."""

from __future__ import annotations

import sys

from lodbench.errors import LodbenchError


def report_fault(fault: LodbenchError) -> None:
    """Writes a fault to standard error: one line, and its hint below."""
    sys.stderr.write(f"lodbench: {fault.message}\n")
    if fault.hint:
        sys.stderr.write(f"  hint: {fault.hint}\n")
