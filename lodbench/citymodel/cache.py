"""The scene cache: a city file is parsed once, and mapped from disk ever after."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import cache
from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lodbench.citymodel.attributes import date_in, holds_on, period_of
from lodbench.citymodel.crs import is_same_plane, is_true_to_scale, require_crs
from lodbench.citymodel.formats import Source
from lodbench.citymodel.model import Period
from lodbench.citymodel.options import PATH_OPTIONS, ReadOptions, made_with
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.scene_file import FORMAT_VERSION, is_scene, read_scene, write_scene
from lodbench.citymodel.source import open_sources
from lodbench.errors import CityModelError
from lodbench.findings import Findings
from lodbench.plugins import find_plugin, installed
from lodbench.storage import digest_of, file_digest, make_folder
from lodbench.storage.digest import digest_of_code, package_files
from lodbench.storage.paths import cache_limit_bytes, cache_root, mark_used, prune_cache

if TYPE_CHECKING:
    from lodbench.citymodel.model import CityModel
    from lodbench.citymodel.read import CityMesh

_LOGGER = logging.getLogger(__name__)
# What decides the numbers besides our own code. Those of extras need not be there.
_LIBRARIES = (
    "mapbox_earcut", "numpy", "pyproj", "shapely", "lxml", "trimesh", "scipy",
    "pyogrio", "rasterio", "pyarrow", "laspy",
)  # fmt: skip


def open_cached_city(
    path: str | Path,
    *,
    lod: str | None = None,
    options: ReadOptions | None = None,
    roof_height: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> OpenCity:
    """Returns one level of detail of a city, from the cache where it is there.

    The key is made of the content of every file, the options and the code that reads, so a file that
    changes is read again and a copy under another name is not. A scene that is damaged is made anew, and
    a warning says so. A cache that cannot be written costs nothing but the time. Beyond
    ``LODBENCH_CACHE_GB`` the scenes used longest ago are removed.

    Args:
        path: As for ``read_city_model``; or a scene that ``lodbench city convert`` wrote.
        lod: As for ``mesh_city``.
        options: As for ``read_city_model``.
        roof_height: As for ``mesh_city``.
        progress: As for ``read_city_model``; never called where the cache has the scene.

    Raises:
        CityModelError: The file cannot be read, or has no building at that level; or a scene is of another
            level or reference system.
        ConfigError: ``LODBENCH_CACHE_GB`` is no size.
    """
    path, options = Path(path), options or ReadOptions()
    if is_scene(path):
        return open_scene_folder(path, lod, options, roof_height)
    limit_bytes = cache_limit_bytes()
    folder = cache_root() / "scenes" / scene_key(path, lod, options, roof_height)
    if is_scene(folder):
        try:
            known = load_city(folder)
            if holds_on(known.period, options.date):
                mark_used(folder)
                return known
        except CityModelError as fault:
            _LOGGER.warning("%s It is made anew.", fault)
    # Not needed where the cache has the scene.
    from lodbench.citymodel.read import mesh_model, read_city_model

    model = read_city_model(path, options=options, progress=progress)
    city = open_city(model, mesh_model(model, lod, roof_height=roof_height))
    try:
        make_folder(folder.parent)
        store_city(city, folder, survives_power_cut=False)
        prune_cache(folder.parent, limit_bytes, keep=folder)
    except OSError as error:
        _LOGGER.info("The scene cache %s cannot be written: %s", folder.parent, error)
    return city


def open_cached_scene(
    path: str | Path,
    *,
    lod: str | None = None,
    options: ReadOptions | None = None,
    roof_height: str | None = None,
) -> Scene:
    """Returns the scene of ``open_scene``, from the cache where it is there; see ``open_cached_city``."""
    return open_cached_city(path, lod=lod, options=options, roof_height=roof_height).scene


def open_city(model: CityModel, mesh: CityMesh) -> OpenCity:
    """Returns a mesh of a model with the findings of both."""
    counts = Counter(model.findings.counts())
    counts.update(mesh.findings.counts())
    return OpenCity(mesh.scene, dict(sorted(counts.items())), mesh.area_m2, mesh.lost_m2, model.period)


def scene_key(path: Path, lod: str | None, options: ReadOptions, roof_height: str | None) -> str:
    """Returns the name of a scene in the cache, 24 hexadecimal digits.

    Raises:
        CityModelError: The file is missing or cannot be read.
    """
    files = dict.fromkeys(source.path for source in open_sources(path, options.layers))
    others = [getattr(options, name) for name in PATH_OPTIONS]
    files |= dict.fromkeys(Path(name) for name in others if name is not None)
    try:
        digests = [_digest(file) for file in files]
    except OSError as error:
        raise CityModelError(
            f"{error.filename or path} cannot be read: {error.strerror}.", "Check its permissions."
        ) from None
    settings = [lod, asdict(options) | dict.fromkeys(PATH_OPTIONS), roof_height]
    return digest_of([FORMAT_VERSION, code_digest(options.reader), digests, *settings], length=24)


def source_digest(source: Source) -> object:
    """Returns what tells a tile's content: of a member of an archive, what the archive says of it.

    Raises:
        OSError: It cannot be read.
    """
    return source.stamp or _digest(source.path)


@cache
def code_digest(reader: str | None) -> str:
    """Returns a digest of the code that makes scenes: no version number has to be remembered.

    Args:
        reader: Of ``ReadOptions``; the whole package of a plug-in counts, of all where none is named.

    Raises:
        ConfigError: There is no such reader.
    """
    files = sorted(Path(__file__).parent.rglob("*.py"))
    plug_ins = installed("city_readers") if reader is None else (find_plugin("city_readers", reader),)
    for plug_in in plug_ins:
        if not plug_in.is_ours:
            files += package_files(plug_in.point.module.partition(".")[0])
    return digest_of_code(files, _LIBRARIES)


def _digest(path: Path) -> list[str]:
    """Returns digests of a file and of those that belong to it (a Shapefile's .dbf and .prj)."""
    if path.is_dir():
        return [file_digest(file) for file in sorted(path.rglob("*")) if file.is_file()]
    if path.suffix.lower() == ".shp":
        # Names from browsers have brackets: "houses [2].shp".
        return [file_digest(file) for file in sorted(path.parent.glob(f"{escape(path.stem)}.*"))]
    # What a GIS that has a GeoPackage open wrote last stands beside it.
    log = path.with_name(f"{path.name}-wal")
    return [file_digest(file) for file in (path, log) if file == path or log.is_file()]


# Mercator of the whole world: what is read in it now is projected anew, away from the equator.
_WORLD = "EPSG:3857"


@dataclass(frozen=True, slots=True)
class OpenCity:
    """A scene, and what was met on the way to it; the same whether it was read or came from the cache."""

    scene: Scene  # the triangles
    findings: dict[str, int]  # code and name to count, of reading and of meshing
    area_m2: float  # newell area of the polygons meshed
    lost_m2: float  # area no triangle covers
    period: Period | None = None  # as of ``CityModel``

    def notes(self) -> tuple[str, ...]:
        """Returns what a reader of results must know of the city: its findings, and any area lost."""
        counts = ", ".join(f"{count} x {name}" for name, count in self.findings.items())
        lines = [f"city model: {counts} (see lodbench city check)"] if counts else []
        if self.period is not None:
            lines.append(f"city model: as it stood on {date_in(self.period)}; some of it ends or ended")
        if self.lost_m2 > 0.005:
            lines.append(f"city model: {self.lost_m2:.2f} of {self.area_m2:.2f} m2 could not be meshed")
        return tuple(lines)


def store_city(
    city: OpenCity, folder: Path, survives_power_cut: bool = True, made: Mapping[str, Any] | None = None
) -> None:
    """Writes a city as a scene folder that remembers its findings, and how it was made; see ``write_scene``.

    Args:
        city: The city.
        folder: Where.
        survives_power_cut: As for ``write_scene``.
        made: As of ``made_with``; None for a scene that does not say.

    Raises:
        OSError: As for ``write_scene``.
    """
    low, high = (corner + city.scene.origin for corner in city.scene.extent_m)
    extra = {
        "findings": city.findings,
        "area_m2": city.area_m2,
        "lost_m2": city.lost_m2,
        "extent": [low.tolist(), high.tolist()],
        "triangles": len(city.scene.triangles),
    } | ({} if made is None else {"made_with": dict(made)})
    if city.period is not None:
        extra["period"] = list(city.period)
    write_scene(city.scene, folder, extra, survives_power_cut)


def open_scene_folder(
    folder: Path, lod: str | None, options: ReadOptions, roof_height: str | None
) -> OpenCity:
    """Returns a scene that was converted: what was requested then stays.

    Raises:
        CityModelError: It is damaged, of another level of detail or reference system than requested, made
            with other options, or was written when Mercator of the whole world was taken as metres.
    """
    city, made = _load_stored(folder)
    again, crs = "Convert the file it was made from again", options.crs
    if made is not None:
        _require_made_so(folder, made, made_with(options, roof_height))
    if lod is not None and lod != city.scene.lod:
        raise CityModelError(
            f"{folder} holds level of detail {city.scene.lod or 'none'}, not {lod}.", f"{again}."
        )
    own = city.scene.crs
    # Degrees and feet of the file were projected when the scene was made, to a system of another name.
    is_other = crs is not None and require_crs(crs).is_metric and (own is None or not is_same_plane(own, crs))
    if is_other:
        raise CityModelError(
            f"{folder} is in {own or 'no reference system that is known'}, not in {crs}.",
            f"{again}, with `crs={crs}`.",
        )
    if own is not None and own.startswith(_WORLD) and not _is_true_to_scale(city.scene, own):
        raise CityModelError(f"{folder} is in {own}, whose metres are no metres there.", f"{again}.")
    return city


def _require_made_so(folder: Path, made: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """Makes sure that a scene was made with all that is requested now (``made_with``)."""
    for name, value in wanted.items():
        # A level that was there needed no rule.
        if value != made.get(name, value if name == "roof_height" else None):
            how = f"with {name}={_text(made[name])}" if name in made else f"without {name}"
            raise CityModelError(
                f"{folder} is a scene made {how}: {name}={_text(value)} would change nothing now.",
                f"Leave {name} out, or convert the file it was made from again.",
            )


def _text(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)


def _is_true_to_scale(scene: Scene, crs: str) -> bool:
    middle = scene.origin[:2] + np.mean(scene.extent_m, axis=0)[:2]
    return is_true_to_scale(require_crs(crs), middle, Findings())


def load_city(folder: Path) -> OpenCity:
    """Returns the city of a scene folder.

    Raises:
        CityModelError: It is damaged.
    """
    return _load_stored(folder)[0]


def _load_stored(folder: Path) -> tuple[OpenCity, dict[str, Any] | None]:
    """Returns a stored city, and how it was made (``made_with``): None where it does not say."""
    scene, extra = read_scene(folder)
    try:
        findings = {str(name): int(count) for name, count in extra["findings"].items()}
        period = period_of(extra.get("period"))
        city = OpenCity(scene, findings, float(extra["area_m2"]), float(extra["lost_m2"]), period)
        return city, None if "made_with" not in extra else dict(extra["made_with"])
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise CityModelError(f"The scene in {folder} is damaged ({error}).", "Delete the folder.") from None
