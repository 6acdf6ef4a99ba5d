"""The silhouette engine: renders and scores pose hypotheses on the CPU, bit for bit reproducible."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.geometry import Camera, Pose
from lodbench.kernels import count_bits, draw_instances, draw_views, score_views
from lodbench.kernels.arguments import LANES, Scratch, View
from lodbench.rendering.engine_arrays import blank_scratch, moved_arrays, open_arrays
from lodbench.rendering.fit import Fit, IouFit, fit_values
from lodbench.rendering.masks import Instances, Words, pack_mask, unpack_mask, words_per_row
from lodbench.rendering.projection import (
    nearby_order,
    pose_arrays,
    require_pinhole,
    require_poses,
    require_size,
    select_buildings,
    view_planes,
)
from lodbench.rendering.renderer import IouCounts

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

# Groups of eight hypotheses handed to a thread at a time: enough to hide the hand-over (about 50 us), few
# enough to see much the same buildings.
_MOST_GROUPS = 8


class SilhouetteRenderer:
    """Renders the union of a scene's projected faces, and counts its overlap with a query mask.

    The scene is prepared once (edges, bounding spheres), one of a large city on disk for good. Rendering
    holds no state of its own, and the result does not depend on the number of threads or on how
    hypotheses are batched. Each thread keeps its working memory, which every view leaves cleared.

    Args:
        scene: The city, local metric frame.
        threads: Worker threads; None for one per core.
    """

    name = "silhouette"

    def __init__(self, scene: Scene, threads: int | None = None) -> None:
        self.scene = scene
        self.threads = max(1, threads or os.cpu_count() or 1)
        self._arrays = open_arrays(scene)
        self._pool = ThreadPoolExecutor(self.threads) if self.threads > 1 else None
        self._of_thread = threading.local()

    def with_vertices(self, vertices: NDArray[np.float32]) -> SilhouetteRenderer:
        """Returns a renderer of the scene with its vertices at (V, 3), local metres.

        What is prepared of its edges is shared, and so are threads and their memory.
        """
        other = copy(self)
        other.scene = replace(self.scene, vertices=vertices, stored_digest="")
        other._arrays = moved_arrays(self._arrays, other.scene)
        return other

    def render(self, camera: Camera, pose: Pose) -> NDArray[np.bool_]:
        """Returns the (H, W) silhouette seen from a pose.

        Raises:
            RenderingError: The camera has lens distortion or is wider than 8192 pixels, or the pose has
                values that are not finite.
        """
        words = self.render_words(camera, pose)
        return unpack_mask(words, camera.width)

    def render_words(self, camera: Camera, pose: Pose) -> Words:
        """Returns the silhouette as (H, ceil(W / 64)) bit-packed words."""
        view, words, (rotation, center) = _view(camera), _blank(camera), pose_arrays(pose)
        memory, _ = self._working_memory(camera)
        draw_views(self._arrays, rotation[None], center[None], view, memory, words[None])
        return words

    def instances(self, camera: Camera, pose: Pose) -> Instances:
        """Returns the silhouette of each building that covers a pixel, none hidden by another.

        Their union is ``render``'s silhouette, to the bit.

        Raises:
            RenderingError: As for ``render``.
        """
        view, (rotation, center) = _view(camera), pose_arrays(pose)
        poses = rotation[None], center[None]
        seen = np.sort(select_buildings(self._arrays, *poses, view.planes))
        scratch, words = self._working_memory(camera)
        return Instances(
            (camera.width, camera.height),
            *draw_instances(self._arrays, seen, *poses, view, scratch, words[:1]),
        )

    def silhouettes(self, camera: Camera, rotations: Floats, centers: Floats) -> Words:
        """Returns N silhouettes as (N, H, ceil(W / 64)) bit-packed words; arguments as for ``counts``."""
        view = _view(camera)
        rotations, centers = require_poses(rotations, centers)
        silhouettes = np.zeros((len(centers), *_blank(camera).shape), dtype=np.uint64)

        def work(part: Indices) -> None:
            silhouettes[part] = self._draw(camera, view, rotations[part], centers[part])

        self._share_out(work, rotations, centers)
        return silhouettes

    def counts(
        self, camera: Camera, rotations: Floats, centers: Floats, mask: NDArray[np.bool_]
    ) -> IouCounts:
        """Counts how N hypotheses' silhouettes overlap a query mask.

        Args:
            camera: Pinhole of the mask's size.
            rotations: (N, 3, 3) cam_from_world.
            centers: (N, 3) camera centres, local metres.
            mask: (H, W) query silhouette.

        Raises:
            RenderingError: The mask's size is not the camera's, or as for ``render``.
        """
        require_size(camera, (mask.shape[1], mask.shape[0]))
        view, query = _view(camera), pack_mask(mask)
        rotations, centers = require_poses(rotations, centers)
        counts = np.zeros((2, len(centers)), dtype=np.int64)

        def work(part: Indices) -> None:
            memory, words = self._working_memory(camera)
            poses = rotations[part], centers[part]
            of_part = np.empty((2, len(part)), dtype=np.int64)
            score_views(self._arrays, *poses, view, memory, words, query, of_part)
            counts[:, part] = of_part

        self._share_out(work, rotations, centers)
        shared, area = counts
        return IouCounts(shared, area + count_bits(query) - shared)

    def fit(self, camera: Camera, rotations: Floats, centers: Floats, fit: Fit) -> Floats:
        """Returns how well N hypotheses' silhouettes fit a query, (N,) float64, higher is better.

        Arguments and errors as of ``counts``; see ``lodbench/rendering/fit.py``.
        """
        if isinstance(fit, IouFit):
            return self.counts(camera, rotations, centers, fit.mask).iou()
        require_size(camera, fit.size)
        view = _view(camera)
        rotations, centers = require_poses(rotations, centers)
        values = np.zeros(len(centers))

        def work(part: Indices) -> None:
            values[part] = fit_values(fit, self._draw(camera, view, rotations[part], centers[part]))

        self._share_out(work, rotations, centers)
        return values

    def _draw(self, camera: Camera, view: View, rotations: Floats, centers: Floats) -> Words:
        """Returns the silhouettes of some poses, drawn on this thread."""
        memory, words = self._working_memory(camera)
        views = np.zeros((len(centers), *words.shape[1:]), dtype=np.uint64)
        draw_views(self._arrays, rotations, centers, view, memory, views)
        return views

    def _share_out(self, work: Callable[[Indices], None], rotations: Floats, centers: Floats) -> None:
        """Does the work on hypotheses, given by index, in parts on this renderer's threads."""
        count = len(centers)
        # Few are drawn at once, before another thread would have begun.
        order = nearby_order(rotations, centers) if count > LANES else np.arange(count)
        parts = list(_parts(order, self.threads))
        if self._pool is None or len(parts) == 1:
            for part in parts:
                work(part)
        else:
            list(self._pool.map(work, parts))

    def _working_memory(self, camera: Camera) -> tuple[Scratch, Words]:
        """Returns this thread's scratch and blank words for a size of image, made on first use."""
        size = camera.width, camera.height
        if getattr(self._of_thread, "size", None) != size:
            scratch = blank_scratch(self._arrays, *size)
            words = np.zeros((LANES, *_blank(camera).shape), dtype=np.uint64)
            self._of_thread.size, self._of_thread.memory = size, (scratch, words)
        memory: tuple[Scratch, Words] = self._of_thread.memory
        return memory


def _view(camera: Camera) -> View:
    """Returns what is drawn into."""
    require_pinhole(camera)
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], dtype=np.float64)
    return View(camera.width, camera.height, intrinsics, view_planes(camera, 0, camera.width))


def _blank(camera: Camera) -> Words:
    return np.zeros((camera.height, words_per_row(camera.width)), dtype=np.uint64)


def _parts(order: Indices, threads: int) -> Iterator[Indices]:
    """Returns groups of eight, several at a time while there are many for each thread."""
    fair_share = -(-len(order) // (4 * threads))
    size = min(max(-(-fair_share // LANES), 1), _MOST_GROUPS) * LANES
    for start in range(0, len(order), size):
        yield order[start : start + size]
