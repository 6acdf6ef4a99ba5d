"""Hints in the syntax of the command typed: `--lod 2` where a library says ``lod=2``."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields

from lodbench.citymodel.options import ReadOptions
from lodbench.errors import LodbenchError

_FLAGS = {
    "crs": "--crs",
    "lod": "--lod",
    "roof_height": "--roof-height",
    "city": "--city",
    "method": "--method",
    "segmenter": "--segmenter",
    "dataset.root": "--root",
    "dataset.crs": "--crs",
    "dataset.lod": "--lod",
}
_OPTIONS = {field.name: f"--option {field.name}" for field in fields(ReadOptions)}
# Settings of these are words of one option.
_OF_PART = re.compile(r"(?<![\w.])(method|segmenter)\.(?=\w+=)")
_SETTING = re.compile(rf"(?<![\w./])({'|'.join(map(re.escape, [*_FLAGS, *_OPTIONS]))})=")


def in_flags(text: str) -> str:
    """Returns a text with settings as the options of a command with flags.

    Example:
        >>> in_flags("Name it: crs=EPSG:4326, or default_height_m=9.")
        'Name it: --crs EPSG:4326, or --option default_height_m=9.'
        >>> in_flags("Is it right? crs= names another.")
        'Is it right? --crs names another.'
        >>> in_flags("Set segmenter=compact, or method.single=region.")
        'Give --segmenter compact, or --method-option single=region.'
    """

    def flag(match: re.Match[str]) -> str:
        name = match[1]
        if name not in _FLAGS:
            return f"{_OPTIONS[name]}="
        return _FLAGS[name] + ("" if match.string[match.end() : match.end() + 1] in (" ", "") else " ")

    found = _OF_PART.sub(r"--\1-option ", _SETTING.sub(flag, text))
    return found.replace("Set --", "Give --")


@contextmanager
def hints_in_flags() -> Iterator[None]:
    """Turns the hints of faults raised inside into the syntax of flags."""
    try:
        yield
    except LodbenchError as fault:
        fault.hint = in_flags(fault.hint)
        raise
