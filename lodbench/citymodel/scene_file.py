"""Scenes on disk: a folder of plain arrays that are mapped into memory, never copied or unpickled.

Every array is compared with its digest when the folder is opened, and its numbers with each other: a folder
may be damaged, or come from a stranger, and compiled code trusts what it indexes with.
"""

from __future__ import annotations

import errno
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.model import starts_of
from lodbench.citymodel.scene import Scene
from lodbench.errors import CityModelError
from lodbench.storage import digest_of, new_folder, write_text
from lodbench.storage.digest import map_array, text_check, write_arrays, write_blocks
from lodbench.storage.json_text import parse_json

# Raise it whenever the arrays or their meaning change: older folders are then read no more.
FORMAT_VERSION = 4
_ARRAYS = ("vertices", "triangles", "vertex_starts", "triangle_starts")
# Version 2 kept these too; its folders may still be replaced.
_FORMER_ARRAYS = ("boxes", "grid", "cell_starts", "cell_buildings")
_META = "scene.json"
# What stands before the part of it that its check is of.
_BODY = ', "about": '
_AGAIN = "Delete the folder, and convert the city file again."


def write_scene(
    scene: Scene, folder: Path, extra: dict[str, Any] | None = None, survives_power_cut: bool = True
) -> None:
    """Writes a scene as a folder, which appears whole or not at all.

    Args:
        scene: What to write.
        folder: Where; a scene already there is replaced, anything else is left alone.
        extra: Plain values to keep with it.
        survives_power_cut: As for ``write_bytes``; a cache can do without.

    Raises:
        OSError: The parent folder is missing or not writable, or something else is there already.
    """
    about = {
        "building_ids": scene.building_ids,
        "pitched": [] if scene.pitched is None else np.flatnonzero(scene.pitched).tolist(),
        "lod": scene.lod,
        "crs": scene.crs,
        "origin": scene.origin.tolist(),
        "extra": extra or {},
    }
    arrays = {name: getattr(scene, name) for name in _ARRAYS}
    scene_folder(folder, about, lambda partial: write_arrays(partial, arrays), survives_power_cut)


def scene_folder(
    folder: Path,
    about: dict[str, Any],
    write: Callable[[Path], dict[str, str]],
    survives_power_cut: bool = True,
) -> None:
    """Writes a scene folder whose arrays somebody else fills in.

    Args:
        folder: As for ``write_scene``.
        about: What is stated of the scene: ``building_ids``, ``pitched``, ``lod``, ``crs``, ``origin`` and
            ``extra``.
        write: Writes the arrays into a folder, and returns their digests by name.
        survives_power_cut: As for ``write_bytes``.

    Raises:
        OSError: As for ``write_scene``.
    """
    if folder.exists() and not _is_ours(folder):
        raise FileExistsError(errno.EEXIST, "something else is there already")
    with new_folder(folder, survives_power_cut) as partial:
        body = json.dumps({**about, "arrays": write(partial)})
        head = f'{{"version": {FORMAT_VERSION}, "check": "{text_check(body)}"'
        write_text(partial / _META, f"{head}{_BODY}{body}}}", survives_power_cut=False)


def is_scene(path: Path) -> bool:
    """Returns whether a path is a folder that ``write_scene`` wrote."""
    return (path / _META).is_file()


def _is_ours(folder: Path) -> bool:
    """Returns whether a folder holds nothing but parts of a scene, so that it may be replaced."""
    known = {_META, *(f"{name}.npy" for name in (*_ARRAYS, *_FORMER_ARRAYS))}
    return folder.is_dir() and {path.name for path in folder.iterdir()} <= known


def read_scene(folder: Path) -> tuple[Scene, dict[str, Any]]:
    """Returns a scene whose arrays are mapped from disk, read only, and the plain values kept with it.

    Raises:
        CityModelError: The folder holds no scene, one of another version, or one that is damaged: a file is
            not the one that was written, or an index points out of its array.
    """
    about = read_about(folder)
    try:
        digests = about["arrays"]
        scene = Scene(
            **{name: map_array(folder / f"{name}.npy", digests[name]) for name in _ARRAYS},
            building_ids=tuple(map(str, about["building_ids"])),
            lod=str(about["lod"]),
            crs=None if about["crs"] is None else str(about["crs"]),
            origin=np.asarray(about["origin"], np.float64).reshape(3),
            pitched=_pitched(about.get("pitched", []), len(about["building_ids"])),
            # With its place: a stranger's folder cannot pass for a city of one's own.
            stored_digest=digest_of([str(folder.resolve()), digests]),
        )
        _check(scene)
        extra = about["extra"]
        if not isinstance(extra, dict):
            raise TypeError("its values are no table")
    except (OSError, KeyError, TypeError, ValueError, OverflowError) as error:
        reason = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise CityModelError(f"The scene in {folder} is damaged: {reason}.", _AGAIN) from None
    return scene, extra


def read_about(folder: Path) -> dict[str, Any]:
    """Returns what is stated of a scene, without a look at its arrays: ids, level, system, origin, extra.

    Raises:
        CityModelError: The folder holds no scene, one of another version, or what is reported is damaged.
    """
    try:
        text = (folder / _META).read_text(encoding="utf-8")
        meta = parse_json(text)
    except (OSError, ValueError) as error:
        raise CityModelError(f"There is no scene in {folder}: {error}.") from None
    if not isinstance(meta, dict) or meta.get("version") != FORMAT_VERSION:
        raise CityModelError(f"The scene in {folder} was written by another version.", _AGAIN)
    about = meta.get("about")
    body = text.partition(_BODY)[2].removesuffix("}")
    if not isinstance(about, dict) or meta.get("check") != text_check(body):
        raise CityModelError(f"The scene in {folder} is damaged: {_META} is not as written.", _AGAIN)
    return about


def scene_info(folder: Path) -> dict[str, Any]:
    """Returns what is stated of a scene, without a look at its arrays: cheap, however large the city.

    Returns:
        ``format, crs, lod, buildings, pitched_roofs, triangles, tiles, extent_m, area_m2, lost_m2, findings,
        finding_objects, period``; None where an older scene does not say it.

    Raises:
        CityModelError: The folder holds no scene, or is damaged.
    """
    about = read_about(folder)
    extra = about["extra"]
    extent = extra.get("extent")
    return {
        "format": "scene",
        "crs": about["crs"],
        "lod": about["lod"],
        "buildings": len(about["building_ids"]),
        "pitched_roofs": len(about.get("pitched", [])),
        "extent_m": None if extent is None else [round(b - a, 3) for a, b in zip(*extent, strict=True)],
        "findings": extra.get("findings", {}),
        "finding_objects": extra.get("finding_objects", {}),
        **{key: extra.get(key) for key in ("triangles", "tiles", "area_m2", "lost_m2", "period")},
    }


def _pitched(stated: list[int], count: int) -> NDArray[np.bool_] | None:
    """Returns (count,) which buildings have pitched roofs, given their numbers; None where none has."""
    if not all(type(number) is int and 0 <= number < count for number in stated):
        raise ValueError("a pitched roof has no building")
    pitched = np.zeros(count, np.bool_)
    pitched[np.asarray(stated, np.int64)] = True
    return pitched if stated else None


def _check(scene: Scene) -> None:
    """Makes sure that the arrays have their types and that no index points out of its building."""
    count = scene.num_buildings
    shapes: dict[str, tuple[type[np.generic], tuple[int, ...]]]
    shapes = {"vertices": (np.float32, (-1, 3)), "triangles": (np.int32, (-1, 3))}
    shapes |= {name: (np.int64, (count + 1,)) for name in ("vertex_starts", "triangle_starts")}
    for name, (dtype, shape) in shapes.items():
        array = getattr(scene, name)
        is_shaped = array.ndim == len(shape) and all(
            w in (-1, n) for w, n in zip(shape, array.shape, strict=True)
        )
        if array.dtype != dtype or not is_shaped or not array.flags.c_contiguous:
            raise ValueError(f"{name} is {array.dtype} {array.shape}")
    for starts, rows in ((scene.vertex_starts, scene.vertices), (scene.triangle_starts, scene.triangles)):
        if starts[0] != 0 or starts[-1] != len(rows) or (np.diff(starts) < 0).any():
            raise ValueError("its buildings do not follow each other")
    if not np.isfinite(scene.origin).all():
        raise ValueError("its origin is not finite")
    # Not a number is the smallest and the largest of all.
    if len(scene.vertices) and not np.isfinite([scene.vertices.min(), scene.vertices.max()]).all():
        raise ValueError("a coordinate is not finite")
    filled = np.flatnonzero(np.diff(scene.triangle_starts))
    if len(filled):
        corners, first = scene.triangles.reshape(-1), 3 * scene.triangle_starts[filled]
        is_inside = np.minimum.reduceat(corners, first) >= scene.vertex_starts[filled]
        is_inside &= np.maximum.reduceat(corners, first) < scene.vertex_starts[filled + 1]
        if not is_inside.all():
            raise ValueError("a triangle has a corner that its building has not")


_MAX_VERTICES = 2**31 - 1


def join_scenes(
    folders: Sequence[Path], building_ids: Sequence[str], target: Path, extra: dict[str, Any]
) -> dict[str, Any]:
    """Writes scenes in a row as one, in a frame at the south-west corner of all; returns what is told of it.

    Args:
        folders: Scenes of one reference system, each in a frame of its own.
        building_ids: Ids of all their buildings, in a row.
        target: The folder to write; a scene already there is replaced.
        extra: Plain values to keep with it; its extent is added.

    Raises:
        CityModelError: A part is damaged, there is nothing to see, or there are too many corners to number.
        OSError: As for ``write_scene``.
    """
    parts = _looked_at(folders)
    origin = np.min(parts.origins, axis=0)
    firsts = starts_of(np.array([counts.sum() for counts in parts.vertices]))
    vertex_starts, triangle_starts = (
        starts_of(np.concatenate(counts)) for counts in (parts.vertices, parts.triangles)
    )

    def moved() -> Iterator[NDArray[np.float32]]:
        for folder, place in zip(folders, parts.origins, strict=True):
            scene, _ = read_scene(folder)
            yield (scene.vertices + (place - origin)).astype(np.float32)

    def renumbered() -> Iterator[NDArray[np.int32]]:
        for folder, first in zip(folders, firsts.tolist(), strict=False):
            scene, _ = read_scene(folder)
            yield scene.triangles + np.int32(first)

    def write(partial: Path) -> dict[str, str]:
        blocks: dict[str, tuple[Iterator[NDArray[Any]], Any, tuple[int, ...]]] = {
            "vertices": (moved(), np.float32, (int(vertex_starts[-1]), 3)),
            "triangles": (renumbered(), np.int32, (int(triangle_starts[-1]), 3)),
            "vertex_starts": (iter([vertex_starts]), np.int64, vertex_starts.shape),
            "triangle_starts": (iter([triangle_starts]), np.int64, triangle_starts.shape),
        }
        return {name: write_blocks(partial / f"{name}.npy", *block) for name, block in blocks.items()}

    about = {
        "building_ids": list(building_ids),
        "pitched": parts.pitched,
        "lod": parts.lod,
        "crs": parts.crs,
        "origin": origin.tolist(),
        "extra": {**extra, "extent": parts.extent, "triangles": int(triangle_starts[-1])},
    }
    scene_folder(target, about, write)
    return about


class _Parts(NamedTuple):
    """What there is to know of scenes before they are joined."""

    origins: list[NDArray[np.float64]]  # (3,) of each
    vertices: list[NDArray[np.int64]]  # how many each of its buildings has, (B,), scene by scene
    triangles: list[NDArray[np.int64]]  # likewise
    extent: list[list[float]]  # lower and upper corner of all, coordinates
    pitched: list[int]  # numbers of the buildings with pitched roofs
    # Of the last that has anything in it
    lod: str
    crs: str | None


def _looked_at(folders: Sequence[Path]) -> _Parts:
    """Returns what there is to know of scenes."""
    origins, vertices, triangles = [], [], []
    pitched: list[int] = []
    num_buildings = 0
    low, high, lod, crs = np.full(3, np.inf), np.full(3, -np.inf), "", None
    for folder in folders:
        scene, _ = read_scene(folder)
        origins.append(scene.origin)
        if scene.pitched is not None:
            pitched += (num_buildings + np.flatnonzero(scene.pitched)).tolist()
        num_buildings += scene.num_buildings
        vertices.append(np.diff(scene.vertex_starts))
        triangles.append(np.diff(scene.triangle_starts))
        if len(scene.vertices):
            corners = np.stack(scene.extent_m) + scene.origin
            low, high = np.minimum(low, corners[0]), np.maximum(high, corners[1])
            lod, crs = scene.lod, scene.crs
    num_vertices, num_triangles = (sum(int(n.sum()) for n in counts) for counts in (vertices, triangles))
    if num_triangles == 0:
        raise CityModelError("The tiles have no surfaces to render.", "Ask for another lod.")
    if num_vertices > _MAX_VERTICES:
        raise CityModelError(
            f"The tiles have {num_vertices:,} corners, more than one scene can number.",
            "Make several scenes.",
        )
    return _Parts(origins, vertices, triangles, [low.tolist(), high.tolist()], pitched, lod, crs)
