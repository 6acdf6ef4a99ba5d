"""What is wrong with settings, in one line and the nearest names, where Hydra says it in many."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from lodbench.cli.composing import composed
from lodbench.cli.configs import config_files, read_config
from lodbench.cli.setting_help import Group, groups_of, settings_of_group
from lodbench.errors import ConfigError, nearest_names
from lodbench.plugins import plugin_names


def explained(error: Exception, config_name: str, words: Sequence[str]) -> ConfigError:
    """Returns Hydra's complaint about words as one line and, for an unknown key, the nearest known ones."""
    from hydra.errors import OverrideParseException

    text = str(error)
    option = re.search(
        r"Could not find '([^']+)/([^'/]+)'[\s\S]*?Available options in '[^']+':([\s\S]*)", text
    )
    if option:
        known = [line.strip() for line in option[3].splitlines() if line.strip()]
        known = [name for name in known if re.fullmatch(r"[\w.-]+", name)]
        group = {each.folder: each.key for each in groups_of(config_name)}.get(option[1], option[1])
        if option[2] in plugin_names(f"{option[1]}s"):
            return ConfigError(
                f"The package of the {group} {option[2]!r} brings no conf/{option[1]}/{option[2]}.yaml.",
                "docs/plugins.md says what it holds; the entry point lodbench.config_sources names conf.",
            )
        return ConfigError(f"There is no {group} {option[2]!r}.", nearest_names(option[2], known))
    key = re.search(r"Could not override '([^']+)'", text)
    if key:
        return _unknown(key[1], config_name, words)
    merged = re.search(r"Error merging override (.*)", text)
    if merged:
        return ConfigError(
            f"{merged[1]} is of another kind than its setting.", f"lodbench {config_name} --help"
        )
    several = re.search(r"Ambiguous value for argument '([^'=]+)=([^']*)'", text)
    if several:
        name, values = several.groups()
        hint = f"Add --multirun for a run of each, or write {name}=[{values}] for a list."
        return ConfigError(f"{name}={values} has several values.", hint)
    if isinstance(error, OverrideParseException):
        for word in words:
            if not word.startswith("-") and not _is_override(word):
                return _unread(word, config_name)
    return ConfigError(f"The command line cannot be read: {text.splitlines()[0]}", "Settings are key=value.")


def _is_override(word: str) -> bool:
    """Returns whether Hydra's grammar has a meaning for a word."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        OverridesParser.create().parse_override(word)
    except HydraException:
        return False
    return True


def _unread(word: str, config_name: str) -> ConfigError:
    """Returns what is wrong with a word that is no override."""
    key, equals, value = word.partition("=")
    if not equals or not re.fullmatch(r"[+~]*[\w./@-]+", key):
        hint = "Settings are key=value."
        if config_name == "run" and Path(word).is_dir():
            hint = f"Settings are key=value: dataset=folder dataset.root={word} city=FILE"
        elif config_name == "run" and Path(word).is_file():
            hint = "Settings are key=value. A photo's place is found by: lodbench localize PHOTO --city FILE"
        return ConfigError(f"{word} is not a setting.", hint)
    return ConfigError(
        f"{word} cannot be read: some of {value!r} has a meaning of its own here.",
        f"Quote a value that holds = , : or brackets: '{key}=\"{value}\"'.",
    )


def _unknown(key: str, config_name: str, words: Sequence[str]) -> ConfigError:
    """Returns that a key is not a setting, and similar ones: here, in a section, or of another choice."""
    groups = {group.key: group for group in groups_of(config_name)}
    choice = re.compile(rf"(\w+@)?({'|'.join(map(re.escape, groups))})=[\w.-]+")
    overrides = [word for word in words if choice.fullmatch(word)]
    config = composed(config_name, overrides)
    parent, _, name = key.rpartition(".")
    section = OmegaConf.select(config, parent) if parent else config
    if not isinstance(section, DictConfig):
        section, parent, name = config, "", key.split(".")[0]
    known = [str(each) for each in section]
    inside = [f"{each}.{name}" for each in groups if not parent and name in (config.get(each) or {})]
    if inside:
        return ConfigError(f"{key} is not a setting.", f"Did you mean {' or '.join(inside)}?")
    for each in [parent] if parent in groups else [] if parent else groups:
        if others := _choices_with(name, groups[each]):
            chosen = f" of {parent}={config[parent].get('name')}" if parent else ""
            what = "It" if parent else f"{each}.{name}"
            return ConfigError(f"{key} is not a setting{chosen}.", f"{what} is one of {', '.join(others)}.")
    return ConfigError(f"{key} is not a setting.", nearest_names(name, known))


def _choices_with(name: str, group: Group) -> list[str]:
    """Returns the choices of a group that have a setting, as typed; those that cannot do without first."""
    files = config_files(group.folder)
    return [
        f"{group.key}={choice}"
        for choice in sorted(files, key=lambda choice: name in (read_config(group.folder, choice) or {}))
        if any(s.key == f"{group.key}.{name}" for s in settings_of_group(group.key, group.folder, choice))
    ]
