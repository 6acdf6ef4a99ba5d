"""Scenes on disk: a folder of plain arrays that are mapped into memory, never copied or unpickled."""

from __future__ import annotations

import errno
import json
from pathlib import Path
from typing import Any

import numpy as np

from lodbench.citymodel.scene import Scene
from lodbench.errors import CityModelError
from lodbench.storage import new_folder

# Raise it whenever the arrays or their meaning change: older folders are then read no more.
FORMAT_VERSION = 3
_ARRAYS = ("vertices", "triangles", "vertex_starts", "triangle_starts")
# Version 2 kept these too; its folders may still be replaced.
_FORMER_ARRAYS = ("boxes", "grid", "cell_starts", "cell_buildings")
_META = "scene.json"


def write_scene(scene: Scene, folder: Path, extra: dict[str, Any] | None = None) -> None:
    """Writes a scene as a folder, which appears whole or not at all.

    Args:
        scene: What to write.
        folder: Where; a scene already there is replaced, anything else is left alone.
        extra: Plain values to keep with it.

    Raises:
        OSError: The parent folder is missing or not writable, or something else is there already.
    """
    if folder.exists() and not _is_ours(folder):
        raise FileExistsError(errno.EEXIST, "something else is there already")
    with new_folder(folder) as partial:
        for name in _ARRAYS:
            np.save(partial / f"{name}.npy", getattr(scene, name), allow_pickle=False)
        meta = {
            "version": FORMAT_VERSION,
            "building_ids": scene.building_ids,
            "lod": scene.lod,
            "crs": scene.crs,
            "origin": scene.origin.tolist(),
            "digest": scene.digest(),
            "extra": extra or {},
        }
        (partial / _META).write_text(json.dumps(meta), encoding="utf-8")


def is_scene(path: Path) -> bool:
    """Tells whether a path is a folder that ``write_scene`` wrote."""
    return (path / _META).is_file()


def _is_ours(folder: Path) -> bool:
    """Tells whether a folder holds nothing but parts of a scene, so that it may be replaced."""
    known = {_META, *(f"{name}.npy" for name in (*_ARRAYS, *_FORMER_ARRAYS))}
    return folder.is_dir() and {path.name for path in folder.iterdir()} <= known


def read_scene(folder: Path) -> Scene:
    """Returns a scene whose arrays are mapped from disk, read only.

    Raises:
        CityModelError: The folder holds no scene, one of another version, or a damaged one.
    """
    meta = _read_meta(folder)
    arrays = {name: _load(folder, name) for name in _ARRAYS}
    try:
        return Scene(
            **arrays,
            building_ids=tuple(str(name) for name in meta["building_ids"]),
            lod=str(meta["lod"]),
            crs=meta["crs"],
            origin=np.asarray(meta["origin"], np.float64).reshape(3),
            stored_digest=str(meta["digest"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise CityModelError(f"The scene in {folder} is damaged ({error}).", "Delete the folder.") from None


def read_extra(folder: Path) -> dict[str, Any]:
    """Returns the plain values kept with a scene."""
    extra: dict[str, Any] = _read_meta(folder).get("extra", {})
    return extra


def _read_meta(folder: Path) -> dict[str, Any]:
    try:
        meta = json.loads((folder / _META).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise CityModelError(f"There is no scene in {folder} ({error}).") from None
    if not isinstance(meta, dict) or meta.get("version") != FORMAT_VERSION:
        raise CityModelError(f"The scene in {folder} was written by another version.", "Delete the folder.")
    return meta


def _load(folder: Path, name: str) -> Any:
    try:
        return np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise CityModelError(f"The scene in {folder} is damaged ({error}).", "Delete the folder.") from None
