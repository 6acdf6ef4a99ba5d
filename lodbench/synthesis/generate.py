"""Generating a training set: plan, fan out, resume, account for everything."""

from __future__ import annotations

import errno
import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench import __version__
from lodbench.citymodel.cache import open_cached_city
from lodbench.citymodel.options import PATH_OPTIONS, ReadOptions, changed_options
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.source import open_sources
from lodbench.citymodel.textured_map import files_of_textured, offset_to_city, read_textured
from lodbench.datasets.folder import RENDERED_TRUTH_FILE, write_poses
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.errors import ConfigError, DatasetError
from lodbench.execution import Progress
from lodbench.execution.executor import DASK, PROCESS, ExecutorParams, require_code_version, spread
from lodbench.photos.pictures import encoded, read_picture
from lodbench.storage import (
    digest_of,
    file_digest,
    make_folder,
    random_stream,
    remove_leftovers,
    write_bytes,
    write_text,
)
from lodbench.storage.digest import digest_of_code, own_digest
from lodbench.storage.json_text import parse_json
from lodbench.synthesis.camera_paths import GenerateParams
from lodbench.synthesis.land_cover import Land
from lodbench.synthesis.objects import read_props
from lodbench.synthesis.plan_views import (
    MOST_LABELS,
    SPLITS,
    PictureParts,
    PlannedView,
    ViewPlan,
    ViewWriter,
    files_of,
    is_written,
    plan_views,
)
from lodbench.synthesis.surroundings import make_surroundings

MANIFEST_FILE, SHEET_FILE = "manifest.json", "overview.png"
SCHEMA = 1
_LIBRARIES = ("numpy", "numba", "opencv-python-headless", "scipy")
_LAYERS = ("kernels", "geometry", "citymodel", "photos", "datasets", "rendering", "synthesis")
# Settings that name files, whose content is named instead; and those that change no byte.
_PATHS = ("city", "texture_model", "props", "terrain", "poses")
_IDLE = ("out", "sheet", "workers")
# Views on the contact sheet, strips in each of its rows, and the colour of masks.
_VIEWS, _PER_ROW = 8, 2
_MASK_BGR = np.array([60.0, 170.0, 255.0])

Picture = NDArray[np.uint8]


def begin_manifest(
    params: GenerateParams, options: ReadOptions, parts: PictureParts, plan: ViewPlan, out: Path
) -> dict[str, Any]:
    """Writes the manifest of a set about to be made, unless the same is there; returns it.

    Raises:
        DatasetError: The folder holds another set, or something else.
    """
    manifest = _manifest(params, options, parts, plan)
    path = out / MANIFEST_FILE
    remove_leftovers(out)
    if out.exists() and any(out.iterdir()):
        existing = _read(path)
        if not isinstance(existing.get("settings"), dict):
            raise DatasetError(
                f"{out} holds something else than a training set.", "Name a new or empty folder with `out=`."
            )
        if existing.get("digest") != manifest["digest"]:
            changed = _difference(existing, manifest)
            raise DatasetError(
                f"{out} holds another training set{changed}.",
                "Name another folder with `out=`, or remove it.",
            )
        return manifest
    make_folder(out)
    _write(manifest | {"state": "unfinished"}, path)
    return manifest


def finish_manifest(manifest: dict[str, Any], out: Path) -> None:
    """Writes the manifest of a finished set."""
    _write(manifest | {"state": "finished"}, out / MANIFEST_FILE)


def _manifest(
    params: GenerateParams, options: ReadOptions, parts: PictureParts, plan: ViewPlan
) -> dict[str, Any]:
    scene = parts.scene
    settings = {key: value for key, value in asdict(params).items() if key not in _IDLE}
    paths = {key: Path(settings[key]).expanduser() for key in _PATHS if settings[key] is not None}
    inputs = {
        key: _texture_digests(path) if key == "texture_model" else _digests(path)
        for key, path in paths.items()
    }
    identity = {
        "settings": {key: value for key, value in settings.items() if key not in _PATHS},
        "inputs": {key: sorted(digests.values()) for key, digests in inputs.items()},
        # Other options of the source read another city from the same file.
        "cities": parts.cities_digest(),
        "code": _code_digest(),
        "schema": SCHEMA,
    }
    counts = Counter(view.split for view in plan.views)
    return {
        "schema": SCHEMA,
        "digest": digest_of(identity),
        "code": identity["code"],
        "settings": settings,
        "source": changed_options(options),
        "inputs": inputs,
        "versions": {"lodbench": __version__} | {name: version(name) for name in _LIBRARIES},
        "city": dict(buildings=scene.num_buildings, lod=scene.lod, crs=scene.crs, scene=scene.digest()),
        "frame": "poses: world to camera, in the city's coordinates, metres; pitch 0 looks straight down",
        "views": {split: counts[split] for split in SPLITS},
        "candidates": plan.candidates,
        "skipped": plan.skipped,
    }


def _digests(path: Path) -> dict[str, str]:
    """Returns the SHA-256 of a file, or of every file of a folder of tiles, by name."""
    if path.is_dir():
        return {source.path.name: file_digest(source.path) for source in open_sources(path)}
    return {path.name: file_digest(path)}


def _texture_digests(path: Path) -> dict[str, str]:
    """Returns the SHA-256 of every file of a textured mesh: its materials and pictures are what is drawn."""
    root = path if path.is_dir() else path.parent
    files = dict.fromkeys(files_of_textured(path))
    return {file.relative_to(root).as_posix(): file_digest(file) for file in files}


def _read(path: Path) -> dict[str, Any]:
    try:
        manifest = parse_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return manifest if isinstance(manifest, dict) else {}


def _difference(existing: dict[str, Any], wanted: dict[str, Any]) -> str:
    """Returns the first setting that differs, or what else does, for a message."""
    old = existing["settings"]
    for key, value in json.loads(json.dumps(wanted["settings"])).items():
        if key not in _PATHS and old.get(key) != value:
            return f" ({key} is {old.get(key)} there)"
    if existing.get("code") != wanted["code"]:
        return " (made by another version of lodbench or of its libraries)"
    return " (of other input files, or read in another way)"


@cache
def _code_digest() -> str:
    """Returns a digest of what plans and draws views: poses of one version suit no pictures of another."""
    package = Path(__file__).parents[1]
    files = [file for layer in _LAYERS for file in sorted((package / layer).rglob("*.py"))]
    return digest_of_code(files, _LIBRARIES)


def _write(manifest: dict[str, Any], path: Path) -> None:
    text = json.dumps(manifest, indent=1, sort_keys=True, allow_nan=False, ensure_ascii=False)
    write_text(path, text + "\n")


def write_sheet(params: GenerateParams, views: Sequence[PlannedView], path: Path) -> None:
    """Writes picture, mask and overlay of eight views, evenly chosen, side by side."""
    chosen = [views[k] for k in np.unique(np.linspace(0, len(views) - 1, _VIEWS).round().astype(int))]
    strips = [_strip(params, view, path.parent, params.sheet) for view in chosen]
    strips += [np.full_like(strips[0], 255)] * (-len(strips) % _PER_ROW)
    rows = [np.hstack(strips[k : k + _PER_ROW]) for k in range(0, len(strips), _PER_ROW)]
    write_bytes(path, encoded(np.vstack(rows), ".png", [cv2.IMWRITE_PNG_COMPRESSION, 9]))


def _strip(params: GenerateParams, view: PlannedView, folder: Path, tile: int) -> Picture:
    """Returns the picture (or grey), the mask, and the mask's outline and tint over the picture."""
    files = {path.parent.name: path for path in files_of(params, view, folder)}
    size = (tile, max(1, round(tile * params.size[1] / params.size[0])))
    mask = _picture(files["masks"], size)
    photo = _picture(files["images"], size) if "images" in files else np.full_like(mask, 128)
    share = mask / 255.0 * 0.45
    overlay = (photo * (1.0 - share) + _MASK_BGR * share).astype(np.uint8)
    is_building = (mask[..., 0] > 127).astype(np.uint8)
    outlines, _ = cv2.findContours(is_building, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(overlay, outlines, -1, (255, 255, 255), 1, cv2.LINE_AA)
    strip = np.hstack([photo, mask, overlay])
    return np.pad(strip, ((2, 2), (2, 2), (0, 0)), constant_values=255)


def _picture(path: Path, size: tuple[int, int]) -> Picture:
    picture = read_picture(path)
    if picture is None:
        raise DatasetError(f"{path} is not a picture.", "Delete it and give the same command again.")
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


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
    """Writes a training set, or what is still missing of it; by processes of this machine if not given.

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
        others: dict[str, Any] = {name: _whole(getattr(options, name)) for name in PATH_OPTIONS}
        absolute = replace(params, **files), replace(options, **others)
        workers = (_make_world, (*absolute, parts.digest(), out, own_digest()))
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
    require_code_version(code)
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
