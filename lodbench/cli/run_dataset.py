"""The dataset that a configuration describes: opened, with the priors and the city reading it asks for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from inspect import signature
from typing import Any

from lodbench.cli.source_profiles import profile_of
from lodbench.datasets.prior_sources import FilePrior, Priors, prior_digest
from lodbench.datasets.query import Dataset
from lodbench.params import to_params
from lodbench.plugins import blaming, load_plugin

# What names the run folder leaves out paths, whose content is named instead, and how work is spread.
# The origin of a published dataset is withheld for privacy, so it is not written down either.
_PATHS_IN_DATASET = {"root", "city_model", "origin"}
_PATHS_IN_OPTIONS = {"terrain"}


def data_identity(dataset_params: Any, source: dict[str, Any]) -> dict[str, Any]:
    """Returns the settings of a dataset and its source, less paths: their content is named instead."""
    options = _without(source.get("options") or {}, _PATHS_IN_OPTIONS)
    return {
        "dataset": _without(asdict(dataset_params), _PATHS_IN_DATASET),
        "source": {**source, "options": options},
    }


def with_prior(dataset: Dataset, values: dict[str, Any], seed: int) -> tuple[Dataset, dict[str, Any]]:
    """Returns a dataset with the priors a section asks for, and that section checked.

    In it the digest of a file of priors stands for its path.

    Raises:
        LodbenchError: The kind of prior is unknown, a setting is wrong, or the priors cannot be had.
    """
    name, settings = str(values.get("name", "")), {key: v for key, v in values.items() if key != "name"}
    kind = load_plugin("priors", name)
    with blaming("priors", name, "be drawn"):
        priors: Priors = to_params(settings, kind, "prior")
        dataset = priors.apply(dataset, seed)
    stated = {"name": name, **asdict(priors)}  # type: ignore[call-overload]
    if name == FilePrior.name:
        stated = {"name": name}
        if settings.get("path") is not None:
            stated["content"] = prior_digest(dataset.entries)
    return dataset, stated


def dataset_opener(values: dict[str, Any]) -> tuple[Callable[[Any], Dataset], Any]:
    """Returns what opens the dataset that a configuration's section describes, and its parameters.

    Raises:
        LodbenchError: The dataset is unknown or a setting is wrong.
    """
    name = str(values.get("name", ""))
    opener = load_plugin("datasets", name)
    with blaming("datasets", name, "take its settings"):
        (parameter,) = signature(opener, eval_str=True).parameters.values()
        return partial(_opened, opener, name), to_params(values, parameter.annotation, "dataset")


def _opened(opener: Callable[[Any], object], name: str, params: Any) -> Dataset:
    with blaming("datasets", name, "be opened"):
        dataset = opener(params)
        if not isinstance(dataset, Dataset):
            raise TypeError(f"it returned {type(dataset).__name__} instead of a Dataset")
    return dataset


def open_dataset(values: dict[str, Any]) -> Dataset:
    """Returns the dataset that a configuration's section describes.

    Raises:
        LodbenchError: It is unknown, a setting is wrong, or the data is missing or malformed.
    """
    opener, params = dataset_opener(values)
    return opener(params)


def with_source(dataset: Dataset, values: dict[str, Any]) -> Dataset:
    """Returns a dataset whose city is read as the source says; the dataset's own words go before it."""
    source = profile_of(values, dataset.city_options.crs)
    lod = source.lod if dataset.lod is None else dataset.lod
    # The frame of the data is no habit of a publisher: it was told by the data.
    own = dataset.city_options
    layers = own.layers or source.options.layers
    options = replace(source.options, ecef_origin=own.ecef_origin, layers=layers)
    return replace(dataset, lod=lod, city_options=options)


def _without(values: dict[str, Any], names: set[str]) -> dict[str, Any]:
    return {key: value for key, value in values.items() if key not in names}
