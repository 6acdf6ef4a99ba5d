"""One method over one dataset: every query once, resumable, the same bytes every time."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from lodbench.citymap import CityMap
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.textured_map import TexturedMesh, open_textured_map
from lodbench.datasets.faults import require_direction
from lodbench.datasets.folder import select_splits
from lodbench.datasets.inputs import Input, with_inputs
from lodbench.datasets.prior_sources import prior_digest
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import ConfigError, DatasetError
from lodbench.evaluation.metrics import protocol_named
from lodbench.evaluation.predictions import Prediction, evaluate
from lodbench.execution.executor import DASK, PROCESS, SERIAL, ExecutorParams
from lodbench.execution.processes import expect_workers, only_one_in
from lodbench.harness.city import city_digests, city_of_dataset
from lodbench.harness.runs import inputs, requirements
from lodbench.harness.runs.artefacts import Run
from lodbench.harness.runs.predict import PREDICTIONS_FILE, Work, open_predictions, predict
from lodbench.harness.runs.queries import Preparation
from lodbench.harness.runs.stored import PLAN_FILE
from lodbench.methods import Method
from lodbench.methods.protocol import SupportsFlights
from lodbench.plugins import blaming, load_plugin
from lodbench.segmentation import Segmenter
from lodbench.segmentation.protocol import masks_digest
from lodbench.storage import can_write, digest_of, make_folder, remove_leftovers, write_text
from lodbench.storage.digest import known_contents, own_digest, remembered_contents
from lodbench.storage.disk import disk
from lodbench.storage.paths import path_name


@dataclass(frozen=True, slots=True)
class RunSettings:
    """What a run is given besides its method, dataset and segmenter."""

    runs_root: Path  # folder that run folders are made in
    # The resolved configuration that defines the result, as JSON values; it names the run folder together
    # with the content of the inputs.
    config: dict[str, Any] = field(default_factory=dict)
    renderer: str = "silhouette"  # name of the renderer
    # Threads of the engine in this process, None for one per core; never changes a result.
    threads: int | None = None
    tilt: str = "prior"  # ``prior`` or ``truth``
    seed: int = 0  # seed of the random streams
    splits: tuple[str, ...] = ()  # splits to run; empty for all
    limit: int | None = None  # at most this many queries per split, or None
    # Whether queries that failed in an earlier run into the same folder are tried again.
    retries_failed: bool = False
    # Where queries are answered; never changes a result.
    executor: ExecutorParams = field(default_factory=ExecutorParams)
    # Returns the names of a query's random streams; its dataset and key if None.
    stream_names: Callable[[Entry], tuple[str, ...]] | None = None

    def names(self) -> frozenset[str]:
        """Returns all words among the settings, of which some may name plug-ins."""
        return frozenset(inputs.words_in(self.config)) | {self.renderer}


@remembered_contents()
def run_method(method: Method, dataset: Dataset, segmenter: Segmenter, settings: RunSettings) -> Run:
    """Runs a method over a dataset and returns the rows; the ledger in the run folder lets it resume.

    Raises:
        LodbenchError: A fault of the dataset or the settings, before any work is done.
    """
    runs = settings.runs_root / path_name("dataset", dataset.name) / path_name("method", method.name)
    dataset, splits, entries, city_map, textured = _opened(method, dataset, segmenter, settings)
    columns = protocol_named(dataset.protocol).columns
    needs = requirements.made_inputs(method) | (
        {Input.IMAGE} if requirements.looks_at_photos(method, segmenter) else set()
    )
    preparation = Preparation(dataset, city_map.scene, segmenter, settings.tilt, needs, city_map)
    digests = {
        **_fixed_inputs(method, segmenter, dataset, entries, city_map.scene, textured, settings.names()),
        **_read_inputs(method, segmenter, dataset, entries),
    }
    folder = runs / digest_of({"config": settings.config, "inputs": digests})
    work = Work(
        # A worker prepares its own.
        method if settings.executor.name == SERIAL else copy(method),
        dataset,
        segmenter,
        settings.renderer,
        settings.threads if settings.executor.name == SERIAL else settings.executor.num_threads,
        settings.tilt,
        preparation.needs,
        settings.seed,
        settings.config.get("method"),
        digests,
        make_folder(folder).absolute(),
        known_contents(),
        settings.stream_names,
        own_digest() if settings.executor.name == DASK else "",
    )
    predictions, resumed = _answered(method, work, preparation, city_map, entries, folder, settings)
    priors = {entry.key: preparation.prior(entry) for entry in entries}
    with blaming("renderers", settings.renderer, "draw what was found"):
        queries = evaluate(entries, predictions, dataset.truth, priors, city_map, settings.tilt, columns)
    return Run(
        folder=folder,
        config=settings.config,
        dataset=dataset,
        splits=splits,
        predictions=predictions,
        queries=queries,
        inputs=digests,
        lod=city_map.scene.lod,
        preparation=preparation,
        scorer=city_map,
        resumed=resumed,
    )


def required_queries(
    method: Method, dataset: Dataset, segmenter: Segmenter, settings: RunSettings
) -> tuple[tuple[str, ...], tuple[Entry, ...]]:
    """Returns splits and queries, the settings and their inputs checked: all that needs no file read.

    Raises:
        LodbenchError: A fault of the settings, or an input that the dataset lacks.
    """
    requirements.require_choices(settings.tilt, settings.limit)
    require_writable(settings.runs_root)
    splits = select_splits(dataset, settings.splits)
    entries = inputs.chosen_entries(dataset, splits, settings.limit)
    requirements.require_tilt(settings.tilt, dataset)
    load_plugin("renderers", settings.renderer)
    requirements.require_run_inputs(method, segmenter, dataset, entries)
    return splits, entries


def _opened(
    method: Method, dataset: Dataset, segmenter: Segmenter, settings: RunSettings
) -> tuple[Dataset, tuple[str, ...], tuple[Entry, ...], CityMap, TexturedMesh | None]:
    """Returns the dataset with all that is required, its splits and queries, and the map, all checked."""
    splits, entries = required_queries(method, dataset, segmenter, settings)
    if settings.executor.name == PROCESS:
        # Workers import while this process opens the city.
        expect_workers((predict.__module__, type(method).__module__, type(segmenter).__module__))
    dataset = with_inputs(dataset, requirements.required_inputs(method, segmenter))
    # Once more: what was made for single queries is theirs.
    entries = inputs.chosen_entries(dataset, splits, settings.limit)
    requirements.require_cameras(entries)
    requirements.require_pictures(dataset, entries, method, segmenter)
    requirements.warn_of_flights(method, entries)
    scene, dataset = _open_city(dataset)
    requirements.require_surfaces(method, scene)
    requirements.require_same_place(dataset, entries, scene)
    require_direction(dataset, entries, scene)
    doubts = requirements.doubts_of(dataset, entries, scene, method, segmenter)
    dataset = replace(dataset, notes=dataset.notes + doubts)
    textured, dataset = _open_textured(dataset, scene)
    city_map = CityMap(scene, settings.renderer, settings.threads, textured)
    return dataset, splits, entries, city_map, textured


def _answered(
    method: Method,
    work: Work,
    preparation: Preparation,
    city_map: CityMap,
    entries: tuple[Entry, ...],
    folder: Path,
    settings: RunSettings,
) -> tuple[dict[str, Prediction], int]:
    """Returns the answers, those of an earlier process among them, and how many these are."""
    with only_one_in(folder):
        remove_leftovers(folder)
        plan = {"queries": [entry.key for entry in entries]}
        write_text(folder / PLAN_FILE, json.dumps(plan, indent=0) + "\n")
        stored = open_predictions(folder)
        resumed = sum(entry.key in stored for entry in entries)
        try:
            inputs.prepare_method(method, work.params, work.inputs, city_map, work.dataset.references, folder)
            predictions = predict(
                work, preparation, city_map, entries, settings.executor, settings.retries_failed
            )
        except ConfigError:
            _remove_unused(folder)
            raise
        if len(stored) < len(entries):
            with remembered_contents():
                now = _read_inputs(method, work.segmenter, work.dataset, entries)
                _require_unchanged(work.inputs, now, folder)
    return predictions, resumed


def _fixed_inputs(
    method: Method,
    segmenter: Segmenter,
    dataset: Dataset,
    entries: tuple[Entry, ...],
    scene: Scene,
    textured: TexturedMesh | None,
    names: Collection[object],
) -> dict[str, str]:
    """Returns digests of what is in memory by now, and of the code, plug-ins that settings name included."""
    digests = {
        **city_digests(scene),
        "queries": inputs.queries_digest(dataset, entries),
        "priors": prior_digest(entries),
        "code": inputs.code_digest(method, segmenter, names=names),
    }
    if requirements.is_oracle(method, segmenter):
        digests["truth"] = inputs.truth_digest(dataset, entries)
    if isinstance(method, SupportsFlights) and (tied := inputs.flights_digest(entries)) is not None:
        digests["flights"] = tied
    return digests if textured is None else digests | {"textured_map": textured.digest()}


def _read_inputs(
    method: Method, segmenter: Segmenter, dataset: Dataset, entries: tuple[Entry, ...]
) -> dict[str, str]:
    return {"masks": masks_digest(segmenter, entries), **inputs.method_inputs(method, dataset, entries)}


def _require_unchanged(before: dict[str, str], after: dict[str, str], folder: Path) -> None:
    """Sets the answers apart if what they were made from is no longer what names the run's folder."""
    changed = [name for name, digest in after.items() if before[name] != digest]
    if not changed:
        return
    file = folder / PREDICTIONS_FILE
    if file.exists():
        disk().rename(file, file.with_suffix(".mixed"))
    raise DatasetError(
        f"The {' and '.join(changed)} changed while the run was going on: {folder} keeps no answer.",
        "Give the same command again; what was answered is in predictions.mixed.",
    )


def require_writable(folder: Path) -> None:
    """Makes sure, before any work, that a folder exists or can be made, and can be written to.

    Raises:
        ConfigError: It cannot.
    """
    if not can_write(folder):
        raise ConfigError(f"Run folders cannot be made in {folder}.", "Set `paths.runs=FOLDER`.")


def _remove_unused(folder: Path) -> None:
    """Removes a run folder that no query was answered into: wrong settings leave nothing behind."""
    if len(open_predictions(folder, read_only=True)) or (folder / "tracebacks").exists():
        return
    disk().remove(folder / PLAN_FILE)
    with suppress(OSError):  # folders that hold something else stay
        for place in (folder, folder.parent, folder.parent.parent):
            place.rmdir()


def _open_city(dataset: Dataset) -> tuple[Scene, Dataset]:
    """Returns a dataset's scene, and the dataset with what was met in its city added to the notes."""
    city = city_of_dataset(dataset)
    return city.scene, replace(dataset, notes=dataset.notes + city.notes())


def _open_textured(dataset: Dataset, scene: Scene) -> tuple[TexturedMesh | None, Dataset]:
    """Returns a dataset's textured map in the scene's frame, or None, and what was met there as notes."""
    if dataset.textured_map is None:
        return None, dataset
    mesh = open_textured_map(dataset.textured_map, scene, options=dataset.city_options)
    return mesh, replace(dataset, notes=dataset.notes + mesh.notes)
