"""Commands of settings: their words, their help from the YAML, and messages in the syntax that was typed."""

from __future__ import annotations

import difflib
import inspect
import re
from collections.abc import Iterator, Sequence
from importlib import import_module
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple, cast, get_type_hints

from lodbench.cli.parser import ACTIONS, COMMANDS, report_old_name
from lodbench.errors import ConfigError, Option, Words, nearest_names
from lodbench.params import flags_of
from lodbench.plugins import config_files, config_folders, find_plugin

# Hydra's own flags; the second part takes a value.
_FLAGS = {"-m", "--multirun", "--resolve", "--retry-failed"}
_FLAGS_WITH_VALUE = {"-c", "--cfg", "-p", "--package", "--info", "-i"}
_FLAGS_OF_HYDRA = _FLAGS | _FLAGS_WITH_VALUE
# What every command calls by one name, and where it stands in the configuration of these.
_SHORT = {"city": "dataset.city_model", "root": "dataset.root"}
SETTINGS_COMMANDS = ("run", "basin", "evaluate", "render", "generate-training-data", "train")
_OF_DATASETS = ("run", "basin", "evaluate")
_LINE = re.compile(r"(?P<indent> *)(?P<key>[\w.-]+):(?: +(?P<value>[^#\s][^#]*?))? *(?:# *(?P<meaning>.*))?$")
_DEFAULT = re.compile(r"  - (?P<group>\w+)(?:@(?P<package>\w+))?: *(?P<name>[\w.-]+)")
_ATTRIBUTE = re.compile(r"^ {8}(\w+): (.+(?:\n {12,}.+)*)", re.MULTILINE)
# Groups whose plug-ins' docstrings say what a setting without a comment means.
_PLUGINS = {"method": "methods", "segmenter": "segmenters", "dataset": "datasets", "prior": "priors"}
# Where no option is declared for a setting.
_SAME = {name: f"--{name}" for name in ("city", "crs", "lod", "method", "segmenter")}
# Settings of a part are words of one flag.
_PARTS = {"method": "--method-option", "segmenter": "--segmenter-option", "prior": "--set"}
# These take settings as ``KEY=VALUE`` alone.
_CHECKS = ("check-method", "check-plugin")
# What OmegaConf makes more of than YAML does: references to other settings, and 1e-3, a text in YAML 1.1.
_OF_OMEGACONF = re.compile(r"\$\{|\d[eE]")


def settings_of(command: str, words: Sequence[str]) -> list[str]:
    """Returns the words of a command with its settings as KEY=VALUE, under the names they have inside.

    Raises:
        ConfigError: A flag is followed by no value.
    """
    kept: list[str] = []
    rest = list(words)
    while rest:
        word = rest.pop(0)
        if word in _FLAGS_WITH_VALUE:
            kept += [word, *rest[:1]]
            rest = rest[1:]
        elif word in _FLAGS or not word.startswith("-") or word.split("=")[0] in _FLAGS_WITH_VALUE:
            kept.append(word)
        else:
            kept.append(_as_setting(command, word, rest))
    return [_current(command, word) for word in kept]


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


def report_old_names(command: str, words: Sequence[str]) -> None:
    """Says of a command's words that were renamed what they are called now."""
    if command in _OF_DATASETS and any(word.startswith(f"{_SHORT['city']}=") for word in words):
        report_old_name(f"{_SHORT['city']}=", "city=")


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
    groups = []
    for line in config_text(config_name).splitlines():
        match = _DEFAULT.match(line)
        if match and match["group"] != "override":
            groups.append(Group(match["package"] or match["group"], match["group"], match["name"]))
    return groups


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
    own = _flags_declared(words)
    return text.rewritten(lambda option: _flag(option, own.get(option.name, _part(option))))


def _flags_declared(words: Sequence[str]) -> dict[str, str]:
    """Returns the flags of a command by the settings that they set, as its ``OPTIONS`` declare them."""
    command, action = words[0], words[1] if len(words) > 1 else ""
    place = ACTIONS.get(action, ("",))[0] if command == "dataset" else COMMANDS.get(command, ("",))[0]
    module = import_module(place.partition(":")[0]) if place else None
    kinds: dict[str, type] = getattr(module, "OPTIONS", {})
    kind = kinds.get(f"{command} {action}", kinds.get(command))
    if kind is None:
        return _SAME
    return _SAME | flags_of(kind) if command == "bench" else flags_of(kind)


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


def read_config(group: str, name: str) -> dict[str, Any] | None:
    """Returns what a file of configuration says; None if there is none.

    What it leaves to be set (``???``) is left out, and the paths of a run are not known.

    Raises:
        ConfigError: It cannot be read.
    """
    file = config_files(group).get(name)
    if file is None:
        return None
    try:
        values = _values_of(file, group)
    except Exception as error:  # the YAML reader's faults share no base with OmegaConf's
        raise ConfigError(f"{file} cannot be read: {str(error).splitlines()[0]}") from error
    section = values[group]
    if not isinstance(section, dict):
        raise ConfigError(f"{file} holds no settings.", "Lines are key: value.")
    return {str(key): value for key, value in section.items() if value != "???"}


def _values_of(file: Path, group: str) -> dict[str, Any]:
    """Returns what a file of a group says, under the group's name, references resolved."""
    text = file.read_text(encoding="utf-8")
    if not _OF_OMEGACONF.search(text):
        import yaml

        return {group: yaml.safe_load(text) or {}}
    from omegaconf import OmegaConf

    config = OmegaConf.create({"paths": {"data_root": None, "runs": "runs"}, group: OmegaConf.load(file)})
    return cast("dict[str, Any]", OmegaConf.to_container(config, resolve=True))
