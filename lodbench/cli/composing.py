"""A configuration as Hydra composes it from lodbench's files, those of plug-ins and what is typed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from omegaconf import DictConfig


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
