"""The scene cache: a city file is parsed once, and mapped from disk ever after."""

from __future__ import annotations

import logging
from dataclasses import asdict
from pathlib import Path

from lodbench.citymodel.mesh import mesh_model
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.read import read_city_model
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.scene_file import FORMAT_VERSION, read_scene, write_scene
from lodbench.citymodel.source import open_sources
from lodbench.errors import CityModelError
from lodbench.storage import digest_of, file_digest
from lodbench.storage.paths import cache_root

_LOGGER = logging.getLogger(__name__)


def open_cached_scene(
    path: str | Path,
    *,
    lod: str | None = None,
    options: ReadOptions | None = None,
    roof_height: str | None = None,
) -> Scene:
    """Returns the scene of ``open_scene``, from the cache where it is there.

    The key is made of the content of every file, the options and the version of the cache, so a
    file that changes is read again and a copy under another name is not. A cache that cannot be
    written costs nothing but the time.

    Args:
        path: As for ``read_city_model``.
        lod: As for ``mesh_city``.
        options: As for ``read_city_model``.
        roof_height: As for ``mesh_city``.

    Raises:
        CityModelError: The file cannot be read, or has no building at that level.
    """
    options = options or ReadOptions()
    folder = cache_root() / "scenes" / scene_key(Path(path), lod, options, roof_height)
    try:
        return read_scene(folder)
    except CityModelError:
        pass  # not there, damaged, or of another version: made anew
    mesh = mesh_model(read_city_model(path, options=options), lod, roof_height=roof_height)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        write_scene(mesh.scene, folder)
    except OSError as error:
        _LOGGER.info("The scene cache %s cannot be written: %s", folder.parent, error)
    return mesh.scene


def scene_key(path: Path, lod: str | None, options: ReadOptions, roof_height: str | None) -> str:
    """Returns the name of a scene in the cache, 24 hexadecimal digits.

    Raises:
        CityModelError: The file is missing or cannot be read.
    """
    files = dict.fromkeys(source.path for source in open_sources(path))
    if options.terrain is not None:
        files[Path(options.terrain)] = None
    try:
        digests = [_digest(file) for file in files]
    except OSError as error:
        raise CityModelError(f"{path} cannot be read: {error.strerror}.") from None
    return digest_of(
        [FORMAT_VERSION, digests, lod, {**asdict(options), "terrain": None}, roof_height], length=24
    )


def _digest(path: Path) -> list[str]:
    """Returns digests of a file and of those that belong to it (a Shapefile's .dbf and .prj)."""
    if path.is_dir():
        return [file_digest(file) for file in sorted(path.rglob("*")) if file.is_file()]
    if path.suffix.lower() == ".shp":
        return [file_digest(file) for file in sorted(path.parent.glob(f"{path.stem}.*"))]
    return [file_digest(path)]
