"""Runs an experiment as `lodbench bench` runs a bench: a table or figures, pictures, faults in one line."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lodbench.bench import Report, add_options, options_of
from lodbench.cli.bench import measured
from lodbench.cli.parser import Parser, report_fault
from lodbench.cli.settings import in_syntax_of
from lodbench.errors import LodbenchError
from lodbench.execution import ProgressCallback

Measure = Callable[[argparse.Namespace, ProgressCallback], Report]


def run(name: str, add: Callable[[argparse.ArgumentParser], None], measure: Measure) -> int:
    """Runs an experiment with the words of the command line.

    Args:
        name: Of its folder, and of its module.
        add: Adds its options to a parser.
        measure: Measures what they ask for.

    Returns:
        The exit code: 2 where the words or what they name cannot be measured.
    """
    parser = Parser(f"python -m experiments.{name}", description=sys.modules["__main__"].__doc__)
    add(parser)
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="folder for pictures, if there are any")
    parser.add_argument("--json", action="store_true", help="one figure per line, for machines")
    try:
        measured(parser.parse_args(), name, measure)
    except LodbenchError as fault:
        typed = ("bench", "accuracy")
        fault.message, fault.hint = in_syntax_of(typed, fault.message), in_syntax_of(typed, fault.hint)
        report_fault(fault)
        return 2
    return 0


def run_options(name: str, kind: type, measure: Callable[[Any, ProgressCallback], Report]) -> int:
    """Runs an experiment whose options are the fields of a dataclass; see ``run``."""
    return run(
        name,
        lambda parser: add_options(parser, kind),
        lambda given, steps: measure(options_of(given, kind), steps),
    )
