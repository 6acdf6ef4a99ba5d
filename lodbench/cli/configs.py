"""Files of configuration, lodbench's own and those of plug-ins: read without Hydra, or composed by it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from lodbench.errors import ConfigError
from lodbench.plugins import config_folders

if TYPE_CHECKING:
    from omegaconf import DictConfig

# What OmegaConf makes more of than YAML does: references to other settings, and 1e-3, a text in YAML 1.1.
_OF_OMEGACONF = re.compile(r"\$\{|\d[eE]")


def config_files(group: str, ending: str = ".yaml") -> dict[str, Path]:
    """Returns the files of a group such as ``source`` by name; lodbench's own go before those of plug-ins."""
    found: dict[str, Path] = {}
    for _, _, folder in config_folders():
        for file in sorted((folder / group).glob(f"*{ending}")) if folder is not None else ():
            found.setdefault(file.name.removesuffix(ending), file)
    return found


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
