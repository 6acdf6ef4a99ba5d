"""What a bench is told: fields of a dataclass that are options of its command, told once."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import field, fields
from typing import Any, TypeVar

T = TypeVar("T")
# Meaning of a seed.
SEED = "random seed"


def option(default: Any, meaning: str, flag: str = "", parse: Callable[[str], Any] | None = None) -> Any:
    """Returns a dataclass field that is an option too.

    Args:
        default: Its default; where that is None the meaning says what is done then.
        meaning: Its help.
        flag: What it is called where that is not the field's name.
        parse: Makes the value of a word; by default the default's type.
    """
    return field(default=default, metadata={"meaning": meaning, "flag": flag, "parse": parse})


def words(text: str) -> tuple[str, ...]:
    """Returns words separated by commas."""
    return tuple(text.split(",")) if text else ()


def add_options(parser: argparse.ArgumentParser, kind: type) -> None:
    """Adds the options among a dataclass' fields to a parser."""
    for each in fields(kind):
        told = each.metadata
        if told:
            flag = told["flag"] or each.name.replace("_", "-")
            shown = ",".join(each.default) if isinstance(each.default, tuple) else each.default
            parser.add_argument(
                f"--{flag}",
                dest=each.name,
                metavar=flag.upper().replace("-", "_"),
                default=each.default,
                type=told["parse"] or (str if each.default is None else type(each.default)),
                help=told["meaning"] + ("" if each.default is None else f" ({shown})"),
            )


def options_of(given: argparse.Namespace, kind: type[T]) -> T:
    """Returns the dataclass with what a parser of its options was given."""
    return kind(**{each.name: getattr(given, each.name) for each in fields(kind) if each.metadata})  # type: ignore[arg-type]
