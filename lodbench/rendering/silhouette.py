"""The silhouette engine: renders and scores pose hypotheses on the CPU, bit for bit reproducible."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.geometry import Camera, Pose
from lodbench.rendering.bits import Words, count_bits, pack_mask, unpack_mask, words_per_row
from lodbench.rendering.coverage import blank_coverage, edge_lines
from lodbench.rendering.engine_arrays import Scratch, View
from lodbench.rendering.engine_kernel import draw_view, draw_views, score_views
from lodbench.rendering.engine_layout import scene_arrays
from lodbench.rendering.fit import Fit, IouFit
from lodbench.rendering.projection import (
    pose_arrays,
    require_pinhole,
    require_poses,
    require_size,
    view_planes,
)
from lodbench.rendering.protocol import IouCounts

Floats = NDArray[np.float64]

# Hypotheses handed to a thread at a time: enough to hide the hand-over (about 50 us), few enough
# to share a filter step of 52 evenly between cores.
_CHUNK = 13


class SilhouetteRenderer:
    """Renders the union of a scene's projected faces, and counts its overlap with a query mask.

    The scene is prepared once (edges, bounding spheres); rendering holds no state of its own, and the
    result does not depend on the number of threads or on how hypotheses are batched. Each thread keeps
    its working memory, which every view leaves cleared.

    Args:
        scene: The city, local metric frame.
        threads: Worker threads; None for one per core.
    """

    name = "silhouette"

    def __init__(self, scene: Scene, threads: int | None = None) -> None:
        self.scene = scene
        self.threads = max(1, threads or os.cpu_count() or 1)
        self._arrays = scene_arrays(scene)
        self._largest = np.diff(self._arrays.starts, axis=0).max(axis=0)
        self._pool = ThreadPoolExecutor(self.threads) if self.threads > 1 else None
        self._of_thread = threading.local()

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
        view, words = _view(camera), _blank(camera)
        draw_view(self._arrays, *pose_arrays(pose), view, self._working_memory(camera)[0], words)
        return words

    def score(self, camera: Camera, rotations: Floats, centers: Floats, mask: NDArray[np.bool_]) -> IouCounts:
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
        shared = np.zeros(len(centers), dtype=np.int64)
        area = np.zeros(len(centers), dtype=np.int64)

        def work(part: slice) -> None:
            memory, words = self._working_memory(camera)
            poses = rotations[part], centers[part]
            score_views(self._arrays, *poses, view, memory, words, query, shared[part], area[part])

        self._spread(work, len(centers))
        return IouCounts(shared, area + count_bits(query) - shared)

    def measure(self, camera: Camera, rotations: Floats, centers: Floats, fit: Fit) -> Floats:
        """Returns how well N hypotheses' silhouettes fit a query, (N,) float64, higher is better.

        Args:
            camera: Pinhole of the fit's size.
            rotations: (N, 3, 3) cam_from_world.
            centers: (N, 3) camera centres, local metres.
            fit: Made from the query; see ``lodbench/rendering/fit.py``.

        Raises:
            RenderingError: As for ``score``.
        """
        if isinstance(fit, IouFit):
            return self.score(camera, rotations, centers, fit.mask).iou()
        require_size(camera, fit.size)
        view = _view(camera)
        rotations, centers = require_poses(rotations, centers)
        values = np.zeros(len(centers))

        def work(part: slice) -> None:
            memory, blank = self._working_memory(camera)
            words = np.zeros((len(centers[part]), *blank.shape), dtype=np.uint64)
            draw_views(self._arrays, rotations[part], centers[part], view, memory, words)
            values[part] = fit(words)

        self._spread(work, len(centers))
        return values

    def _spread(self, work: Callable[[slice], None], count: int) -> None:
        """Does the work on so many hypotheses, in parts, on this renderer's threads."""
        parts = _chunks(count, self.threads)
        if self._pool is None:
            for part in parts:
                work(part)
        else:
            list(self._pool.map(work, parts))

    def _working_memory(self, camera: Camera) -> tuple[Scratch, Words]:
        """Returns this thread's scratch and blank words for a size of image, made on first use."""
        size = camera.width, camera.height
        if getattr(self._of_thread, "size", None) != size:
            vertices, triangles, edges = (int(n) for n in self._largest)
            scratch = Scratch(
                np.zeros(vertices),
                np.zeros(vertices),
                np.zeros(vertices),
                np.zeros(triangles, dtype=np.int32),
                np.zeros(edges, dtype=np.int32),
                np.zeros(edges + 1, dtype=np.uint32),
                edge_lines(max(3, edges) + 1),
                blank_coverage(*size),
            )
            self._of_thread.size, self._of_thread.memory = size, (scratch, _blank(camera))
        memory: tuple[Scratch, Words] = self._of_thread.memory
        return memory


def _view(camera: Camera) -> View:
    require_pinhole(camera)
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    return View(camera.width, camera.height, intrinsics, view_planes(camera, 0, camera.width))


def _blank(camera: Camera) -> Words:
    return np.zeros((camera.height, words_per_row(camera.width)), dtype=np.uint64)


def _chunks(count: int, threads: int) -> Iterator[slice]:
    size = max(1, min(_CHUNK, -(-count // threads)))
    for start in range(0, count, size):
        yield slice(start, start + size)
