"""Where a mesh lies: origin and reference system, written into OBJ, PLY and glTF, and read again."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene

_NO_NAME = "unknown"
_ORIGIN, _CRS = "origin ", "crs "
_KEY = "lodbench"


@dataclass(frozen=True, slots=True)
class MeshFrame:
    """Place of a mesh.

    Attributes:
        origin: (3,) what was subtracted from the coordinates.
        crs: Their reference system, or None where it was unknown.
    """

    origin: NDArray[np.float64]
    crs: str | None

    @classmethod
    def of_scene(cls, scene: Scene) -> MeshFrame:
        """Returns the frame of a scene."""
        return cls(scene.origin, scene.crs)

    def comments(self) -> list[str]:
        """Returns two lines of text, as they stand in the comments of OBJ and PLY."""
        return [_ORIGIN + " ".join(map(repr, self.origin.tolist())), _CRS + (self.crs or _NO_NAME)]

    def extras(self) -> dict[str, Any]:
        """Returns plain values, as they stand in the extras of a glTF scene."""
        return {_KEY: {"origin": self.origin.tolist(), "crs": self.crs}}


def frame_of_comments(comments: list[str]) -> MeshFrame | None:
    """Returns the frame that two comments in a row tell, or None where they are anybody's.

    Example:
        >>> frame_of_comments(["origin 5.0 6.0 0.0", "crs EPSG:25832"]).crs
        'EPSG:25832'
        >>> frame_of_comments(["made by hand"]) is None
        True
    """
    for first, second in pairwise(comments):
        if first.startswith(_ORIGIN) and second.startswith(_CRS):
            name = second.removeprefix(_CRS).strip()
            return _frame(first.removeprefix(_ORIGIN).split(), None if name == _NO_NAME else name)
    return None


def frame_of_extras(metadata: Any) -> MeshFrame | None:
    """Returns the frame in the extras of a glTF scene, or None."""
    values = metadata.get(_KEY) if isinstance(metadata, dict) else None
    if not isinstance(values, dict) or not isinstance(values.get("crs"), str | None):
        return None
    return _frame(values.get("origin"), values.get("crs"))


def _frame(origin: Any, crs: str | None) -> MeshFrame | None:
    try:
        values = np.asarray(origin, np.float64).reshape(3)
    except (TypeError, ValueError):
        return None
    return MeshFrame(values, crs) if np.isfinite(values).all() else None
