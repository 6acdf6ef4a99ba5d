"""Generating a training set: plan, fan out, resume, account for everything."""

from __future__ import annotations

import errno
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lodbench.citymodel.cache import open_cached_city
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.texture_files import read_textured
from lodbench.citymodel.textured_mesh import offset_to_city
from lodbench.datasets.folder import RENDERED_TRUTH_FILE, write_poses
from lodbench.datasets.priors import UniformPrior
from lodbench.errors import ConfigError, DatasetError
from lodbench.execution import Progress
from lodbench.execution.executor import DASK, PROCESS, ExecutorParams, spread
from lodbench.execution.same_code import own_digest, require_same_code
from lodbench.storage import make_folder, random_stream, remove_leftovers
from lodbench.synthesis.objects.scene_props import read_props
from lodbench.synthesis.surroundings.ground import Land
from lodbench.synthesis.surroundings.surroundings import make_surroundings
from lodbench.synthesis.training_data.manifest import SHEET_FILE, begin_manifest, finish_manifest, write_sheet
from lodbench.synthesis.training_data.params import GenerateParams
from lodbench.synthesis.training_data.plan_views import SPLITS, PlannedView, ViewPlan, plan_views
from lodbench.synthesis.training_data.view_writer import (
    MOST_LABELS,
    PictureParts,
    ViewWriter,
    files_of,
    is_written,
)

# What makes the world of a worker, and of what.
Workers = tuple[Callable[..., None], tuple[Any, ...]]
# Settings that name files to read.
_FILES = ("city", "props", "terrain", "texture_model")


class Generated(NamedTuple):
    """What was generated."""

    out: Path
    views: dict[str, int]
    resumed: int
    skipped: dict[str, int]
    notes: tuple[str, ...]


def generate_training_data(
    params: GenerateParams, options: ReadOptions | None = None, executor: ExecutorParams | None = None
) -> Generated:
    """Writes a training set, or what is still missing of it; by processes of this machine if not told.

    Every file of a view depends on the settings, the inputs and its name only, not on the workers or on where
    an earlier run was stopped. ``params.crs`` goes before that of ``options``.

    Raises:
        LodbenchError: An input is at fault, no view can be taken, the folder holds another set, or the
            disk is full; finished files stay, and the same command goes on from there.
    """
    # Workers elsewhere stand in other folders.
    out = Path(params.out).expanduser().absolute()
    options = options or ReadOptions()
    options = replace(options, crs=params.crs or options.crs)
    parts, plan, notes = _prepare(params, options)
    manifest = begin_manifest(params, options, parts, plan, out)
    _write_layout(params, parts.scene, plan, out)
    for folder in out.glob("*/*/"):
        remove_leftovers(folder)  # what a killed run was writing
    missing = [view for view in plan.views if not all(map(is_written, files_of(params, view, out)))]
    resumed = len(plan.views) - len(missing)
    executor = executor or ExecutorParams(PROCESS)
    if executor.name == PROCESS:  # no more processes than there are views
        most = params.workers or executor.num_workers
        executor = replace(executor, workers=min(most, max(1, len(missing))))
    workers: Workers = (_open_writer, (params, parts, out))
    if executor.name == DASK:
        # Names and a digest go over the network: what stands around a city takes more than the city.
        files: dict[str, Any] = {name: _whole(getattr(params, name)) for name in _FILES}
        found = replace(params, **files), replace(options, terrain=_whole(options.terrain))
        workers = (_make_world, (*found, parts.digest(), out, own_digest()))
    _write_views(workers, missing, out, resumed, executor)
    write_sheet(params, plan.views, out / SHEET_FILE)
    finish_manifest(manifest, out)
    counts = Counter(view.split for view in plan.views)
    return Generated(out, {split: counts[split] for split in SPLITS}, resumed, plan.skipped, notes)


def _prepare(params: GenerateParams, options: ReadOptions) -> tuple[PictureParts, ViewPlan, tuple[str, ...]]:
    """Returns the city with its surroundings, the views to take of it, and what was met."""
    city, picture = open_cities(params, options)
    if params.labels and city.num_buildings > MOST_LABELS:
        raise ConfigError(
            f"The city has {city.num_buildings} buildings; labels hold at most {MOST_LABELS}.",
            "Leave labels out, or take the city's tiles one by one.",
        )
    parts, land, notes = world_parts(params, city, picture)
    with Progress("views examined", None) as progress:
        plan = plan_views(params, city, land.ground, progress.advance)
    return parts, plan, notes


def world_parts(
    params: GenerateParams, city: Scene, picture: Scene
) -> tuple[PictureParts, Land, tuple[str, ...]]:
    """Returns what workers draw from, the land made up for it, and notes for the reader.

    Raises:
        LodbenchError: The terrain, the props or the textured mesh cannot be read or lies elsewhere.
    """
    props, land = make_surroundings(picture, params.seed, params.terrain)
    if params.texture_model is not None:
        model = Path(params.texture_model).expanduser()
        mesh = read_textured(model, params.texture_up)
        offset, note = offset_to_city(
            mesh, city, model.name, "If it lies on its side, set texture_up=y or z."
        )
        return PictureParts(city, picture, None, None, offset), land, (note,)
    if params.props is not None:
        return PictureParts(city, picture, read_props(Path(params.props).expanduser()), None), land, ()
    return PictureParts(city, picture, props, land.cover), land, ()


def open_cities(params: GenerateParams, options: ReadOptions) -> tuple[Scene, Scene]:
    """Returns the city of the masks and that of the pictures, in one frame."""
    path = Path(params.city).expanduser()
    opened = partial(open_cached_city, path, options=options, roof_height=params.roof_height)
    city = opened(lod=params.lod).scene
    picture = opened(lod=params.picture_lod).scene if params.picture_lod is not None else city
    if not np.array_equal(city.origin, picture.origin):
        raise ConfigError("The two levels of detail have different origins.", "Leave picture_lod out.")
    return city, picture


def _write_layout(params: GenerateParams, scene: Scene, plan: ViewPlan, out: Path) -> None:
    """Makes the folders, and writes poses, priors and cameras of all views, finished or not."""
    for split in SPLITS:
        views = [view for view in plan.views if view.split == split]
        if not views:
            continue
        for path in files_of(params, views[0], out):
            make_folder(path.parent)
        truth = {f"{view.name}.{params.format}": view.pose.shifted(scene.origin) for view in views}
        streams = (random_stream(params.seed, "training", "gps", view.key) for view in views)
        drawn = (UniformPrior().draw(view.pose, stream) for view, stream in zip(views, streams, strict=True))
        priors = {name: prior.shifted(scene.origin) for name, prior in zip(truth, drawn, strict=True)}
        cameras = dict.fromkeys(truth, params.camera)
        write_poses(out / split, cameras, truth, priors, truth_file=RENDERED_TRUTH_FILE)


def _whole(path: str | None) -> str | None:
    """Returns a path that is found from any folder."""
    return None if path is None else str(Path(path).expanduser().absolute())


def _write_views(
    workers: Workers, missing: list[PlannedView], out: Path, resumed: int, executor: ExecutorParams
) -> None:
    done = 0
    try:
        with Progress("views", len(missing)) as progress:
            for _ in spread(executor, _write_view, missing, *workers):
                done += 1
                progress.advance()
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise DatasetError(
            f"The disk of {out} is full after {resumed + done} of {resumed + len(missing)} views.",
            "They are whole and usable. Free some space and give the same command again: it goes on.",
        ) from error


# The world of this process and the folder it writes to; set once, before the first view.
_world: list[tuple[ViewWriter, Path]] = []


def _open_writer(params: GenerateParams, parts: PictureParts, out: Path) -> None:
    _world[:] = [(ViewWriter(params, parts), out)]


def _make_world(params: GenerateParams, options: ReadOptions, digest: str, out: Path, code: str) -> None:
    """Opens the city here, makes what stands around it again, and makes sure that it is the same."""
    require_same_code(code)
    parts, _, _ = world_parts(params, *open_cities(params, options))
    if parts.digest() != digest:
        raise DatasetError(
            f"{params.city} and what stands around it are others for a worker, or have changed.",
            "Let all workers see the same files, on CPUs of one kind.",
        )
    _open_writer(params, parts, out)


def _write_view(view: PlannedView) -> str:
    world, out = _world[0]
    world.write(view, out)
    return view.key
