"""What a renderer is to the rest of lodbench."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.geometry import Camera, Pose
from lodbench.rendering.bits import Words
from lodbench.rendering.fit import Fit
from lodbench.rendering.instances import Instances
from lodbench.rendering.layers import Layers

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class IouCounts:
    """Pixel counts of N hypotheses against one query mask; exact integers, so ties are ties.

    Attributes:
        intersection: (N,) int64 pixels in both.
        union: (N,) int64 pixels in either.
    """

    intersection: NDArray[np.int64]
    union: NDArray[np.int64]

    def iou(self) -> Floats:
        """Returns (N,) intersection over union in [0, 1]; an empty union scores 0 (paper equation 2).

        Two different fractions of counts below 2**26 pixels never round to the same float64, so
        comparing these numbers is comparing the fractions.
        """
        return np.where(self.union > 0, self.intersection / np.maximum(self.union, 1), 0.0)


class Renderer(Protocol):
    """Draws building silhouettes of one scene."""

    name: str
    scene: Scene

    def render(self, camera: Camera, pose: Pose) -> NDArray[np.bool_]:
        """Returns the (H, W) silhouette seen from a pose."""
        ...


class DepthRenderer(Renderer, Protocol):
    """A renderer that also says how far away each pixel is."""

    def depth(self, camera: Camera, pose: Pose) -> NDArray[np.float32]:
        """Returns (H, W) float32 depth along the optical axis, metres; 0 where there is nothing."""
        ...


class LayerRenderer(DepthRenderer, Protocol):
    """A renderer that also says what each pixel shows."""

    def draw(self, camera: Camera, pose: Pose) -> Layers:
        """Returns every layer of the view from a pose."""
        ...


class InstanceRenderer(Renderer, Protocol):
    """A renderer that also says what each building alone would cover."""

    def instances(self, camera: Camera, pose: Pose) -> Instances:
        """Returns the silhouette of each building that covers a pixel, none hidden by another."""
        ...


class Scorer(Renderer, Protocol):
    """A renderer that also draws many hypotheses, and compares them with a query mask."""

    def silhouettes(self, camera: Camera, rotations: Floats, centers: Floats) -> Words:
        """Returns N silhouettes, bit-packed: (N, H, ceil(W / 64)) uint64 as of ``pack_mask``."""
        ...

    def counts(
        self, camera: Camera, rotations: Floats, centers: Floats, mask: NDArray[np.bool_]
    ) -> IouCounts:
        """Counts how N hypotheses, (N, 3, 3) rotations and (N, 3) centres, overlap an (H, W) mask."""
        ...

    def fit(self, camera: Camera, rotations: Floats, centers: Floats, fit: Fit) -> Floats:
        """Returns the similarity of N hypotheses to a query, (N,), in [0, 1]: see ``Fit``.

        With ``IouFit`` the numbers are those of ``counts``.
        """
        ...
