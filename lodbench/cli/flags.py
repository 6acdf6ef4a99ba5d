"""Options that a message names, in the syntax of the command: `--lod 2` where a library says `lod=2`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

from lodbench.citymodel.options import ReadOptions
from lodbench.cli.setting_help import SETTINGS_COMMANDS, has_flags_alone, short_name
from lodbench.errors import Option, Words

# Settings whose flags have other names, in all commands.
_FLAGS = {
    **{field.name: "--option" for field in fields(ReadOptions)},
    "dataset.root": "--root",
    "dataset.crs": "--crs",
    "dataset.lod": "--lod",
    "dataset.camera_height_m": "--camera-height",
    "dataset.building_share": "--building-share",
    **{
        name: f"--{name.replace('_', '-')}"
        for name in ("crs", "date", "lod", "roof_height", "city", "method", "segmenter")
    },
}
_OF_VIEWS = {
    "lod": "--map-lod",
    "dataset.num_views": "--views",
    "dataset.mask_iou": "--mask-iou",
    "dataset.tilt_deg": "--tilt-width",
    "dataset.range_m": "--prior-range",
    "dataset.height_m": "--prior-height",
}
# ... and in some: a finished run has a city of its own, benches draw their dataset.
_FLAGS_OF = {
    **{name: {"dataset.root": "--dataset-root"} for name in ("verify", "report", "export", "leaderboard")},
    "bench accuracy": _OF_VIEWS,
    "bench flights": {"lod": "--map-lod"},
    "bench real": {"dataset.root": "--query"},
    "dataset prior": {"prior": "--kind"},
}
# Settings of a part are words of one flag.
_PARTS = {"method": "--method-option", "segmenter": "--segmenter-option", "prior": "--set"}
# These take settings as ``KEY=VALUE`` alone.
_CHECKS = ("check-method", "check-plugin")


def in_syntax_of(words: Sequence[str], text: Words) -> Words:
    """Returns a message with its options in the syntax of the command that was typed.

    Args:
        words: The command and all that follows it.
        text: As a library has it.

    Example:
        >>> root = Words("Set `dataset.root=FOLDER`.")
        >>> in_syntax_of(["run", "dataset=folder"], root)
        'Set dataset.root=FOLDER.'
        >>> in_syntax_of(["run", "--dataset", "folder"], root)
        'Set --root FOLDER.'
        >>> in_syntax_of(["verify", "RUN"], root)
        'Set --dataset-root FOLDER.'
        >>> in_syntax_of(["localize", "a.jpg"], Words("`default_height_m=9`, or lodbench run method=region."))
        '--option default_height_m=9, or lodbench run method=region.'
        >>> in_syntax_of(["check-plugin", "segmenter", "mine"], Words("Set `segmenter.weights=FILE`."))
        'Set segmenter.weights=FILE.'
        >>> in_syntax_of(["bench", "flights"], Words("Ask for `lod=2.2`."))
        'Ask for --map-lod 2.2.'
    """
    command = words[0]
    if command in SETTINGS_COMMANDS and has_flags_alone(words[1:]):
        return text.rewritten(lambda option: _flag(option, f"--{short_name(command, option.name)}"))
    if command in SETTINGS_COMMANDS or command in _CHECKS:
        return text
    own = _FLAGS | _FLAGS_OF.get(command, {}) | _FLAGS_OF.get(" ".join(words[:2]), {})
    return text.rewritten(lambda option: _flag(option, own.get(option.name, _part(option))))


def _part(option: Option) -> str:
    section, _, name = option.name.partition(".")
    return _PARTS.get(section, "") if name else ""


def _flag(option: Option, flag: str) -> str:
    """Returns an option as a flag, which may be one that is followed by KEY=VALUE; "" leaves it."""
    if option.is_flag or not flag:
        return option.words
    takes_pair = flag in ("--option", *_PARTS.values())
    value = option.words.partition(".")[2] or option.words if takes_pair else option.value
    return f"{flag} {value}".rstrip()
