"""Runs an experiment as `lodbench bench` runs a bench: a table or figures, pictures, faults in one line."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TypeVar

from lodbench.bench import Report
from lodbench.cli.bench import PrintOptions, measured
from lodbench.cli.parser import Parser, report_fault
from lodbench.cli.settings import in_syntax_of
from lodbench.errors import LodbenchError
from lodbench.execution import ProgressCallback
from lodbench.params import add_options, flag, options_of

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class PictureOptions:
    """Where pictures go."""

    pictures: Path | None = flag(None, "folder for pictures, if there are any", metavar="DIR")


def run(name: str, kind: type[T], measure: Callable[[T, ProgressCallback], Report]) -> int:
    """Runs an experiment with the words of the command line.

    Args:
        name: Of its folder, and of its module.
        kind: A dataclass whose fields are its options.
        measure: Measures what they request.

    Returns:
        The exit code: 2 where the words or what they name cannot be measured.
    """
    parser = Parser(f"python -m experiments.{name}", description=sys.modules["__main__"].__doc__)
    writes_its_own = any(each.name == "pictures" for each in fields(kind))  # type: ignore[arg-type]
    for options in (kind, *(() if writes_its_own else (PictureOptions,)), PrintOptions):
        add_options(parser, options)
    try:
        given = parser.parse_args()
        pictures = None if writes_its_own else options_of(given, PictureOptions).pictures
        measured(options_of(given, kind), name, measure, pictures, options_of(given, PrintOptions).json)
    except LodbenchError as fault:
        typed = ("bench", "accuracy")
        fault.message, fault.hint = in_syntax_of(typed, fault.message), in_syntax_of(typed, fault.hint)
        report_fault(fault)
        return 2
    return 0
