"""What a configuration describes: a dataset with its priors and city; the process that its method runs in."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from lodbench.citymodel.attributes import date_in
from lodbench.citymodel.options import PATH_OPTIONS
from lodbench.cli.parts import option_pairs, profile_of
from lodbench.cli.settings import settings_of
from lodbench.datasets.own import find_mask, require_some_mask
from lodbench.datasets.prior_sources import FilePrior, prior_digest
from lodbench.datasets.query import Dataset
from lodbench.datasets.registry import draw_priors, make_priors
from lodbench.errors import LodbenchError
from lodbench.findings import FAULT, OK, Check
from lodbench.harness.city import open_city
from lodbench.harness.remote.method import INPROCESS, SUBPROCESS, RemoteMethod, RunnerParams
from lodbench.harness.remote.process import RunnerFault
from lodbench.methods import Method
from lodbench.methods.registry import configure_method
from lodbench.params import to_params
from lodbench.plugins import config_files

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
    # The frame of the data is no habit of a publisher: it was stated by the data.
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


_PREFIX = "runner."


def made_method(values: Mapping[str, Any], runner: RunnerParams, tilt: str) -> tuple[Method, dict[str, Any]]:
    """Returns the method of a configuration's section where it is to run, and its parameters.

    Raises:
        ConfigError: It is unknown, a setting is wrong, or the other Python cannot run it.
    """
    if runner.name == INPROCESS:
        configured = configure_method(values).for_tilt(tilt)
        return configured.make(), asdict(configured.params)
    method = RemoteMethod(values, runner, tilt)
    return method, method.params


def offer_methods(argv: Sequence[str]) -> None:
    """Lets Hydra know methods that a command line names and only its ``runner.python`` has.

    Raises:
        ConfigError: That Python cannot be started, or does not know them either.
    """
    if SUBPROCESS not in "".join(argv) or {"-h", "--help"}.intersection(argv):
        return
    words = dict(word.split("=", 1) for word in settings_of("run", argv) if "=" in word)
    python = words.get(f"{_PREFIX}python")
    if words.get("runner") != SUBPROCESS or not python:
        return
    from hydra.core.config_store import ConfigStore

    for name in filter(None, words.get("method", "").split(",")):
        if name not in config_files("method"):
            method = RemoteMethod({"name": name}, RunnerParams(SUBPROCESS, python))
            method.close()
            ConfigStore.instance().store(group="method", name=name, node=method.params)


def remote_checks(name: str, words: Sequence[str]) -> Iterator[Check]:
    """Yields what there is to say of a method in another Python.

    Raises:
        ConfigError: That Python cannot be started or has no lodbench, or a setting is wrong.
    """
    from lodbench.harness.conformance.methods import check_answers, known_inputs, trial_settings

    reported = {key: value for key, value in option_pairs(words).items() if key.startswith(_PREFIX)}
    runner = to_params(
        {"name": SUBPROCESS, **{key.removeprefix(_PREFIX): value for key, value in reported.items()}},
        RunnerParams,
        "runner",
    )
    settings = {
        key.removeprefix("method."): value
        for key, value in option_pairs(words).items()
        if key not in reported
    }

    def make() -> RemoteMethod:
        return RemoteMethod({"name": name, **settings}, runner)

    try:
        method = make()
    except LodbenchError as error:
        # Wrong words of the command are no fault of the method.
        if isinstance(error, RunnerFault) or error.message.startswith("method."):
            raise
        yield Check("plug-in", "entry point", FAULT, error.message, error.hint)
        return
    method.close()
    yield Check("plug-in", "entry point", OK, f"{name}, in {runner.python}")
    yield Check("plug-in", "inputs", OK, known_inputs(method))
    if method.trial_params is not None:
        settings |= method.trial_params
        yield trial_settings(method.params, method.trial_params)
    yield from check_answers(make)
