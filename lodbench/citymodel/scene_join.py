"""Scenes of tiles joined into one on disk: by copying, a tile at a time, into one frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

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
    shapes, origins = [], []
    counts: dict[str, list[NDArray[np.int64]]] = {"vertices": [], "triangles": []}
    low, high, lod, crs = np.full(3, np.inf), np.full(3, -np.inf), "", None
    for folder in folders:
        scene, _ = read_scene(folder)
        shapes.append((len(scene.vertices), len(scene.triangles)))
        origins.append(scene.origin)
        counts["vertices"].append(np.diff(scene.vertex_starts))
        counts["triangles"].append(np.diff(scene.triangle_starts))
        if len(scene.vertices):
            corners = scene.extent_m
            low, high = (
                np.minimum(low, corners[0] + scene.origin),
                np.maximum(high, corners[1] + scene.origin),
            )
            lod, crs = scene.lod, scene.crs
    num_vertices, num_triangles = (sum(column) for column in zip(*shapes, strict=True)) if shapes else (0, 0)
    if num_triangles == 0:
        raise CityModelError("The tiles have no surfaces to render.", "Ask for another lod.")
    if num_vertices > _MAX_VERTICES:
        raise CityModelError(
            f"The tiles have {num_vertices:,} corners, more than one scene can number.",
            "Make several scenes.",
        )
    origin = np.min(origins, axis=0)
    starts = {name: starts_of(np.concatenate(parts)) for name, parts in counts.items()}
    firsts = starts_of(np.array([shape[0] for shape in shapes]))

    def moved() -> Iterator[NDArray[np.float32]]:
        for folder, place in zip(folders, origins, strict=True):
            scene, _ = read_scene(folder)
            yield (scene.vertices + (place - origin)).astype(np.float32)

    def renumbered() -> Iterator[NDArray[np.int32]]:
        for folder, first in zip(folders, firsts.tolist(), strict=False):
            scene, _ = read_scene(folder)
            yield scene.triangles + np.int32(first)

    def write(partial: Path) -> dict[str, str]:
        blocks: dict[str, tuple[Callable[[], Iterator[NDArray[Any]]], Any, tuple[int, ...]]] = {
            "vertices": (moved, np.float32, (num_vertices, 3)),
            "triangles": (renumbered, np.int32, (num_triangles, 3)),
            "vertex_starts": (lambda: iter([starts["vertices"]]), np.int64, starts["vertices"].shape),
            "triangle_starts": (lambda: iter([starts["triangles"]]), np.int64, starts["triangles"].shape),
        }
        return {
            name: write_blocks(partial / f"{name}.npy", make(), dtype, shape)
            for name, (make, dtype, shape) in blocks.items()
        }

    about = {
        "building_ids": list(building_ids),
        "lod": lod,
        "crs": crs,
        "origin": origin.tolist(),
        "extra": {**extra, "extent": [low.tolist(), high.tolist()], "triangles": num_triangles},
    }
    scene_folder(target, about, write)
    return about
