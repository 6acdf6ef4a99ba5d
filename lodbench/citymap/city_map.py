"""The map of one city as methods see it."""

from __future__ import annotations

import threading
from collections import Counter
from copy import copy
from dataclasses import replace
from functools import cache, cached_property
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.model import take_segments
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.textured_map import TexturedMesh
from lodbench.errors import RenderingError
from lodbench.geometry import Camera, Pose
from lodbench.kernels import visible_buildings
from lodbench.kernels.arguments import EdgeFaces
from lodbench.rendering import (
    DepthRenderer,
    Fit,
    Instances,
    IouCounts,
    Scorer,
    SemanticIouFit,
    ViewEdges,
    make_renderer,
)
from lodbench.rendering.edges import edge_faces, edge_pairs, edges_in_view
from lodbench.rendering.masks import Words
from lodbench.rendering.projection import bounding_spheres, require_poses, require_size, view_planes
from lodbench.rendering.raster import RasterRenderer
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.rendering.surfaces import Surfaces
from lodbench.storage import random_stream

if TYPE_CHECKING:
    from lodbench.rendering.backends import PyrenderTextured
    from lodbench.rendering.raster import TexturedRenderer
    from lodbench.synthesis.photo import PhotoRenderer


class MapUsage:
    """How much a method requests of the map: counts the poses that it drew, by kind; any thread may add.

    Kinds are the names of ``CityMap``'s methods. The harness takes the counts after each query.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._poses: Counter[str] = Counter()

    def add(self, kind: str, poses: int) -> None:
        """Counts so many poses drawn."""
        with self._lock:
            self._poses[kind] += poses

    def counts(self) -> dict[str, int]:
        """Returns the poses drawn since the last ``take``, by kind, in alphabetical order."""
        with self._lock:
            return dict(sorted(self._poses.items()))

    def take(self) -> dict[str, int]:
        """Returns ``counts``, and begins anew."""
        with self._lock:
            taken = dict(sorted(self._poses.items()))
            self._poses.clear()
        return taken

    @property
    def total(self) -> int:
        """Returns the poses drawn of all kinds."""
        with self._lock:
            return sum(self._poses.values())


Floats = NDArray[np.float64]
# Class maps that are drawn before they are compared.
_AT_ONCE = 32


class CityMap:
    """Draws a city from many poses at a time: silhouettes, depth, normals, colour, edges.

    Poses are (N, 3, 3) rotations cam_from_world and (N, 3) camera centres in the scene's local metric
    frame; all views of a call share one pinhole camera, of any size. What comes out does not depend on
    threads or on how poses are batched. Every pose drawn is counted in ``usage``. Any number of threads
    may ask at once.

    Args:
        scene: The city.
        renderer: Who draws silhouettes, and depth if it can; pyrender also a textured map;
            all else is drawn by the engine that does so fastest.
        threads: Worker threads; None for one per core.
        textured: A textured map of the place, in the scene's frame, for ``colour``; see
            ``lodbench.citymodel.textured_map.open_textured_map``.

    Attributes:
        scene: The city.
        name: The renderer's.
        usage: Poses drawn.
        scorer: Draws and compares silhouettes; what it is asked directly is not counted.

    Raises:
        ConfigError: The renderer is unknown.
        RenderingError: A library the renderer needs is absent. Every method raises it too, where the
            camera has lens distortion or is wider than 8192 pixels, or a pose is not finite.
    """

    def __init__(
        self,
        scene: Scene,
        renderer: str = "silhouette",
        threads: int | None = None,
        textured: TexturedMesh | None = None,
    ) -> None:
        self.scene = scene
        self._textured_mesh = textured
        self.usage = MapUsage()
        self._threads = threads
        # Maps that differ in where vertices are only share this.
        self._edge_pairs = cache(lambda: edge_pairs(scene))
        self.scorer: Scorer = make_renderer(renderer, scene, threads)
        self.name = self.scorer.name
        self.threads = int(getattr(self.scorer, "threads", 1))

    def with_scorer(self, scorer: Scorer) -> CityMap:
        """Returns this map with silhouettes by another renderer of the city; usage is counted together."""
        other = copy(self)
        # What only the engine draws stays with the engine there is.
        other.__dict__["_engine"] = self._engine
        other.scorer = scorer
        return other

    def with_vertices(self, vertices: NDArray[np.float32]) -> CityMap:
        """Returns the map with its vertices at (V, 3), scene metres, and no textures; usage is shared.

        The engine draws it, whoever draws this one: that costs a fraction of a new map.
        """
        engine = self._engine.with_vertices(vertices)
        other = copy(self)
        for name, member in vars(CityMap).items():
            if isinstance(member, cached_property):
                other.__dict__.pop(name, None)
        other.scene, other._textured_mesh, other.scorer = engine.scene, None, engine
        other.name, other.threads = engine.name, engine.threads
        return other

    @property
    def is_textured(self) -> bool:
        """Returns whether ``colour`` shows photographed surfaces."""
        return self._textured_mesh is not None

    def render(self, camera: Camera, pose: Pose) -> NDArray[np.bool_]:
        """Returns the (H, W) silhouette seen from one pose."""
        self.usage.add("silhouettes", 1)
        return self.scorer.render(camera, pose)

    def silhouettes(self, camera: Camera, rotations: Floats, centers: Floats) -> Words:
        """Returns N silhouettes, bit-packed: (N, H, ceil(W / 64)) uint64.

        ``lodbench.rendering.masks.unpack_mask`` turns one into an (H, W) mask.
        """
        self.usage.add("silhouettes", len(centers))
        return self.scorer.silhouettes(camera, rotations, centers)

    def counts(
        self, camera: Camera, rotations: Floats, centers: Floats, mask: NDArray[np.bool_]
    ) -> IouCounts:
        """Returns how many pixels N silhouettes share with an (H, W) mask, and those of either."""
        self.usage.add("counts", len(centers))
        return self.scorer.counts(camera, rotations, centers, mask)

    def fit(self, camera: Camera, rotations: Floats, centers: Floats, fit: Fit) -> Floats:
        """Returns the similarity of N silhouettes, or class maps, to a query, (N,) in [0, 1]; see ``Fit``."""
        self.usage.add("fit", len(centers))
        if isinstance(fit, SemanticIouFit):
            require_size(camera, fit.size)
            parts = [slice(k, k + _AT_ONCE) for k in range(0, len(centers), _AT_ONCE)]
            drawn = (self._raster.classes(camera, rotations[part], centers[part]) for part in parts)
            return np.concatenate([np.zeros(0), *map(fit, drawn)])
        return self.scorer.fit(camera, rotations, centers, fit)

    def instances(self, camera: Camera, rotations: Floats, centers: Floats) -> tuple[Instances, ...]:
        """Returns the silhouettes of single buildings, none hidden by another, view by view."""
        self.usage.add("instances", len(centers))
        return tuple(self._engine.instances(camera, pose) for pose in _poses(rotations, centers))

    def depth(self, camera: Camera, rotations: Floats, centers: Floats) -> NDArray[np.float32]:
        """Returns (N, H, W) depths along the optical axis, metres; 0 where there is no building."""
        self.usage.add("depth", len(centers))
        if not hasattr(self.scorer, "depth") or hasattr(self.scorer, "depths"):
            return self._raster.depths(camera, rotations, centers)
        renderer = cast("DepthRenderer", self.scorer)
        depths = [renderer.depth(camera, pose) for pose in _poses(rotations, centers)]
        return np.array(depths, dtype=np.float32).reshape(-1, camera.height, camera.width)

    def surface_depth(self, camera: Camera, rotations: Floats, centers: Floats) -> NDArray[np.float32]:
        """Returns (N, H, W) depths of what ``colour`` shows: of a textured map its ground and trees too.

        Metres along the optical axis; 0 where there is nothing. Without a textured map it is ``depth``.
        """
        if self._textured_mesh is None:
            return self.depth(camera, rotations, centers)
        self.usage.add("surface_depth", len(centers))
        return self._textured_raster.depths(camera, rotations, centers)

    def normals(self, camera: Camera, rotations: Floats, centers: Floats) -> NDArray[np.float32]:
        """Returns (N, H, W, 3) unit normals, world axes, on the camera's side; 0 where there is nothing."""
        self.usage.add("normals", len(centers))
        return self._raster.normals(camera, rotations, centers)

    def buildings(self, camera: Camera, rotations: Floats, centers: Floats) -> NDArray[np.int32]:
        """Returns (N, H, W) indices into ``scene.building_ids`` of what is seen, -1 for none."""
        self.usage.add("buildings", len(centers))
        return self._raster.buildings(camera, rotations, centers)

    def classes(self, camera: Camera, rotations: Floats, centers: Floats) -> NDArray[np.uint8]:
        """Returns (N, H, W) classes of the nearest surface: 1 roofs, 2 walls, by slope, 0 for neither."""
        self.usage.add("classes", len(centers))
        return self._raster.classes(camera, rotations, centers)

    def colour(self, camera: Camera, rotations: Floats, centers: Floats) -> NDArray[np.uint8]:
        """Returns (N, H, W, 3) RGB pictures of the textured map, or where there is none, of made-up surfaces.

        Those are walls with windows, and roofs, in a clear noon's sun.
        """
        self.usage.add("colour", len(centers))
        if self._textured is not None:
            return self._textured.colours(camera, rotations, centers)
        from lodbench.synthesis.photo import draw_look, look_ranges

        look, response = draw_look(look_ranges("plain"), random_stream(0, "city map", "colour"))
        photos = [self._photos.photo(camera, pose, look, response) for pose in _poses(rotations, centers)]
        return np.array(photos, dtype=np.uint8).reshape(-1, camera.height, camera.width, 3)

    def edges(
        self, camera: Camera, rotations: Floats, centers: Floats, crease_deg: float = 15.0
    ) -> tuple[ViewEdges, ...]:
        """Returns the model's edges in N views, split where they are hidden; see ``ViewEdges``.

        Args:
            camera: Pinhole.
            rotations: (N, 3, 3) cam_from_world.
            centers: (N, 3) camera centres, scene metres.
            crease_deg: Least angle between two faces' planes to be a crease. Contours need none.
        """
        self.usage.add("edges", len(centers))
        rotations, centers = require_poses(rotations, centers)
        planes = view_planes(camera, 0, camera.width)

        def view(i: int) -> ViewEdges:
            pose = rotations[i], centers[i]
            depth = self._raster.depths(camera, rotations[i : i + 1], centers[i : i + 1])[0]
            visible = visible_buildings(self._spheres, *pose, planes)
            return edges_in_view(self.edge_faces, visible, camera, pose, depth, crease_deg)

        return tuple(view(i) for i in range(len(centers)))

    @cached_property
    def _spheres(self) -> Floats:
        return bounding_spheres(self.scene)

    @cached_property
    def edge_faces(self) -> EdgeFaces:
        """The edges of all buildings with what lies beside them."""
        return edge_faces(self.scene, self._edge_pairs())

    @cached_property
    def surfaces(self) -> Surfaces:
        """What rays meet: roofs, walls and the ground."""
        return Surfaces(self.scene)

    @cached_property
    def _engine(self) -> SilhouetteRenderer:
        if isinstance(self.scorer, SilhouetteRenderer):
            return self.scorer
        return SilhouetteRenderer(self.scene, self._threads)

    @cached_property
    def _raster(self) -> RasterRenderer:
        return RasterRenderer(self.scene, self._threads)

    @cached_property
    def _textured(self) -> TexturedRenderer | PyrenderTextured | None:
        if self._textured_mesh is None:
            return None
        if self.name != "pyrender":
            return self._textured_raster
        from lodbench.rendering.backends import PyrenderTextured

        return PyrenderTextured(self._textured_mesh)

    @cached_property
    def _textured_raster(self) -> TexturedRenderer:
        if self._textured_mesh is None:
            raise RenderingError("This map has no textures.")
        from lodbench.rendering.raster import TexturedRenderer

        return TexturedRenderer(self._textured_mesh, self._threads)

    @cached_property
    def _photos(self) -> PhotoRenderer:
        from lodbench.synthesis.photo import PhotoRenderer

        return PhotoRenderer(self.scene, threads=self._threads)


def _poses(rotations: Floats, centers: Floats) -> list[Pose]:
    """Returns N poses one by one."""
    rotations, centers = require_poses(rotations, centers)
    return [Pose.from_center(r, c) for r, c in zip(rotations, centers, strict=True)]


# No building is lowered below this height, metres.
_LOWEST_M = 2.0
_ENDS = (np.minimum, np.maximum)


def corrected_map(
    city_map: CityMap, heights_m: NDArray[np.float64], least_m: float = 0.5
) -> tuple[CityMap, NDArray[np.float64]]:
    """Returns the map with buildings made higher, and (B,) by how much each is, metres.

    A roof that is metres higher moves a silhouette beyond what its derivative predicts, and beyond the
    reach of a robust kernel: such buildings are drawn where they are thought to be, and measured from there.
    Poses drawn of it count as drawn of the map.

    Args:
        city_map: The map.
        heights_m: (B,) by how much its buildings are higher in truth, metres.
        least_m: Buildings nearer to the map than this stay as they are.
    """
    scene = city_map.scene
    counts = np.diff(scene.vertex_starts)
    chosen = np.flatnonzero((np.abs(heights_m) > least_m) & (counts > 0))
    rows, starts = take_segments(scene.vertex_starts, chosen)
    heights = scene.vertices[rows, 2].astype(np.float64)
    lowest, highest = (each.reduceat(heights, starts[:-1]) if len(chosen) else heights for each in _ENDS)
    rises = highest - lowest
    moved = np.where(rises > 0, np.maximum(heights_m[chosen], np.minimum(_LOWEST_M - rises, 0.0)), 0.0)
    changed = np.zeros(len(counts))
    changed[chosen] = moved
    if not changed.any():
        return city_map, changed
    floor, stretch = (np.repeat(v, counts[chosen]) for v in (lowest, 1.0 + moved / np.maximum(rises, 1e-6)))
    vertices = scene.vertices.copy()
    vertices[rows, 2] = floor + (heights - floor) * stretch
    if isinstance(city_map, CityMap) and city_map.name == SilhouetteRenderer.name:
        return city_map.with_vertices(vertices), changed
    # A map in another process may be drawn there by what is not to be had here.
    renderer = city_map.name if isinstance(city_map, CityMap) else SilhouetteRenderer.name
    drawn = CityMap(replace(scene, vertices=vertices, stored_digest=""), renderer, city_map.threads)
    drawn.usage = city_map.usage
    return drawn, changed
