"""What the command line says about a fault, and about things looked at one by one."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TextIO

from lodbench.errors import LodbenchError
from lodbench.reporting.aligned_text import plain_lines, plain_text

if TYPE_CHECKING:
    from lodbench.checks import Check


class PlainStream:
    """A stream that terminal sequences and other control characters from data do not pass."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Writes a text; kept are line ends, tabs and the return that drawings of a bar begin with."""
        start = "\r" if text.startswith("\r") else ""
        # Names of files may hold bytes that are no text, which no stream takes.
        plain = plain_lines(text.removeprefix(start))
        self._stream.write(start + plain.encode("utf-8", errors="backslashreplace").decode("utf-8"))
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class PlainFormatter(logging.Formatter):
    """Lines of warnings, without what would steer a terminal."""

    def format(self, record: logging.LogRecord) -> str:
        """Returns the line of a record."""
        return f"lodbench: {plain_text(record.getMessage())}"


class SaidOnce(logging.Filter):
    """Lets a warning pass once: what a command does city by city it need not say for each."""

    def __init__(self) -> None:
        super().__init__()
        self._said: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        """Returns whether a record's line is a new one."""
        line = record.getMessage()
        is_new = line not in self._said
        self._said.add(line)
        return is_new


def report_fault(fault: LodbenchError) -> None:
    """Writes a fault to standard error: a line, or the lines it has, and its hint below."""
    sys.stderr.write(f"lodbench: {plain_lines(fault.message)}\n")
    if fault.hint:
        sys.stderr.write(f"  hint: {plain_lines(fault.hint)}\n")


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


def plain_check(check: Check) -> Check:
    """Returns a check whose words, anybody's text, cannot move a terminal's cursor; indents are ours."""
    return replace(check, detail=plain_text(check.detail), hint=plain_text(check.hint))


def traceback_lines(checks: Sequence[Check]) -> Iterator[str]:
    """Yields the tracebacks of checks, each below the name of its own."""
    for check in checks:
        if check.traceback:
            yield f"{check.name}:"
            yield from (f"  {plain_lines(line)}" for line in check.traceback.splitlines())
