"""What stands in a picture besides the plain city model: ground, roads, trees, cars, detailed buildings.

A city file of LoD1 or LoD2 gives masks; a photo of the place shows more. ``SceneProps`` is that more:
triangles with the class of their surface and a base colour. ``town.props`` makes the demo town's, at level of
detail 3, in the town's own look; ``surroundings`` those of any city from footprints and building bases.

A renderer draws them and, where they hold no building surfaces (``has_buildings`` is false), the triangles of
the city's ``Scene`` too. Where they do, the buildings are complete, windows included: no facade is painted
on. Occluders (trees, cars, fences) hide what is behind them in the picture; whether they do in a mask is up
to the caller. Ground needs no depth bias: what lies on it is cut out of it or stands at least 3 cm above.
"""

from __future__ import annotations

import io
import zipfile
import zlib
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import RenderingError
from lodbench.kernels.looks import SurfaceClass
from lodbench.storage.atomic import write_bytes


@dataclass(frozen=True, slots=True, eq=False)
class SceneProps:
    """Triangles to be seen, in the local metric frame of a city's scenes (x east, y north, z up)."""

    # (V, 3) float32, metres; ``vertices + origin`` are coordinates in the city's CRS.
    vertices: NDArray[np.float32]
    # (T, 3) int32 indices into ``vertices``, counter-clockwise seen from outside.
    triangles: NDArray[np.int32]
    surface: NDArray[np.uint8]  # (T,) uint8 ``SurfaceClass``
    # (T,) int32 number of the object a triangle is part of: below ``num_buildings`` the index of the building
    # in the city file's order (``Scene.building_ids``), above one number for each tree, car or street. For
    # instance labels, and for one random tint per object.
    objects: NDArray[np.int32]
    # (T, 3) uint8 RGB, the base colour in white light, before texture, noise and shading.
    tint: NDArray[np.uint8]
    num_buildings: int  # buildings of the city file
    origin: NDArray[np.float64]  # (3,) float64

    def __len__(self) -> int:
        return len(self.triangles)

    @property
    def has_buildings(self) -> bool:
        """Whether the buildings themselves are among the triangles."""
        return bool((self.surface == SurfaceClass.WALL).any())

    def part(self, chosen: NDArray[np.bool_]) -> SceneProps:
        """Returns some of the triangles, chosen by a (T,) mask, and the vertices they use."""
        used, inverse = np.unique(self.triangles[chosen], return_inverse=True)
        return replace(
            self,
            vertices=self.vertices[used],
            triangles=inverse.reshape(-1, 3).astype(np.int32),
            surface=self.surface[chosen],
            objects=self.objects[chosen],
            tint=self.tint[chosen],
        )

    def in_frame(self, origin: NDArray[np.float64]) -> SceneProps:
        """Returns the same in the local frame of another origin, for example that of a ``Scene``."""
        shift = (self.origin - origin).astype(np.float32)
        return replace(self, vertices=self.vertices + shift, origin=np.asarray(origin, dtype=np.float64))


_FIELDS = tuple(field.name for field in fields(SceneProps))


def write_props(props: SceneProps, path: Path) -> None:
    """Writes props as a compressed ``.npz``, which appears whole or not at all.

    Raises:
        OSError: The folder is missing or not writable.
    """
    content = io.BytesIO()
    arrays: dict[str, Any] = {name: np.asarray(getattr(props, name)) for name in _FIELDS}
    np.savez_compressed(content, **arrays)
    write_bytes(path, content.getvalue())


def read_props(path: Path) -> SceneProps:
    """Returns props that ``write_props`` wrote.

    Raises:
        RenderingError: The file is missing, damaged, or no such file.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            values = {name: arrays[name] for name in _FIELDS}
        return SceneProps(**{**values, "num_buildings": int(values["num_buildings"])})
    except (OSError, ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        reason = (isinstance(error, OSError) and error.strerror) or "damaged, or another file"
        raise RenderingError(
            f"{path} holds no scene props ({reason}).",
            "props=FILE names what lodbench made; without it surroundings are made up.",
        ) from None
