"""Datasets and priors by name: from an entry point and settings to a dataset."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from functools import partial
from inspect import signature
from typing import Any

from lodbench.datasets.prior_sources import Priors
from lodbench.datasets.query import Dataset
from lodbench.params import to_params
from lodbench.plugins import blaming, load_plugin, of_kind


def dataset_opener(values: Mapping[str, Any]) -> tuple[Callable[[Any], Dataset], Any]:
    """Returns what opens the dataset that a configuration's section describes, and its parameters.

    Raises:
        LodbenchError: The dataset is unknown or a setting is wrong.
    """
    name = str(values.get("name", ""))
    opener = load_plugin("datasets", name)
    with blaming("datasets", name, "take its settings"):
        return partial(_opened, opener, name), to_params(values, _params_type(opener), "dataset")


def open_dataset(values: Mapping[str, Any]) -> Dataset:
    """Returns the dataset that a configuration's section describes.

    Raises:
        LodbenchError: It is unknown, a setting is wrong, or the data is missing or malformed.
    """
    opener, params = dataset_opener(values)
    return opener(params)


def dataset_settings(name: str) -> set[str]:
    """Returns the names of the settings that a dataset takes.

    Raises:
        ConfigError: It is unknown, or broken.
    """
    opener = load_plugin("datasets", name)
    with blaming("datasets", name, "take its settings"):
        return {field.name for field in fields(_params_type(opener))}


def make_priors(name: str, settings: Mapping[str, Any]) -> Priors:
    """Returns what draws priors of a kind.

    Args:
        name: An entry point under ``lodbench.priors``.
        settings: Of it.

    Raises:
        LodbenchError: The kind is unknown, or a setting is wrong.
    """
    kind = load_plugin("priors", name)
    with blaming("priors", name, "take its settings"):
        made: Priors = to_params(settings, kind, "prior")
        return made


def draw_priors(dataset: Dataset, name: str, priors: Priors, seed: int) -> Dataset:
    """Returns a dataset with priors that those of a kind draw.

    Raises:
        LodbenchError: The priors cannot be had.
    """
    with blaming("priors", name, "be drawn"):
        drawn = of_kind(priors.apply(dataset, seed), Dataset)
        of_kind(priors.describe(), str)  # a run asks for it at its end
        return drawn


def _opened(opener: Callable[[Any], object], name: str, params: Any) -> Dataset:
    with blaming("datasets", name, "be opened"):
        return of_kind(opener(params), Dataset)


def _params_type(opener: Callable[..., object]) -> Any:
    (parameter,) = signature(opener, eval_str=True).parameters.values()
    return parameter.annotation
