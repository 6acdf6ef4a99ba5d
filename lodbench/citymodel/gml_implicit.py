"""Implicit geometry: one shape in a frame of its own, set down in many places by a matrix."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.coordinates import parse_rings
from lodbench.citymodel.xml import Element, local_name


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """Where a shape is set down.

    Attributes:
        matrix: (3, 4) from the shape's frame to metres around the anchor.
        anchor: (3,) in the coordinates of the file.
    """

    matrix: NDArray[np.float64]
    anchor: NDArray[np.float64]

    def apply(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns points (N, 3) of the shape in the coordinates of the file."""
        placed: NDArray[np.float64] = points @ self.matrix[:, :3].T + self.matrix[:, 3] + self.anchor
        return placed


def read_placement(geometry: Element) -> Placement | None:
    """Returns the placement of an ``ImplicitGeometry``, or None where it is incomplete or malformed.

    The matrix is 4x4, row by row, the identity where it is left out; the anchor must be there.
    """
    matrix, anchor = np.eye(4)[:3], None
    for child in geometry:
        name = local_name(child.tag)
        if name == "transformationMatrix":
            values = _numbers(child.text or "")
            if len(values) != 16:
                return None
            matrix = values.reshape(4, 4)[:3]
        elif name == "referencePoint":
            text = " ".join(pos.text or "" for pos in child.iter("{*}pos", "{*}coordinates"))
            anchor = _numbers(text.replace(",", " "))
    if anchor is None or len(anchor) != 3 or not np.isfinite(matrix).all() or not np.isfinite(anchor).all():
        return None
    return Placement(matrix, anchor)


def _numbers(text: str) -> NDArray[np.float64]:
    return parse_rings([text])[0]
