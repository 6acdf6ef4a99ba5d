"""The engine's arrays of large scenes, kept on disk: laid out once, and mapped ever after."""

from __future__ import annotations

import json
import logging
from functools import cache
from pathlib import Path

import numpy as np

from lodbench.citymodel.scene import Scene
from lodbench.kernels import arguments
from lodbench.kernels.arguments import SceneArrays
from lodbench.rendering import engine_layout, selection, topology
from lodbench.storage import digest_of, file_digest, make_folder, new_folder, write_text
from lodbench.storage.arrays import map_array, write_arrays
from lodbench.storage.json_text import parse_json
from lodbench.storage.paths import cache_limit_bytes, cache_root, mark_used, prune_cache

_LOGGER = logging.getLogger(__name__)

# Fewer triangles are laid out in a second or two: not worth their place on disk.
_STORED_FROM_TRIANGLES = 500_000
_DIGESTS = "digests.json"


def open_arrays(scene: Scene) -> SceneArrays:
    """Returns a scene laid out for the kernel, mapped from the cache where that is worth it.

    Only scenes that are themselves mapped from disk are kept: their digest is known without reading
    them. A cache that cannot be written costs nothing but the time.
    """
    if not scene.stored_digest or len(scene.triangles) < _STORED_FROM_TRIANGLES:
        return engine_layout.scene_arrays(scene)
    folder = arrays_folder(scene)
    if folder.is_dir():
        try:
            arrays = _read(folder)
            mark_used(folder)
            return arrays
        except (OSError, ValueError, KeyError, TypeError) as error:
            _LOGGER.warning("The engine's arrays in %s are damaged: %s. They are made anew.", folder, error)
    arrays = engine_layout.scene_arrays(scene)
    try:
        make_folder(folder.parent)
        with new_folder(folder, survives_power_cut=False) as partial:
            digests = write_arrays(partial, arrays._asdict())
            write_text(partial / _DIGESTS, json.dumps(digests), survives_power_cut=False)
        prune_cache(folder.parent, cache_limit_bytes(), keep=folder)
        return _read(folder)
    except OSError as error:
        _LOGGER.info("The engine's cache %s cannot be written: %s", folder.parent, error)
        return arrays


def arrays_folder(scene: Scene) -> Path:
    """Returns where the arrays of a scene that is mapped from disk are kept."""
    return cache_root() / "engine" / digest_of([scene.stored_digest, _code_digest()], length=24)


def _read(folder: Path) -> SceneArrays:
    digests = parse_json((folder / _DIGESTS).read_text(encoding="utf-8"))
    mapped = (map_array(folder / f"{name}.npy", digests[name]) for name in SceneArrays._fields)
    # As plain arrays: compiled code is chosen by type, and a memmap is another.
    return SceneArrays(*(np.asarray(array) for array in mapped))


@cache
def _code_digest() -> str:
    """Returns a digest of the code that lays scenes out: no version number has to be remembered."""
    modules = (arguments, engine_layout, selection, topology)
    return digest_of([file_digest(Path(str(module.__file__))) for module in modules])
