"""The words of commands in Hydra's grammar: settings as KEY=VALUE or --KEY VALUE, and former names."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

from lodbench.cli.parser import tell_old_name
from lodbench.errors import ConfigError, nearest_names

# Hydra's own flags; the second part takes a value.
_FLAGS = {"-m", "--multirun", "--resolve", "--retry-failed"}
_FLAGS_WITH_VALUE = {"-c", "--cfg", "-p", "--package", "--info", "-i"}
_FLAGS_OF_HYDRA = _FLAGS | _FLAGS_WITH_VALUE
# What every command calls by one name, and where it stands in the configuration of these.
_SHORT = {"city": "dataset.city_model", "root": "dataset.root"}
SETTINGS_COMMANDS = ("run", "basin", "evaluate", "render", "generate-training-data", "train")
_OF_DATASETS = ("run", "basin", "evaluate")


def settings_of(command: str, words: Sequence[str]) -> list[str]:
    """Returns the words of a command with its settings as KEY=VALUE, under the names they have inside.

    Raises:
        ConfigError: A flag is followed by no value.
    """
    found: list[str] = []
    rest = list(words)
    while rest:
        word = rest.pop(0)
        if word in _FLAGS_WITH_VALUE:
            found += [word, *rest[:1]]
            rest = rest[1:]
        elif word in _FLAGS or not word.startswith("-") or word.split("=")[0] in _FLAGS_WITH_VALUE:
            found.append(word)
        else:
            found.append(_as_setting(command, word, rest))
    return [_current(command, word) for word in found]


def _as_setting(command: str, word: str, rest: list[str]) -> str:
    """Returns ``--key value`` and ``--key=value`` as ``key=value``; takes the value from the words left."""
    name, equals, value = word.lstrip("-").partition("=")
    is_misspelt = not equals and difflib.get_close_matches(word, _FLAGS, n=1, cutoff=0.8)
    if not word.startswith("--") or not name or is_misspelt:
        raise ConfigError(f"lodbench {command} has no option {word}.", nearest_names(word, _FLAGS))
    if not equals:
        if not rest or rest[0].startswith("--"):
            raise ConfigError(f"{word} has no value.", f"Settings are {name}=VALUE or --{name} VALUE.")
        value = rest.pop(0)
    return f"{name.replace('-', '_')}={value}"


def _current(command: str, word: str) -> str:
    """Returns a setting under the name it has inside."""
    key, equals, value = word.partition("=")
    if equals and command in _OF_DATASETS and key in _SHORT:
        return f"{_SHORT[key]}={value}"
    return word


def has_flags_alone(words: Sequence[str]) -> bool:
    """Tells whether settings were typed as ``--KEY VALUE``, and none as ``KEY=VALUE``."""
    flags = [word for word in words if word.startswith("--") and word.split("=")[0] not in _FLAGS_OF_HYDRA]
    return bool(flags) and not any("=" in word for word in words if not word.startswith("-"))


def names_method(words: Sequence[str]) -> bool:
    """Tells whether words of `lodbench train` are of a method's training, not of a segmenter's."""
    return any(word.removeprefix("--").split("=")[0] == "method" for word in words)


def short_name(command: str, key: str) -> str:
    """Returns what a command calls a setting that has a shorter name than it has inside."""
    short = {inside: name for name, inside in _SHORT.items()} if command in _OF_DATASETS else {}
    return short.get(key, key)


def present_name(command: str, key: str) -> str:
    """Returns what a setting is called now, where the name that it has inside goes."""
    return "city" if command in _OF_DATASETS and key == _SHORT["city"] else key


def is_read(command: str, key: str) -> bool:
    """Tells whether a command reads a setting of a group that it shares with others."""
    return (command, key) != ("generate-training-data", "executor.share")


def tell_old_names(command: str, words: Sequence[str]) -> None:
    """Says of a command's words that were renamed what they are called now."""
    if command in _OF_DATASETS and any(word.startswith(f"{_SHORT['city']}=") for word in words):
        tell_old_name(f"{_SHORT['city']}=", "city=")
