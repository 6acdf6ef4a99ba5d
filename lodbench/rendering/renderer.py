"""What a renderer is to the rest of lodbench, and renderers by name, imported when first requested."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.errors import ConfigError
from lodbench.geometry import Camera, Pose
from lodbench.plugins import blaming, load_plugin, plugin_names
from lodbench.rendering.fit import Fit, fit_values
from lodbench.rendering.masks import Instances, Words, pack_mask, words_per_row
from lodbench.rendering.projection import require_poses, require_size


@dataclass(frozen=True, slots=True, eq=False)
class Layers:
    """What every pixel of a view shows."""

    # (H, W) float32 distance along the optical axis, metres; 0 where there is no building
    depth: NDArray[np.float32]
    building: NDArray[np.int32]  # (H, W) int32 index into ``scene.building_ids``, -1 where there is none
    triangle: NDArray[np.int32]  # (H, W) int32 index into ``scene.triangles``, -1 where there is none
    # (H, W, 3) float32 unit normal in world axes, on the camera's side of the surface, since the order of
    # corners in published models is not to be trusted; 0 where there is none
    normal: NDArray[np.float32]
    colour: NDArray[np.uint8]  # (H, W, 3) uint8 RGB, the building's plain colours in the sun

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Returns the (H, W) silhouette."""
        return self.triangle >= 0

    def instance_masks(self) -> dict[int, NDArray[np.bool_]]:
        """Returns the (H, W) mask of what is seen of each building, by index, ascending.

        Buildings in front hide those behind: the masks do not overlap, and their union is ``mask``.
        """
        buildings = np.unique(self.building)
        return {int(b): self.building == b for b in buildings if b >= 0}


Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class IouCounts:
    """Pixel counts of N hypotheses against one query mask; exact integers, so ties are ties."""

    intersection: NDArray[np.int64]  # (N,) int64 pixels in both
    union: NDArray[np.int64]  # (N,) int64 pixels in either

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


# What a renderer can do besides silhouettes, by the function that does it: see the protocols.
DEPTH, LAYERS, INSTANCES = "depth", "draw", "instances"


def renderers_with(ability: str) -> tuple[str, ...]:
    """Returns the names of the renderers whose class has a function; broken ones are left out."""
    able = []
    for name in plugin_names("renderers"):
        try:
            kind = load_plugin("renderers", name)
        except ConfigError:  # reported to those who choose it
            continue
        if hasattr(kind, ability):
            able.append(name)
    return tuple(able)


def open_renderer(name: str, scene: Scene, threads: int | None = None) -> Renderer:
    """Returns the renderer of a name, with all it can do.

    Args:
        name: An entry point under ``lodbench.renderers``: a class that is made from a scene and threads.
        scene: The city.
        threads: Worker threads, None for one per core; pyrender and the reference use their own.

    Raises:
        ConfigError: There is no such renderer, or it is broken.
        RenderingError: A library the renderer needs is absent.
    """
    kind = load_plugin("renderers", name)
    with blaming("renderers", name, "be made"):
        made: Renderer = kind(scene, threads)
        for member in ("name", "scene", "render"):
            getattr(made, member)
        return made


def make_renderer(name: str, scene: Scene, threads: int | None = None) -> Scorer:
    """Returns the renderer of a name, ready to score hypotheses; arguments as for ``open_renderer``.

    Raises:
        ConfigError: There is no such renderer, or it is broken.
        RenderingError: A library the renderer needs is absent.
    """
    renderer = open_renderer(name, scene, threads)
    return cast("Scorer", renderer) if hasattr(renderer, "counts") else RenderAndCompare(renderer)


class RenderAndCompare:
    """Gives any renderer the engine's ``silhouettes``, ``counts`` and ``fit``, drawing pose after pose.

    What else the renderer can do, ``depth`` or ``draw``, is there too.
    """

    def __init__(self, renderer: Renderer) -> None:
        self.name = renderer.name
        self.scene = renderer.scene
        self._renderer = renderer

    def __getattr__(self, name: str) -> Any:
        # Private names are looked up before __init__ has run, by copying for one.
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self._renderer, name)

    def render(self, camera: Camera, pose: Pose) -> NDArray[np.bool_]:
        """Returns the (H, W) silhouette seen from a pose.

        Raises:
            TypeError: The renderer draws something else.
        """
        drawn = np.asarray(self._renderer.render(camera, pose))
        if drawn.shape != (camera.height, camera.width) or drawn.dtype != np.bool_:
            wanted = f"bool {(camera.height, camera.width)}"
            raise TypeError(f"renderer={self.name} drew {drawn.dtype} {drawn.shape}, not {wanted}")
        return drawn

    def silhouettes(self, camera: Camera, rotations: Floats, centers: Floats) -> Words:
        """Returns N silhouettes as (N, H, ceil(W / 64)) bit-packed words."""
        words = np.zeros((len(centers), camera.height, words_per_row(camera.width)), dtype=np.uint64)
        for i, drawn in enumerate(self._views(camera, rotations, centers)):
            words[i] = pack_mask(drawn)
        return words

    def counts(
        self, camera: Camera, rotations: Floats, centers: Floats, mask: NDArray[np.bool_]
    ) -> IouCounts:
        """Counts how N hypotheses overlap an (H, W) mask."""
        require_size(camera, (mask.shape[1], mask.shape[0]))
        counts = np.zeros((2, len(centers)), dtype=np.int64)
        for i, drawn in enumerate(self._views(camera, rotations, centers)):
            counts[:, i] = np.count_nonzero(drawn & mask), np.count_nonzero(drawn | mask)
        return IouCounts(counts[0], counts[1])

    def fit(self, camera: Camera, rotations: Floats, centers: Floats, fit: Fit) -> Floats:
        """Returns how well N hypotheses fit a query, (N,) float64."""
        require_size(camera, fit.size)
        drawn = self._views(camera, rotations, centers)
        return np.array([fit_values(fit, pack_mask(mask)[None])[0] for mask in drawn], dtype=np.float64)

    def _views(self, camera: Camera, rotations: Floats, centers: Floats) -> Iterator[NDArray[np.bool_]]:
        for rotation, center in zip(*require_poses(rotations, centers), strict=True):
            yield self.render(camera, Pose.from_center(rotation, center))
