"""Commands in Hydra's grammar: composing the configuration, and turning its faults into one line."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from lodbench.cli import settings
from lodbench.cli.parser import report_fault
from lodbench.errors import ConfigError, LodbenchError, nearest_names
from lodbench.plugins import config_files, config_folders, plugin_names

if TYPE_CHECKING:
    from omegaconf import DictConfig


# Keys whose value is a path: quoted for Hydra, whose grammar gives commas, brackets and = a meaning.
PATH_KEYS = frozenset(
    {
        "dataset.root",
        "dataset.city_model",
        "source.options.terrain",
        "source.options.surface",
        "source.options.orthophoto",
        "city",
        "poses",
        "intrinsics",
        "images",
        "out",
        "data",
        "val_data",
        "init",
        "segmenter.weights",
        "segmenter.folder",
        "segmenter.encoder_weights",
        "method.weights",
        "texture_model",
        "props",
        "terrain",
        "paths.runs",
        "paths.data_root",
        "prior.path",
        "runner.python",
    }
)
# Below these any key may be set: ReadOptions checks them, profiles name only those they change.
_FREE_KEYS = ("source.options.", "method.settings.")
_SWEEP_FLAGS = ("-m", "--multirun")
_is_registered = False


def run_hydra(command: str, config_name: str, task: Callable[[DictConfig], None], argv: Sequence[str]) -> int:
    """Composes the configuration of a command and runs its task, once or per job of a sweep.

    A job of a sweep that fails is reported on standard error, by what it has apart from the others, and
    does not keep them from running.

    Returns:
        The exit code: 0, or 2 if a job of a sweep failed.

    Raises:
        LodbenchError: An override is malformed, unknown or of the wrong type; or the only job's own.
        Exception: What else a job raised, as it was raised; the jobs after it are not run.
    """
    from hydra.core.hydra_config import HydraConfig

    jobs: list[list[str]] = []
    faults: dict[int, LodbenchError] = {}
    crashes: list[Exception] = []

    def job(config: DictConfig) -> None:
        if crashes:
            return
        jobs.append(list(HydraConfig.get().overrides.task))
        try:
            task(config)
        except LodbenchError as fault:
            faults[len(jobs) - 1] = fault
        # Kept from Hydra, which has words of its own for it, and from what is caught below.
        except Exception as error:
            crashes.append(error)

    typed, argv = argv, settings.settings_of(command, argv)
    _run_jobs(command, config_name, job, argv)
    if crashes:
        raise crashes[0]
    if faults and not any(word in _SWEEP_FLAGS for word in argv):
        raise faults[0]
    _report_faults(jobs, faults)
    settings.report_old_names(command, typed)
    return 2 if faults else 0


def _run_jobs(command: str, config_name: str, job: Callable[[DictConfig], None], argv: Sequence[str]) -> None:
    """Runs each job of a command with the configuration that Hydra composes."""
    from hydra.errors import HydraException
    from yaml import YAMLError

    register_config_sources()
    words = _hydra_words(argv, config_name)
    try:
        if any(word.lstrip("+~").startswith(("-", "hydra")) for word in words):
            _let_hydra_run(command, config_name, job, words)
        else:
            job(single_job(config_name, words))
    except YAMLError as error:
        raise ConfigError(f"A file of settings cannot be read: {' '.join(str(error).split())}.") from error
    except RecursionError as error:
        raise ConfigError("A setting is nested too deeply.", "Lists of numbers have one level.") from error
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        raise explained(error, config_name, words) from error


def single_job(config_name: str, words: list[str]) -> DictConfig:
    """Returns the configuration of a single job, composed once: Hydra's own entry does so twice.

    What Hydra would do around a job besides, folders, logs and callbacks, is left out.

    Args:
        config_name: Of the command's file.
        words: As Hydra reads them.

    Raises:
        HydraException: As of ``composed``.
    """
    from hydra.core.hydra_config import HydraConfig

    config = composed(config_name, words, return_hydra_config=True)
    # For ${hydra:...}.
    HydraConfig.instance().set_config(config)
    config = deepcopy(config)
    OmegaConf.set_readonly(config, False)
    with open_dict(config):
        del config["hydra"]
    return config


def _let_hydra_run(
    command: str, config_name: str, job: Callable[[DictConfig], None], words: list[str]
) -> None:
    """Lets Hydra run the jobs of a sweep, or whatever else its own words ask for."""
    import hydra

    # Hydra would print the fault and exit by itself; with this it lets the exception through.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    saved, sys.argv = sys.argv, [f"lodbench {command}", *words]
    try:
        hydra.main(config_path="pkg://lodbench.conf", config_name=config_name, **hydra_version())(job)()
    finally:
        sys.argv = saved


def _report_faults(jobs: Sequence[Sequence[str]], faults: dict[int, LodbenchError]) -> None:
    for number, fault in faults.items():
        report_fault(LodbenchError(f"{_own_words(jobs, number)}: {fault.message.marked}", fault.hint))


def _own_words(jobs: Sequence[Sequence[str]], number: int) -> str:
    """Returns the overrides that tell a job of a sweep from the others; all of them where none does."""
    shared = set(jobs[0]).intersection(*jobs) if len(jobs) > 1 else set()
    own = [word for word in jobs[number] if word not in shared]
    return " ".join(own or jobs[number]) or "the only job"


def quote_path(word: str) -> str:
    """Returns an override with a path, or a word beyond ASCII, quoted: Hydra takes it as it stands."""
    key, equals, value = word.partition("=")
    is_quoted = len(value) >= 2 and value[0] in "'\"" and value[0] == value[-1]
    is_text = key.lstrip("+") in PATH_KEYS or not (value.isascii() or value[0] in "[{" or "," in value)
    if not equals or value in ("", "null") or not is_text or is_quoted:
        return word
    # Hydra takes a backslash as it stands, but for those before a quote or the end.
    escaped = re.sub(r'(\\*)(?="|$)', r"\1\1", value).replace('"', '\\"').replace("${", "\\${")
    return f'{key}="{escaped}"'


def _hydra_words(argv: Sequence[str], config_name: str) -> list[str]:
    """Returns words as Hydra reads them: its flags before the overrides, paths quoted, groups in place."""
    placed = {group.key: f"{group.folder}@{group.key}" for group in settings.groups_of(config_name)}
    others = [word for word in argv if word not in _SWEEP_FLAGS]
    flags = [word for word in argv if word in _SWEEP_FLAGS]
    quoted = _quoted_paths if flags else quote_path
    return flags + [free_option(quoted(_in_place(word, placed))) for word in others]


def _quoted_paths(word: str) -> str:
    """Returns an override of a sweep as ``quote_path`` does, one value for each of several files."""
    key, _, value = word.partition("=")
    paths = value.split(",")
    # A file's name may hold commas of its own.
    if key not in PATH_KEYS or _is_there(value) or not all(map(_is_there, paths)):
        return quote_path(word)
    return f"{key}=" + ",".join(quote_path(f"{key}={path}").partition("=")[2] for path in paths)


def _is_there(path: str) -> bool:
    return Path(path).expanduser().exists()


def _in_place(word: str, placed: Mapping[str, str]) -> str:
    """Returns a choice of a group as Hydra wants it of one that stands elsewhere: ``training@look=hard``."""
    key, equals, value = word.partition("=")
    is_elsewhere = equals and placed.get(key, f"{key}@{key}") != f"{key}@{key}"
    return f"{placed[key]}={value}" if is_elsewhere else word


def free_option(word: str) -> str:
    """Returns an override of a source's option marked for Hydra as one that the profile need not name."""
    return f"++{word}" if word.startswith(_FREE_KEYS) else word


def plain(config: DictConfig) -> dict[str, Any]:
    """Returns a configuration as JSON values, all references resolved.

    Raises:
        ConfigError: A value that must be given (``???``) is missing.
    """
    missing = sorted(OmegaConf.missing_keys(config))
    if missing:
        raise ConfigError(f"`{missing[0]}` is not set.", f"Add `{missing[0]}=VALUE`.")
    values = OmegaConf.to_container(config, resolve=True)
    return {str(key): value for key, value in dict(values).items()}  # type: ignore[arg-type]


def section(values: dict[str, Any], name: str) -> dict[str, Any]:
    """Returns a section of the configuration.

    Raises:
        ConfigError: It was taken away or set to something else.
    """
    group = values.get(name)
    if not isinstance(group, dict):
        raise ConfigError(f"{name} is a group of settings, not {group}.", f"Leave {name} out, or name one.")
    return group


def register_config_sources() -> None:
    """Lets installed plug-ins add their configuration folders (entry points `lodbench.config_sources`)."""
    global _is_registered
    if _is_registered:
        return
    from hydra.core.plugins import Plugins
    from hydra.plugins.search_path_plugin import SearchPathPlugin

    class LodbenchSources(SearchPathPlugin):
        def manipulate_search_path(self, search_path: Any) -> None:
            for package, module, folder in config_folders():
                if module != "lodbench.conf" and folder is not None:
                    search_path.append(provider=package, path=f"file://{folder}")

    Plugins.instance().register(LodbenchSources)
    _is_registered = True


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
        group = {each.folder: each.key for each in settings.groups_of(config_name)}.get(option[1], option[1])
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
    groups = {group.key: group for group in settings.groups_of(config_name)}
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


def _choices_with(name: str, group: settings.Group) -> list[str]:
    """Returns the choices of a group that have a setting, as typed; those that cannot do without first."""
    files = config_files(group.folder)
    return [
        f"`{group.key}={choice}`"
        for choice in sorted(
            files, key=lambda choice: name in (settings.read_config(group.folder, choice) or {})
        )
        if any(
            s.key == f"{group.key}.{name}"
            for s in settings.settings_of_group(group.key, group.folder, choice)
        )
    ]


def composed(config_name: str, words: Sequence[str], return_hydra_config: bool = False) -> DictConfig:
    """Returns a command's configuration.

    Args:
        config_name: Of the command's file.
        words: As Hydra reads them.
        return_hydra_config: With what Hydra says of itself, under ``hydra``.

    Raises:
        HydraException: A word means nothing to Hydra, or names no setting.
    """
    from hydra import compose, initialize_config_module

    with initialize_config_module("lodbench.conf", job_name=config_name, **hydra_version()):
        return compose(config_name, list(words), return_hydra_config)


def hydra_version() -> dict[str, str]:
    """Returns what tells Hydra which of its versions to be like; from 1.4 on it knows one."""
    import hydra

    return {"version_base": "1.3"} if hydra.__version__ < "1.4" else {}
