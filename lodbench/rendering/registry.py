"""Renderers by name, imported when first asked for."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.errors import ConfigError
from lodbench.geometry import Camera, Pose
from lodbench.plugins import blaming, load_plugin, plugin_names
from lodbench.rendering.bits import Words, pack_mask, words_per_row
from lodbench.rendering.fit import Fit, fit_values
from lodbench.rendering.projection import require_poses, require_size
from lodbench.rendering.protocol import Floats, IouCounts, Renderer, Scorer

# What a renderer can do besides silhouettes, by the function that does it: see the protocols.
DEPTH, LAYERS, INSTANCES = "depth", "draw", "instances"


def renderers_with(ability: str) -> tuple[str, ...]:
    """Returns the names of the renderers whose class has a function; broken ones are left out."""
    able = []
    for name in plugin_names("renderers"):
        try:
            kind = load_plugin("renderers", name)
        except ConfigError:  # told to those who choose it
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
        # Private names are asked for before __init__ has run, by copying for one.
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
        rotations, centers = require_poses(rotations, centers)
        words = np.zeros((len(centers), camera.height, words_per_row(camera.width)), dtype=np.uint64)
        for i, (rotation, center) in enumerate(zip(rotations, centers, strict=True)):
            words[i] = pack_mask(self.render(camera, Pose.from_center(rotation, center)))
        return words

    def counts(
        self, camera: Camera, rotations: Floats, centers: Floats, mask: NDArray[np.bool_]
    ) -> IouCounts:
        """Counts how N hypotheses overlap an (H, W) mask."""
        require_size(camera, (mask.shape[1], mask.shape[0]))
        rotations, centers = require_poses(rotations, centers)
        counts = np.zeros((2, len(centers)), dtype=np.int64)
        for i, (rotation, center) in enumerate(zip(rotations, centers, strict=True)):
            drawn = self.render(camera, Pose.from_center(rotation, center))
            counts[:, i] = np.count_nonzero(drawn & mask), np.count_nonzero(drawn | mask)
        return IouCounts(counts[0], counts[1])

    def fit(self, camera: Camera, rotations: Floats, centers: Floats, fit: Fit) -> Floats:
        """Returns how well N hypotheses fit a query, (N,) float64."""
        require_size(camera, fit.size)
        rotations, centers = require_poses(rotations, centers)
        values = np.zeros(len(centers))
        for i, (rotation, center) in enumerate(zip(rotations, centers, strict=True)):
            drawn = pack_mask(self.render(camera, Pose.from_center(rotation, center)))
            values[i] = fit_values(fit, drawn[None])[0]
        return values
