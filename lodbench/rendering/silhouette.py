"""The silhouette engine: renders and scores pose hypotheses on the CPU, bit for bit reproducible.

A scene is laid out for it first, and that is kept on disk if it is large.
"""

from __future__ import annotations

import json
import logging
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.geometry import Camera, Pose
from lodbench.kernels import arguments, count_bits, draw_instances, draw_views, score_views
from lodbench.kernels.arguments import LANES, SceneArrays, Scratch, View
from lodbench.rendering import edges, projection
from lodbench.rendering.edges import edge_table
from lodbench.rendering.fit import Fit, IouFit, fit_values
from lodbench.rendering.masks import Instances, Words, pack_mask, unpack_mask, words_per_row
from lodbench.rendering.renderer import IouCounts
from lodbench.storage import digest_of, file_digest, make_folder, new_folder, write_text
from lodbench.storage.digest import map_array, write_arrays
from lodbench.storage.json_text import parse_json
from lodbench.storage.paths import cache_limit_bytes, cache_root, mark_used, prune_cache

Floats = NDArray[np.float64]
Indices = NDArray[np.uint32]

# Room in a hypothesis's list of edges: more than most views have, and small enough for the cache.
_LIST_CAPACITY = 8192


def blank_scratch(scene: SceneArrays, width: int, height: int) -> Scratch:
    """Returns working memory for a scene and a size of image, pixels."""
    vertices, triangles, edges = (int(n) for n in np.diff(scene.starts, axis=0).max(axis=0, initial=0))
    capacity = max(_LIST_CAPACITY, -(-(edges + 1) // LANES) * LANES)
    return Scratch(
        poses=np.zeros(12 * LANES),
        u=np.zeros(LANES * vertices, dtype=np.int32),
        v=np.zeros(LANES * vertices, dtype=np.int32),
        extent=np.zeros(4 * LANES),
        nearest=np.zeros(LANES),
        facing=np.zeros(LANES * triangles, dtype=np.int32),
        lists=edge_lists(capacity),
        coverage=blank_coverage(width, height),
        # Not filled: of a large city most of it is never touched.
        candidates=np.zeros((2, len(scene.order) + arguments.BRANCH), dtype=np.int64),
        polygons=np.zeros((2, arguments.MAX_CORNERS, 3)),
    )


def blank_coverage(width: int, height: int) -> arguments.Coverage:
    """Returns the coverage of an empty view."""
    strips = words_per_row(width)
    return arguments.Coverage(
        np.zeros(strips * (height + 1) * arguments.STRIP + LANES, dtype=np.int16),
        np.full((LANES, strips), height, dtype=np.int64),
        np.full((LANES, strips), -1, dtype=np.int64),
    )


def edge_lists(capacity: int) -> arguments.EdgeLists:
    """Returns empty lists with room for ``capacity`` edges each, a multiple of 8."""
    return arguments.EdgeLists(
        np.zeros(LANES * capacity, dtype=np.int64),
        np.zeros(LANES * capacity, dtype=np.int64),
        np.zeros(LANES, dtype=np.int64),
        np.zeros(capacity, dtype=np.int32),
        np.zeros(capacity, dtype=np.int32),
        np.zeros(capacity, dtype=np.int32),
        np.zeros(capacity),
        np.zeros(capacity),
    )


# Triangles laid out at a time: sorting their edges takes some fifty times their size meanwhile.
_CHUNK_TRIANGLES = 1 << 18


def scene_arrays(scene: Scene) -> SceneArrays:
    """Returns a scene laid out for the kernel; every array is read only, as those mapped from disk are."""
    columns: dict[str, list[NDArray[np.generic]]] = {}
    edge_counts = [np.zeros(1, dtype=np.int64)]
    for part in _parts(scene):
        arrays, edges_of_building = _part_arrays(part)
        edge_counts.append(edges_of_building)
        for name, array in arrays.items():
            columns.setdefault(name, []).append(array)
    starts = [scene.vertex_starts, scene.triangle_starts, np.cumsum(np.concatenate(edge_counts))]
    whole: dict[str, NDArray[np.generic]] = {"starts": np.stack(starts, axis=1), **_bounds(scene)}
    for name in list(columns):
        # One at a time, so that no more than one array is there twice.
        whole[name] = np.concatenate(columns.pop(name))
    return SceneArrays(**_read_only(whole))  # type: ignore[arg-type]


def moved_arrays(arrays: SceneArrays, scene: Scene) -> SceneArrays:
    """Returns the arrays of a scene that differs in where its vertices are from one laid out."""
    return arrays._replace(**_read_only({**_coordinates(scene), **_bounds(scene)}))  # type: ignore[arg-type]


def _coordinates(scene: Scene) -> dict[str, NDArray[np.generic]]:
    return dict(zip("xyz", np.ascontiguousarray(scene.vertices.T), strict=True))


def _bounds(scene: Scene) -> dict[str, NDArray[np.generic]]:
    spheres = projection.bounding_spheres(scene)
    return {"spheres": spheres, **projection.sphere_tree(spheres)._asdict()}


def _read_only(arrays: dict[str, NDArray[np.generic]]) -> dict[str, NDArray[np.generic]]:
    for array in arrays.values():
        array.setflags(write=False)
    return arrays


def _parts(scene: Scene) -> Iterator[Scene]:
    """Yields a scene in parts of a few buildings, whose triangles count vertices from the part's first."""
    wanted = np.arange(0, len(scene.triangles), _CHUNK_TRIANGLES)
    cuts = np.unique([0, *np.searchsorted(scene.triangle_starts, wanted), scene.num_buildings])
    for first, stop in pairwise(cuts):
        v, t = scene.vertex_starts[first : stop + 1], scene.triangle_starts[first : stop + 1]
        yield replace(
            scene,
            vertices=scene.vertices[v[0] : v[-1]],
            triangles=scene.triangles[t[0] : t[-1]] - np.int32(v[0]),
            vertex_starts=v - v[0],
            triangle_starts=t - t[0],
            building_ids=scene.building_ids[first:stop],
            pitched=None,
            stored_digest="",
        )


def _part_arrays(scene: Scene) -> tuple[dict[str, NDArray[np.generic]], NDArray[np.int64]]:
    """Returns the arrays of some buildings that have a row per vertex, triangle or edge; and edge counts."""
    edges = edge_table(scene)
    edge_counts = np.diff(edges.starts)
    buildings = np.arange(scene.num_buildings)
    first_vertex = scene.vertex_starts[:-1, None]
    of_triangle = np.repeat(buildings, np.diff(scene.triangle_starts))
    of_edge = np.repeat(buildings, edge_counts)
    corners = _columns(scene.triangles - first_vertex[of_triangle])
    ends = _columns(edges.corners - first_vertex[of_edge])
    sides = _columns(edges.sides - scene.triangle_starts[:-1, None][of_edge])
    arrays: dict[str, NDArray[np.generic]] = {
        **_coordinates(scene),
        **dict(zip(("corner_a", "corner_b", "corner_c"), corners, strict=True)),
        **dict(zip(("tail", "head"), ends, strict=True)),
        **dict(zip(("side_a", "side_b"), sides, strict=True)),
        "second_weight": edges.second_weight,
    }
    return arrays, edge_counts


def _columns(table: NDArray[np.int64]) -> list[Indices]:
    """Returns the columns of an (N, K) table of indices as K contiguous uint32 arrays."""
    return [np.ascontiguousarray(column, dtype=np.uint32) for column in table.T]


_LOGGER = logging.getLogger(__name__)

# Fewer triangles are laid out in a second or two: not worth their place on disk.
_STORED_FROM_TRIANGLES = 500_000
_DIGESTS = "digests.json"


def open_arrays(scene: Scene) -> SceneArrays:
    """Returns a scene laid out for the kernel, mapped from the cache where that is worth it.

    Only scenes that are themselves mapped from disk are kept: their digest is known without reading
    them. A cache that cannot be written costs nothing but the time.
    """
    if not scene.stored_digest or len(scene.triangles) < _STORED_FROM_TRIANGLES:
        return scene_arrays(scene)
    folder = arrays_folder(scene)
    if folder.is_dir():
        try:
            arrays = _read(folder)
            mark_used(folder)
            return arrays
        except (OSError, ValueError, KeyError, TypeError) as error:
            _LOGGER.warning("The engine's arrays in %s are damaged: %s. They are made anew.", folder, error)
    arrays = scene_arrays(scene)
    try:
        make_folder(folder.parent)
        with new_folder(folder, survives_power_cut=False) as partial:
            digests = write_arrays(partial, arrays._asdict())
            write_text(partial / _DIGESTS, json.dumps(digests), survives_power_cut=False)
        prune_cache(folder.parent, cache_limit_bytes(), keep=folder)
        return _read(folder)
    except OSError as error:
        _LOGGER.info("The engine's cache %s cannot be written: %s", folder.parent, error)
        return arrays


def arrays_folder(scene: Scene) -> Path:
    """Returns where the arrays of a scene that is mapped from disk are kept."""
    return cache_root() / "engine" / digest_of([scene.stored_digest, _code_digest()], length=24)


def _read(folder: Path) -> SceneArrays:
    digests = parse_json((folder / _DIGESTS).read_text(encoding="utf-8"))
    mapped = (map_array(folder / f"{name}.npy", digests[name]) for name in SceneArrays._fields)
    # As plain arrays: compiled code is chosen by type, and a memmap is another.
    return SceneArrays(*(np.asarray(array) for array in mapped))


@cache
def _code_digest() -> str:
    """Returns a digest of the code that lays scenes out: no version number has to be remembered."""
    files = (arguments.__file__, edges.__file__, projection.__file__, __file__)
    return digest_of([file_digest(Path(str(file))) for file in files])


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
        view, words, (rotation, center) = _view(camera), _blank(camera), projection.pose_arrays(pose)
        memory, _ = self._working_memory(camera)
        draw_views(self._arrays, rotation[None], center[None], view, memory, words[None])
        return words

    def instances(self, camera: Camera, pose: Pose) -> Instances:
        """Returns the silhouette of each building that covers a pixel, none hidden by another.

        Their union is ``render``'s silhouette, to the bit.

        Raises:
            RenderingError: As for ``render``.
        """
        view, (rotation, center) = _view(camera), projection.pose_arrays(pose)
        poses = rotation[None], center[None]
        visible = np.sort(projection.select_buildings(self._arrays, *poses, view.planes))
        scratch, words = self._working_memory(camera)
        return Instances(
            (camera.width, camera.height),
            *draw_instances(self._arrays, visible, *poses, view, scratch, words[:1]),
        )

    def silhouettes(self, camera: Camera, rotations: Floats, centers: Floats) -> Words:
        """Returns N silhouettes as (N, H, ceil(W / 64)) bit-packed words; arguments as for ``counts``."""
        view = _view(camera)
        rotations, centers = projection.require_poses(rotations, centers)
        silhouettes = np.zeros((len(centers), *_blank(camera).shape), dtype=np.uint64)

        def work(part: NDArray[np.int64]) -> None:
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
        projection.require_size(camera, (mask.shape[1], mask.shape[0]))
        view, query = _view(camera), pack_mask(mask)
        rotations, centers = projection.require_poses(rotations, centers)
        counts = np.zeros((2, len(centers)), dtype=np.int64)

        def work(part: NDArray[np.int64]) -> None:
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
        projection.require_size(camera, fit.size)
        view = _view(camera)
        rotations, centers = projection.require_poses(rotations, centers)
        values = np.zeros(len(centers))

        def work(part: NDArray[np.int64]) -> None:
            values[part] = fit_values(fit, self._draw(camera, view, rotations[part], centers[part]))

        self._share_out(work, rotations, centers)
        return values

    def _draw(self, camera: Camera, view: View, rotations: Floats, centers: Floats) -> Words:
        """Returns the silhouettes of some poses, drawn on this thread."""
        memory, words = self._working_memory(camera)
        views = np.zeros((len(centers), *words.shape[1:]), dtype=np.uint64)
        draw_views(self._arrays, rotations, centers, view, memory, views)
        return views

    def _share_out(
        self, work: Callable[[NDArray[np.int64]], None], rotations: Floats, centers: Floats
    ) -> None:
        """Does the work on hypotheses, given by index, in parts on this renderer's threads."""
        count = len(centers)
        # Few are drawn at once, before another thread would have begun.
        order = projection.nearby_order(rotations, centers) if count > LANES else np.arange(count)
        parts = list(_runs(order, self.threads))
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
    projection.require_pinhole(camera)
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], dtype=np.float64)
    return View(camera.width, camera.height, intrinsics, projection.view_planes(camera, 0, camera.width))


def _blank(camera: Camera) -> Words:
    return np.zeros((camera.height, words_per_row(camera.width)), dtype=np.uint64)


def _runs(order: NDArray[np.int64], threads: int) -> Iterator[NDArray[np.int64]]:
    """Returns groups of eight, several at a time while there are many for each thread."""
    fair_share = -(-len(order) // (4 * threads))
    size = min(max(-(-fair_share // LANES), 1), _MOST_GROUPS) * LANES
    for start in range(0, len(order), size):
        yield order[start : start + size]
