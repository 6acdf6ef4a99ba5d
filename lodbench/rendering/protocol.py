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


@dataclass(frozen=True, slots=True, eq=False)
class Layers:
    """What every pixel of a view shows.

    Attributes:
        depth: (H, W) float32 distance along the optical axis, metres; 0 where there is no building.
        building: (H, W) int32 index into ``scene.building_ids``, -1 where there is none.
        triangle: (H, W) int32 index into ``scene.triangles``, -1 where there is none.
        normal: (H, W, 3) float32 unit normal in world axes, on the camera's side of the surface, since
            the order of corners in published models is not to be trusted; 0 where there is none.
        colour: (H, W, 3) uint8 RGB, the building's plain colours in the sun.
    """

    depth: NDArray[np.float32]
    building: NDArray[np.int32]
    triangle: NDArray[np.int32]
    normal: NDArray[np.float32]
    colour: NDArray[np.uint8]

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Returns the (H, W) silhouette."""
        return self.triangle >= 0

    def instance_masks(self) -> dict[int, NDArray[np.bool_]]:
        """Returns the (H, W) mask of what is seen of each building, by index, ascending.

        Buildings in front hide those behind: the masks do not overlap, and their union is ``mask``.
        """
        seen = np.unique(self.building)
        return {int(b): self.building == b for b in seen if b >= 0}


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
