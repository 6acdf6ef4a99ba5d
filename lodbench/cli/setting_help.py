"""The help of commands in Hydra's grammar: every setting with its value and its meaning, from the YAML."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Sequence
from importlib import import_module
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple, get_type_hints

from lodbench.cli.configs import config_files
from lodbench.cli.setting_words import is_read, present_name
from lodbench.plugins import config_folders, find_plugin

_LINE = re.compile(r"(?P<indent> *)(?P<key>[\w.-]+):(?: +(?P<value>[^#\s][^#]*?))? *(?:# *(?P<meaning>.*))?$")
_DEFAULT = re.compile(r"  - (?P<group>\w+)(?:@(?P<package>\w+))?: *(?P<name>[\w.-]+)")
_ATTRIBUTE = re.compile(r"^ {8}(\w+): (.+(?:\n {12,}.+)*)", re.MULTILINE)
# Groups whose plug-ins' docstrings say what a setting without a comment means.
_PLUGINS = {"method": "methods", "segmenter": "segmenters", "dataset": "datasets", "prior": "priors"}


class Setting(NamedTuple):
    """A setting: its full key, its value as written, and what it means ("" where nothing says it)."""

    key: str
    value: str
    meaning: str


class Group(NamedTuple):
    """A group of settings that a command takes whole, by name: ``method=region``."""

    key: str
    folder: str
    name: str


def help_text(command: str, config_name: str, words: Sequence[str]) -> str:
    """Returns the help of a command; of groups that the words choose, the chosen one's settings."""
    header, footer = _frame(config_name)
    chosen = dict(word.split("=", 1) for word in words if re.fullmatch(r"\w+=[\w.-]+", word))
    groups = groups_of(config_name)
    example = f"; `lodbench {command} {groups[0].key}=NAME --help` shows another's" if groups else ""
    own = _table(list(settings_in(config_text(config_name))))
    parts = [header, f"Settings: key=value, or --key value{example}.", own]
    for group in groups:
        name = chosen.get(group.key, group.name)
        others = ", ".join(known for known in config_files(group.folder) if known != name)
        head = f"{group.key}={name}" + (f"   (others: {others})" if others else "")
        text = _group_text(group.folder, name)
        about = " ".join(line.lstrip("# ") for line in takewhile(_is_comment, text.splitlines()))
        settings = [
            setting._replace(key=present_name(command, setting.key))
            for setting in settings_of_group(group.key, group.folder, name)
            if is_read(command, setting.key)
        ]
        parts.append("\n".join(filter(None, [head, f"  {about}" if about else "", _table(settings)])))
    return "\n\n".join([*parts, footer]).rstrip() + "\n"


def settings_of_group(key: str, folder: str, name: str) -> list[Setting]:
    """Returns the settings of a group as its file has them, explained there or by docstrings.

    Args:
        key: What the command calls the group; it stands before their names.
        folder: The group's folder in ``conf``.
        name: The file in it; an unknown one has no settings.
    """
    prefix = f"{key}."
    settings = [s for s in settings_in(_group_text(folder, name), prefix) if s.key != f"{prefix}name"]
    if all(setting.meaning for setting in settings):
        return settings
    meanings = _documented(folder, name)
    return [
        setting._replace(meaning=setting.meaning or meanings.get(setting.key.removeprefix(prefix), ""))
        for setting in settings
    ]


def _group_text(folder: str, name: str) -> str:
    file = config_files(folder).get(name)
    return "" if file is None else file.read_text(encoding="utf-8")


def groups_of(config_name: str) -> list[Group]:
    """Returns the groups in a configuration's list of defaults."""
    found = []
    for line in config_text(config_name).splitlines():
        match = _DEFAULT.match(line)
        if match and match["group"] != "override":
            found.append(Group(match["package"] or match["group"], match["group"], match["name"]))
    return found


def settings_in(text: str, prefix: str = "") -> Iterator[Setting]:
    """Yields the settings of a YAML file in its order; Hydra's own and the list of defaults are left out."""
    parent = ""
    for line in text.splitlines():
        match = _LINE.fullmatch(line)
        if match is None:
            continue
        if not match["indent"]:
            parent = ""
            if match["value"] is None:
                parent = match["key"]
                continue
        elif parent in ("", "defaults", "hydra") or match["value"] is None:
            continue
        key = f"{parent}.{match['key']}" if parent else match["key"]
        yield Setting(prefix + key, match["value"], match["meaning"] or "")


def _is_comment(line: str) -> bool:
    return line.startswith("#")


def config_text(config_name: str) -> str:
    """Returns the YAML of a command."""
    return _conf(f"{config_name}.yaml").read_text(encoding="utf-8")


def _conf(name: str) -> Path:
    """Returns a file or folder of lodbench's own configuration."""
    own = next(folder for _, module, folder in config_folders() if module == "lodbench.conf" and folder)
    return own / name


def _frame(config_name: str) -> tuple[str, str]:
    """Returns what stands before and after the settings."""
    import yaml

    name = "lodbench" if config_name == "run" else config_name
    config = yaml.safe_load((_conf("hydra") / "help" / f"{name}.yaml").read_text(encoding="utf-8"))
    return config["header"], config["footer"]


def _table(settings: Sequence[Setting]) -> str:
    width = max((len(f"{s.key}={s.value}") for s in settings), default=0)
    width = min(width, 46)
    lines = []
    for setting in settings:
        word = f"{setting.key}={setting.value}"
        lines.append(f"  {word.ljust(width)}  {setting.meaning}".rstrip())
    return "\n".join(lines)


def _documented(folder: str, name: str) -> dict[str, str]:
    """Returns what the docstrings of a group's parameters say of each, by name."""
    from lodbench.errors import LodbenchError

    try:
        return dict(_attributes(_described_by(folder, name)))
    except LodbenchError:
        return {}  # a package of others may be broken: its settings are shown all the same


def _described_by(folder: str, name: str) -> Any:
    """Returns the class whose docstring tells of a group's settings; None where there is none."""
    if folder == "source":
        from lodbench.citymodel.options import ReadOptions

        return {"options": ReadOptions}
    if folder not in _PLUGINS or name == "auto":
        return None
    plug_in = find_plugin(_PLUGINS[folder], name)
    if plug_in.is_ours:
        package = import_module(plug_in.point.module)
        names = [name for name in getattr(package, "__all__", ()) if name.endswith("Params")]
        if len(names) == 1:
            return getattr(package, names[0])  # without the method itself, which takes a second to load
    part = plug_in.load()
    if inspect.isfunction(part):  # a dataset is opened from its parameters
        return next(iter(get_type_hints(part).values()), None)
    return getattr(part, "params_type", part)


def _attributes(described: Any, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yields name and meaning of what docstrings of a class, its bases and the classes of its fields tell."""
    if isinstance(described, dict):
        for name, kind in described.items():
            yield from _attributes(kind, f"{prefix}{name}.")
    elif inspect.isclass(described):
        for kind in reversed(described.__mro__):
            for name, words in _ATTRIBUTE.findall(kind.__doc__ or ""):
                yield f"{prefix}{name}", " ".join(words.split())
