"""Hints in the syntax of the command typed: `--lod 2` where a library says ``lod=2``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import fields

from lodbench.citymodel.options import ReadOptions
from lodbench.cli.setting_words import SETTINGS_COMMANDS, has_flags_alone, short_name

_FLAGS = {
    "crs": "--crs",
    "date": "--date",
    "lod": "--lod",
    "roof_height": "--roof-height",
    "city": "--city",
    "method": "--method",
    "segmenter": "--segmenter",
    "dataset.root": "--root",
    "dataset.crs": "--crs",
    "dataset.lod": "--lod",
    "dataset.camera_height_m": "--camera-height",
    "dataset.building_share": "--building-share",
}
# Commands that read a finished run: where the data lies now is not what they are about.
_OF_RUNS = ("verify", "report", "export", "leaderboard")
# What else benches call settings.
_OF_BENCHES = {
    **dict.fromkeys(("accuracy", "flights"), ("--lod ", "--map-lod ")),
    "real": ("--root ", "--query "),
}
_OPTIONS = {field.name: f"--option {field.name}" for field in fields(ReadOptions)}
# These take settings as ``KEY=VALUE`` alone.
_CHECKS = ("check-method", "check-plugin")
# Settings of these are words of one option.
_OF_PART = re.compile(r"(?<![\w.])(method|segmenter)\.(?=\w+=)")
_ANY_SETTING = re.compile(r"(?<![\w./'\"-])([a-z][\w.]*)=(?=[^\s=])")
_NAMED = re.compile(rf"(lodbench (?:{'|'.join(SETTINGS_COMMANDS)})\b)")
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


def in_syntax_of(words: Sequence[str], hint: str) -> str:
    """Returns a hint in the syntax of the command that was typed: settings as it has them, or flags.

    Args:
        words: The command and all that follows it.
        hint: As a library has it: settings as ``KEY=VALUE``.

    Example:
        >>> in_syntax_of(["run", "dataset=folder"], "Set dataset.root=FOLDER.")
        'Set dataset.root=FOLDER.'
        >>> in_syntax_of(["run", "--dataset", "folder"], "Set dataset.root=FOLDER.")
        'Give --root FOLDER.'
        >>> in_syntax_of(["localize", "a.jpg"], "Set segmenter=NAME, or: lodbench run method=region.")
        'Give --segmenter NAME, or: lodbench run method=region.'
        >>> in_syntax_of(["check-plugin", "segmenter", "mine"], "Set segmenter.weights=FILE.")
        'Set segmenter.weights=FILE.'
        >>> in_syntax_of(["verify", "RUN"], "Set dataset.root=FOLDER.")
        'Give --dataset-root FOLDER.'
        >>> in_syntax_of(["bench", "flights"], "Ask for lod=2.2.")
        'Ask for --map-lod 2.2.'
    """
    if words[0] in _CHECKS:
        return hint
    if words[0] in SETTINGS_COMMANDS:
        return _as_long_flags(words[0], hint) if has_flags_alone(words[1:]) else hint
    # Another command that a hint names in full keeps its own syntax.
    own, named, rest = _NAMED.split(hint, maxsplit=1) if _NAMED.search(hint) else (hint, "", "")
    own = in_flags(own)
    if words[0] in _OF_RUNS:
        own = own.replace("--root ", "--dataset-root ")
    elif words[0] == "bench" and len(words) > 1 and words[1] in _OF_BENCHES:
        own = own.replace(*_OF_BENCHES[words[1]])
    return own + named + rest


def _as_long_flags(command: str, hint: str) -> str:
    def flag(match: re.Match[str]) -> str:
        return f"--{short_name(command, match[1])} "

    return _ANY_SETTING.sub(flag, hint).replace("Set --", "Give --")
