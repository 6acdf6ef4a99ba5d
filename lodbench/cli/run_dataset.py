"""The dataset that a configuration describes: opened, with the priors and the city reading it asks for."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from lodbench.citymodel.lifespans import date_in
from lodbench.citymodel.options import PATH_OPTIONS
from lodbench.cli.source_profiles import profile_of
from lodbench.datasets.own import find_mask, require_some_mask
from lodbench.datasets.prior_sources import FilePrior, prior_digest
from lodbench.datasets.query import Dataset
from lodbench.datasets.registry import draw_priors, make_priors
from lodbench.harness.city import open_city

# What names the run folder leaves out paths, whose content is named instead, and how work is spread.
# The origin of a published dataset is withheld for privacy, so it is not written down either.
_PATHS_IN_DATASET = {"root", "city_model", "origin"}


def data_identity(dataset_params: Any, source: dict[str, Any]) -> dict[str, Any]:
    """Returns the settings of a dataset and its source, less paths: their content is named instead."""
    options = _without(source.get("options") or {}, set(PATH_OPTIONS))
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
    priors = make_priors(name, settings)
    dataset = draw_priors(dataset, name, priors, seed)
    stated = {"name": name, **asdict(priors)}  # type: ignore[call-overload]
    if name == FilePrior.name:
        stated = {"name": name}
        if settings.get("path") is not None:
            stated["content"] = prior_digest(dataset.entries)
    return dataset, stated


def with_source(dataset: Dataset, values: dict[str, Any]) -> Dataset:
    """Returns a dataset whose city is read as the source says; the dataset's own words go before it."""
    source = profile_of(values, dataset.city_options.crs)
    lod = source.lod if dataset.lod is None else dataset.lod
    # The frame of the data is no habit of a publisher: it was told by the data.
    own = dataset.city_options
    layers = own.layers or source.options.layers
    options = replace(source.options, ecef_origin=own.ecef_origin, layers=layers)
    textured = dataset.textured_map
    if textured is None and options.orthophoto is not None:
        textured = dataset.city_model  # a surface model under its orthophoto
    return replace(dataset, lod=lod, city_options=options, textured_map=textured)


def with_masks(dataset: Dataset, segmenter: dict[str, Any]) -> Dataset:
    """Returns a dataset with the masks of ``segmenter.folder`` in place of its own, where that is set.

    Raises:
        DatasetError: There is no mask of any photo.
    """
    if segmenter.get("name") != "masks" or not segmenter.get("folder"):
        return dataset
    folder, entries = Path(segmenter["folder"]).expanduser(), dataset.entries
    require_some_mask(folder, [entry.name for entry in entries], [entry.image for entry in entries])
    return replace(
        dataset,
        entries=tuple(replace(e, mask=find_mask(folder, e.name, e.image)) for e in entries),
    )


def with_date(dataset: Dataset, values: dict[str, Any]) -> tuple[Dataset, dict[str, Any]]:
    """Returns a dataset and its source with the date at which its city stood, where any building has an end.

    So a run is one of that date: it reads the same city on any later day.

    Raises:
        CityModelError: The city cannot be read, or has no building at the level of the dataset.
    """
    options = dataset.city_options
    if dataset.city_model is None or options.date is not None:
        return dataset, values
    period = open_city(dataset.city_model, dataset.lod, options, dataset.roof_height).period
    if period is None:
        return dataset, values
    day = date_in(period)
    dated = {**values, "options": {**(values.get("options") or {}), "date": day}}
    return replace(dataset, city_options=replace(options, date=day)), dated


def _without(values: dict[str, Any], names: set[str]) -> dict[str, Any]:
    return {key: value for key, value in values.items() if key not in names}
