"""Scenes of tiles joined into one on disk: by copying, a tile at a time, into one frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.raw import starts_of
from lodbench.citymodel.scene_file import read_scene, scene_folder
from lodbench.errors import CityModelError
from lodbench.storage.arrays import write_blocks

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
    """What there is to know of scenes before they are joined.

    Attributes:
        origins: (3,) of each.
        vertices: How many each of its buildings has, (B,), scene by scene.
        triangles: Likewise.
        extent: Lower and upper corner of all, coordinates.
        pitched: Numbers of the buildings with pitched roofs.
        lod, crs: Of the last that has anything in it.
    """

    origins: list[NDArray[np.float64]]
    vertices: list[NDArray[np.int64]]
    triangles: list[NDArray[np.int64]]
    extent: list[list[float]]
    pitched: list[int]
    lod: str
    crs: str | None


def _looked_at(folders: Sequence[Path]) -> _Parts:
    """Returns what there is to know of scenes.

    Raises:
        CityModelError: One is damaged, there is nothing to see, or there are too many corners to number.
    """
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
