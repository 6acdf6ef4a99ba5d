"""Opening a dataset for commands that take its name, or a folder, as a word."""

from __future__ import annotations

import argparse
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from lodbench.cli.configs import read_config
from lodbench.datasets.query import Dataset
from lodbench.datasets.registry import dataset_settings, open_dataset
from lodbench.errors import ConfigError, nearest_names
from lodbench.plugins import plugin_names


def add_dataset_options(parser: argparse.ArgumentParser) -> None:
    """Adds the word that names a dataset, and where its parts lie."""
    parser.add_argument("dataset", metavar="NAME|DIR", help="a dataset, or a folder in the text layout")
    parser.add_argument("--root", metavar="DIR", help="where a published dataset was unpacked")
    parser.add_argument("--city", metavar="FILE", help="its city model")
    parser.add_argument("--lod", help="level of detail of the city model")


def open_named(options: argparse.Namespace, settings: Sequence[str] = ()) -> Dataset:
    """Returns the dataset that the options name.

    Args:
        options: Of the command.
        settings: Words ``NAME=VALUE``, as ``--set`` has them.

    Raises:
        LodbenchError: It is no name and no folder, or its data is missing or malformed.
    """
    name = options.dataset
    known = plugin_names("datasets")
    if name not in known or name == "folder":
        root = options.root if name == "folder" and options.root else name
        if not Path(root).expanduser().is_dir():
            raise ConfigError(
                f"{root} is neither a dataset nor a folder.", nearest_names(root, set(known) - {root})
            )
        values = {"name": "folder", "root": root, "city_model": options.city, "lod": options.lod}
        values = {key: value for key, value in values.items() if value is not None}
        return open_dataset(values | _set(settings, "folder", dataset_settings("folder")))
    takes = dataset_settings(name)
    given: dict[str, Any] = {"root": options.root, "city_model": options.city, "lod": options.lod}
    values = {key: value for key, value in given.items() if value is not None}
    values |= _set(settings, name, takes)
    refused = sorted(set(values) - takes)
    if refused:
        option = {"root": "--root", "city_model": "--city", "lod": "--lod"}[refused[0]]
        raise ConfigError(f"Dataset {name} takes no {option}.")
    return open_dataset({**(read_config("dataset", name) or {"name": name}), **values})


def _set(words: Sequence[str], dataset: str, takes: Collection[str]) -> dict[str, Any]:
    """Returns the settings of words ``NAME=VALUE``, values read as YAML.

    Raises:
        ConfigError: A word is none, or the dataset has no such setting.
    """
    import yaml

    values: dict[str, Any] = {}
    for word in words:
        name, equals, text = word.removeprefix("dataset.").partition("=")
        if not equals or name not in takes:
            raise ConfigError(f"--set {word}: Dataset {dataset} takes no {name}.", nearest_names(name, takes))
        try:
            values[name] = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise ConfigError(
                f"--set {word} cannot be read as YAML.", "Quote it: --set \"NAME='TEXT'\""
            ) from error
    return values
