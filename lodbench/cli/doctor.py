"""`lodbench doctor`: what works on this machine, and what to install."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from lodbench.cli.parser import Parser, check_lines

if TYPE_CHECKING:
    from lodbench.checks import Check


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code: 1 if the base install is broken."""
    parser = Parser(
        "lodbench doctor",
        description="Check this installation, and say what to install for optional features.",
    )
    parser.add_argument("--json", action="store_true", help="one check per line, for machines")
    thorough = "compile a function, draw with each renderer, ask each network, load each plug-in as well"
    parser.add_argument("--thorough", action="store_true", help=f"{thorough} (half a minute)")
    options = parser.parse_args(argv)

    from lodbench.harness.doctor import examine, is_base_broken

    checks = examine(options.thorough)
    if options.json:
        lines: Iterator[str] = (json.dumps(_told(check)) for check in checks)
    else:
        lines = _lines(checks, options.thorough)
    sys.stdout.write("".join(line + "\n" for line in lines))
    return 1 if is_base_broken(checks) else 0


def _told(check: Check) -> dict[str, Any]:
    """Returns a check as JSON values; a traceback only where there is one."""
    values = asdict(check)
    return values if values["traceback"] else {k: v for k, v in values.items() if k != "traceback"}


def _lines(checks: list[Check], is_thorough: bool) -> Iterator[str]:
    """Yields the report for people."""
    yield from check_lines(checks)
    faults = [check for check in checks if check.status != "ok"]
    broken = ", ".join(check.name for check in faults if check.is_base)
    optional = ", ".join(check.name for check in faults if not check.is_base)
    yield ""
    fine = "The base install works." if is_thorough else "The base install is complete; --thorough tries it."
    yield f"The base install is broken: {broken}." if broken else fine
    if optional:
        yield f"Optional, not ready: {optional}."
