"""The city of a command: opened, from the cache where it is there; a city of many tiles made one scene.

Tiles are compiled one at a time, in parallel and in little memory. Every tile becomes a part beside the scene
that is being made; what a killed process has finished stays and is used again. Parts are then joined by
copying, never more than one of them in memory.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lodbench.citymodel import attributes, cache, codes, frame, scene_file
from lodbench.citymodel.cleaning import unique_ids
from lodbench.citymodel.derive import reproject
from lodbench.citymodel.formats import Source
from lodbench.citymodel.model import COARSEST, FINEST, CityModel, Period, choose_lod, has_lod
from lodbench.citymodel.options import ReadOptions, made_with
from lodbench.citymodel.polygons import finish_model
from lodbench.citymodel.raw import NotACity
from lodbench.citymodel.read import mesh_model, read_source
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.source import open_sources
from lodbench.datasets.query import Dataset
from lodbench.errors import CityModelError, ConfigError, DatasetError, LodbenchError
from lodbench.execution import ProgressCallback
from lodbench.execution.executor import ExecutorParams, spread
from lodbench.execution.processes import only_one_in
from lodbench.findings import Findings
from lodbench.geometry import Pose
from lodbench.photos.map_frame import MapFrame
from lodbench.storage import digest_of, make_folder, remove_leftovers
from lodbench.storage.disk import disk

# A camera further from the city's outline than this sees none of it; nor one further below it than rough
# heights are off.
FURTHEST_M, _DEEPEST_M = 2000.0, 50.0
# From here on distances on the map are not those on the ground, or there is no place on the map at all.
_OTHER_REGION_M = 300_000.0
_TILE_HINT = "Is it the right tile, and its reference system right? lodbench city info says where it is."
HEIGHT_HINT = (
    "Photo and city use different height datums: set the photo's with `--takeoff METRES` or `--heights`."
)
_TILES_PER_FOLDER = 100
Steps = Callable[[int, int], None]


def open_city(path: Path, lod: str | None, options: ReadOptions, roof_height: str | None) -> cache.OpenCity:
    """Returns one level of detail of a city, drawing progress on a terminal; see ``open_cached_city``.

    Raises:
        CityModelError: The city cannot be read, or has no building at that level.
    """
    with ProgressCallback(f"reading {path.name}", "MB", 1_000_000) as progress:
        return cache.open_cached_city(
            path, lod=lod, options=options, roof_height=roof_height, progress=progress
        )


def city_of_dataset(dataset: Dataset) -> cache.OpenCity:
    """Returns the city of a dataset.

    Raises:
        ConfigError: It names none.
        CityModelError: It cannot be read, or has no building at that level.
    """
    if dataset.city_model is None:
        raise ConfigError("There is no city model to localise against.", dataset.city_hint)
    return open_city(dataset.city_model, dataset.lod, dataset.city_options, dataset.roof_height)


def city_digests(scene: Scene) -> dict[str, str]:
    """Returns digests of a city by name: ``scene``, and ``roofs`` where its source tells of pitched ones."""
    reported = {} if scene.pitched is None else {"roofs": digest_of(np.flatnonzero(scene.pitched).tolist())}
    return {"scene": digest_of([scene.digest(), scene.origin.tolist()]), **reported}


def distance_outside_m(pose: Pose, scene: Scene) -> float:
    """Returns how far outside a city's rectangle a camera (its coordinates) is, metres; 0 above it."""
    low, high = (corner + scene.origin for corner in scene.extent_m)
    beside = np.maximum(np.maximum(low - pose.center, pose.center - high), 0.0)[:2]
    return float(np.hypot(beside[0], beside[1]))


def height_above_m(pose: Pose, scene: Scene) -> float:
    """Returns how far above a city's lowest point a camera (its coordinates) is, metres; else negative."""
    return float(pose.center[2] - scene.extent_m[0][2] - scene.origin[2])


def far_words(poses: Sequence[Pose], scene: Scene) -> tuple[str, str] | None:
    """Returns how far off cameras (their median) are that see none of a city, and what to do; else None."""
    away = float(np.median([distance_outside_m(pose, scene) for pose in poses]))
    if away > FURTHEST_M:
        return f"{_km(away)} outside the city model", _TILE_HINT
    below = -float(np.median([height_above_m(pose, scene) for pose in poses]))
    return (f"{below:.0f} m below the city model", HEIGHT_HINT) if below > _DEEPEST_M else None


def _km(metres: float) -> str:
    return f"{metres / 1000:,.0f} km" if metres > 1e5 else f"{metres / 1000:.1f} km"


def require_same_region(what: str, latitude_deg: float, longitude_deg: float, scene: Scene) -> None:
    """Makes sure that a place is where a city's coordinates mean anything: projections end far away.

    Args:
        what: It is, and did: "By its position DJI_0001.JPG was taken".
        latitude_deg: WGS 84.
        longitude_deg: WGS 84.
        scene: The city, with a reference system.

    Raises:
        DatasetError: It is hundreds of kilometres off.
    """
    from pyproj import Geod

    east, north = (float(value) for value in np.mean(scene.extent_m, axis=0)[:2] + scene.origin[:2])
    latitude, longitude = MapFrame(str(scene.crs)).latitude_longitude(east, north)
    away = Geod(ellps="WGS84").inv(longitude, latitude, longitude_deg, latitude_deg)[2]
    if away > _OTHER_REGION_M:
        hint = f"Is it the right tile? It is at latitude {latitude:.4f}, longitude {longitude:.4f}."
        raise DatasetError(f"{what} {_km(away)} outside the city model.", hint)


def require_near_city(what: str, poses: Sequence[Pose], scene: Scene) -> None:
    """Makes sure that cameras may see something of a city.

    Args:
        what: They are, and did: "The first frame was taken".
        poses: Theirs, in the city's own coordinates.
        scene: The city.

    Raises:
        DatasetError: They are too far off.
    """
    far = far_words(poses, scene)
    if far is not None:
        raise DatasetError(f"{what} {far[0]}.", far[1])


@dataclass(frozen=True, slots=True)
class TileJob:
    """What is made of every tile."""

    path: str  # folder or archive of the tiles
    parts: str  # folder for what is made of them
    lod: str | None  # level requested, or None for the lowest that has walls
    roof_height: str | None  # rule by which an absent level 1 is derived, or None
    options: ReadOptions  # how to read
    crs: str | None = ""  # reference system that all tiles go to; "" until the first one is read


def compile_tiles(
    path: Path,
    target: Path,
    *,
    lod: str | None = None,
    roof_height: str | None = None,
    options: ReadOptions | None = None,
    executor: ExecutorParams | None = None,
    progress: Steps | None = None,
) -> dict[str, Any]:
    """Makes one scene of a folder or archive of tiles; returns what is stated of it, see ``read_about``.

    The scene is that of ``mesh_model`` over all tiles read at once, up to the rounding of float32: the same
    buildings in the same order, at one level of detail. Called again after it was stopped, it goes on with
    the tiles that are missing; tiles that have changed since are read again.

    Args:
        path: The tiles.
        target: The scene folder to write; ``TARGET.parts`` beside it is there while it is made.
        lod: Level, as for ``mesh_model``.
        roof_height: As for ``mesh_model``.
        options: How to read.
        executor: Where the tiles are read; the scene does not depend on it.
        progress: Called with tiles done and their number.

    Raises:
        CityModelError: A tile cannot be read, none has a building, or none has the level.
        OSError: The disk is full, or the target is something else.
    """
    options, executor = options or ReadOptions(), executor or ExecutorParams()
    sources = open_sources(path, options.layers)
    parts = target.with_name(f"{target.name}.parts")
    reported: dict[int, dict[str, Any]] = {}
    with _kept_if_of_use(parts, reported), only_one_in(parts):
        remove_leftovers(parts)
        job = TileJob(str(path), str(parts), lod, roof_height, options)
        job = _settle(job, sources, reported)
        _compile(job, range(len(sources)), executor, reported, progress)
        level = _common_level(job, reported)
        wrong = [n for n, about in reported.items() if about["extra"]["lods"] and about["lod"] != level]
        if wrong:  # their own lowest level is not that of the city
            job = replace(job, lod=level)
            _compile(job, wrong, executor, reported, progress)
        meta = _join([reported[n] for n in sorted(reported)], target, made_with(options, roof_height))
    shutil.rmtree(parts)
    return meta


@contextmanager
def _kept_if_of_use(parts: Path, reported: dict[int, dict[str, Any]]) -> Iterator[None]:
    """Makes the folder of parts, which a fault leaves there only where it holds tiles to go on with."""
    is_new = not parts.exists()
    make_folder(parts)
    try:
        yield
    except LodbenchError:
        if is_new and not any(about["extra"]["lods"] for about in reported.values()):
            disk().remove(parts)
        raise


def _settle(job: TileJob, sources: tuple[Source, ...], reported: dict[int, dict[str, Any]]) -> TileJob:
    """Returns the job with the reference system of the first tile that is a city, which all others go to."""
    for n in range(len(sources)):
        about = _tile(job, sources, n)
        if about["extra"]["skipped"] is None:
            return replace(job, crs=about["crs"])
        reported[n] = about
    raise CityModelError(f"{job.path} has no tile with a building.", "Is it the building part of the city?")


def _compile(
    job: TileJob,
    numbers: range | list[int],
    executor: ExecutorParams,
    reported: dict[int, dict[str, Any]],
    progress: Steps | None,
) -> None:
    for done, (n, about) in enumerate(spread(executor, _compile_here, numbers, _open_here, (job,)), start=1):
        reported[n] = about
        if progress is not None:
            progress(done, len(numbers))


# What this process compiles: the job, and the tiles; set once, before its first tile.
_here: list[tuple[TileJob, tuple[Source, ...]]] = []


def _open_here(job: TileJob) -> None:
    _here[:] = [(job, open_sources(Path(job.path), job.options.layers))]


def _compile_here(n: int) -> tuple[int, dict[str, Any]]:
    job, sources = _here[0]
    return n, _tile(job, sources, n)


def _tile(job: TileJob, sources: tuple[Source, ...], n: int) -> dict[str, Any]:
    """Returns what is stated of the part of a tile, which is made where it is not there yet."""
    source = sources[n]
    settings = {**asdict(replace(job, parts="", path="")), "options": asdict(job.options)}
    key = digest_of(
        [cache.code_digest(job.options.reader), cache.source_digest(source), source.name, settings], length=24
    )
    # A hundred to a folder: looking for leftovers in one of ten thousand, for each, takes minutes.
    folder = Path(job.parts) / f"{n // _TILES_PER_FOLDER:04d}" / f"{n:06d}-{key}"
    if not scene_file.is_scene(folder) or not attributes.holds_on(
        attributes.period_of(scene_file.read_about(folder)["extra"].get("period")), job.options.date
    ):
        scene, extra = _mesh_tile(job, source)
        make_folder(folder.parent)
        scene_file.write_scene(scene, folder, extra, survives_power_cut=False)
    about = scene_file.read_about(folder)
    # Ids are many, and on disk.
    return {"folder": str(folder), **{key: about[key] for key in ("lod", "crs", "extra")}}


def _mesh_tile(job: TileJob, source: Source) -> tuple[Scene, dict[str, Any]]:
    """Returns one tile as a scene in a frame of its own, and what the whole city must know of it."""
    findings = Findings()
    try:
        raw = read_source(source, job.options)
    except NotACity as error:
        findings.add(codes.FILE_SKIPPED, source.name, error.message)
        return _empty(None, ()), _extra(findings, (), error.message)
    model = finish_model(raw, job.options)
    if job.crs and model.crs is not None and model.crs != job.crs:
        model.findings.add(codes.CRS_MIXED, "", frame.brought_note(model.crs, job.crs))
        model = reproject(model, job.crs)
    findings.items += model.findings.items
    walled = tuple(name for name in model.lods if not name.startswith("0")) or model.lods
    try:
        mesh = mesh_model(model, job.lod, roof_height=job.roof_height)
    except CityModelError:
        if job.lod is None or job.lod in (FINEST, COARSEST) or has_lod(model.lods, job.lod):
            raise
        for name in model.building_ids:  # other tiles may have the level
            findings.add(codes.LOD_ABSENT, name, f"no LoD{job.lod}")
        return _empty(model, model.building_ids), _extra(findings, ())
    findings.items += mesh.findings.items
    areas = {"area_m2": mesh.area_m2, "lost_m2": mesh.lost_m2}
    return mesh.scene, _extra(findings, walled, period=model.period) | areas


def _empty(model: CityModel | None, ids: tuple[str, ...]) -> Scene:
    origin = np.zeros(3) if model is None else model.origin
    starts = np.zeros(len(ids) + 1, np.int64)
    points, triangles = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
    return Scene(points, triangles, starts, starts, ids, "", None if model is None else model.crs, origin)


def _extra(
    findings: Findings, lods: tuple[str, ...], skipped: str | None = None, period: Period | None = None
) -> dict[str, Any]:
    counts = {"findings": findings.counts(), "finding_objects": findings.objects()}
    dated = {} if period is None else {"period": list(period)}
    return {**counts, "area_m2": 0.0, "lost_m2": 0.0, "lods": list(lods), "skipped": skipped, **dated}


def _common_level(job: TileJob, reported: dict[int, dict[str, Any]]) -> str:
    """Returns the level that the whole city has by the rule for one file."""
    if job.lod in (FINEST, COARSEST):
        return job.lod
    if job.lod is not None:
        levels = {about["lod"] for about in reported.values() if about["extra"]["lods"]}
        if not levels:
            raise CityModelError(
                f"No tile of {job.path} has a level of detail {job.lod}.", "See lodbench city info."
            )
        return str(min(levels))
    return choose_lod(
        sorted({name for about in reported.values() for name in about["extra"]["lods"]}), None, Findings()
    )


def _join(parts: list[dict[str, Any]], target: Path, made: dict[str, Any]) -> dict[str, Any]:
    findings = Findings()
    folders = [Path(part["folder"]) for part in parts if part["extra"]["skipped"] is None]
    ids = unique_ids(
        [name for folder in folders for name in scene_file.read_about(folder)["building_ids"]], findings
    )
    counts: Counter[str] = Counter(findings.counts())
    objects: Counter[str] = Counter(findings.objects())
    for part in parts:
        counts.update(part["extra"]["findings"])
        objects.update(part["extra"]["finding_objects"])
    extra = {
        "findings": dict(sorted(counts.items())),
        "finding_objects": dict(sorted(objects.items())),
        **{key: sum(part["extra"][key] for part in parts) for key in ("area_m2", "lost_m2")},
        "tiles": len(parts),
        "made_with": made,
    }
    period = attributes.common_period(attributes.period_of(part["extra"].get("period")) for part in parts)
    if period is not None:
        extra["period"] = list(period)
    return scene_file.join_scenes(folders, ids, target, extra)
