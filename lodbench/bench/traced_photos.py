"""Real photos with hand-traced masks as posed queries: the map is made of the outlines that were traced.

Photos with poses over a map that anyone can download are rare; photos with traced buildings are not. A
photo is taken for one that looks straight down: its outlines, laid on level ground, are the map, and
where the photo hangs above them is the true pose. Pixels are real then, geometry is not: no walls, no
relief. Roofs that the photo's edge cuts go on beyond it; what else is there the map does not show.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

from lodbench.bench.photo_masks import labelled_photos
from lodbench.citymodel.scene import Scene, build_scene
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import ConfigError, DatasetError
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.photos.files import traced_mask
from lodbench.segmentation.polygon_files import polygons_of
from lodbench.storage import random_stream

Points = NDArray[np.float64]

# How high photos hang, and what the widest side of each shows: a usual drone.
HEIGHT_M, SIDE_M = 100.0, 120.0
# Nothing of one photo is seen from another.
_APART_M = 2000.0
# Share of the buildings that a wrong map lacks, and of what a photo shows of them at most: a map of one shed
# is of another place.
_MISSING, _MOST_MISSING = 0.08, 0.25
# How far roofs go on beyond the photo's edge, of its widest side.
_BEYOND = 0.1
# Smaller outlines are specks of a tracing.
_LEAST_M2 = 4.0


@dataclass(frozen=True, slots=True)
class TracedOptions:
    """How wrong the maps are.

    Attributes:
        map_error_m: Outlines are simplified by so much, buildings moved by half of it and raised by it
            (standard deviations), and one in twelve is missing, but at most a quarter of what a photo shows;
            0 for the outlines as traced.
        seed: Of these errors.
    """

    map_error_m: float = 0.5
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.map_error_m <= 10:
            raise ConfigError(f"--map-error {self.map_error_m} is not within 0 and 10 metres.")


def open_traced_photos(folder: Path, options: TracedOptions) -> tuple[Dataset, Scene]:
    """Returns the photos that show buildings as a dataset, a split per place, and their maps as one scene.

    Traced masks are their masks: by these a method shows what it makes of perfect ones.

    Raises:
        DatasetError: As ``labelled_photos``, or no photo shows a building.
        QueryFault: A photo or a mask cannot be read.
    """
    entries, truth = [], {}
    points, triangles, owners = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], []
    shown = [(photo, mask) for photo, mask in labelled_photos(folder) if mask.any()]
    for number, (photo, mask) in enumerate(shown):
        height, width = mask.shape
        focal = HEIGHT_M * max(width, height) / SIDE_M
        camera = Camera(width, height, focal, focal, width / 2, height / 2)
        place = photo.parent.parent.name
        generator = random_stream(options.seed, "traced photo", place, photo.name)
        above = np.array([number * _APART_M, 0.0, HEIGHT_M])
        for corners, faces in _plates(*_beyond(mask, camera), options.map_error_m, generator):
            triangles.append(faces + sum(map(len, points)))
            points.append(corners + above * (1.0, 1.0, 0.0))
            owners.append(len(faces))
        pose = Pose.from_euler(EulerAngles(0.0, 0.0, 0.0), above)
        entries.append(Entry(photo.name, place, camera, pose, photo, traced_mask(photo)))
        truth[entries[-1].key] = pose
    if not owners:
        raise DatasetError(f"No photo of {folder} shows a building.")
    names = tuple(f"outline {k}" for k in range(1, len(owners) + 1))
    building = np.repeat(np.arange(len(owners), dtype=np.int32), owners)
    scene = build_scene(np.concatenate(points), np.concatenate(triangles), building, names)
    places = tuple(dict.fromkeys(entry.split for entry in entries))
    return Dataset(folder.name, "", folder, None, None, places, tuple(entries), truth), scene


def _beyond(mask: NDArray[np.bool_], camera: Camera) -> tuple[NDArray[np.bool_], Camera]:
    """Returns a mask whose roofs go on beyond the photo's edges, as a map's do, and its camera.

    Ending there, they would tell how high the photo was taken.
    """
    margin = round(_BEYOND * max(mask.shape))
    return np.pad(mask, margin, mode="edge"), camera.with_margins(margin, margin)


def _plates(
    mask: NDArray[np.bool_], camera: Camera, map_error_m: float, generator: np.random.Generator
) -> Iterator[tuple[Points, NDArray[np.int64]]]:
    """Yields the corners, (N, 3) metres around the photo's middle, and triangles of each flat roof."""
    from shapely import MultiPolygon, Polygon
    from shapely.affinity import affine_transform, translate

    scale = HEIGHT_M / camera.fx
    # Pixels to metres, rows counted downwards; outlines run around pixels, not through their middles.
    to_metres = (scale, 0.0, 0.0, -scale, scale * (0.5 - camera.cx), -scale * (0.5 - camera.cy))
    may_miss = _MOST_MISSING * float(mask.sum()) * scale**2
    for part in polygons_of(mask):
        if len(part.outer) < 3:
            continue
        pixels = Polygon(part.outer, [hole for hole in part.holes if len(hole) > 2])
        roof = affine_transform(pixels.buffer(0.5, join_style="mitre"), to_metres)
        east, north, up = generator.normal(0.0, map_error_m, 3) * (0.5, 0.5, 1.0)
        is_missing = generator.random() < _MISSING and map_error_m > 0 and roof.area <= may_miss
        may_miss -= is_missing * roof.area
        if map_error_m > 0:
            roof = translate(roof.simplify(map_error_m), east, north)
        if roof.area < _LEAST_M2 or is_missing:
            continue
        for polygon in roof.geoms if isinstance(roof, MultiPolygon) else [roof]:
            rings = [np.asarray(ring.coords[:-1]) for ring in (polygon.exterior, *polygon.interiors)]
            plane = np.concatenate(rings)
            ends = np.cumsum([len(ring) for ring in rings]).astype(np.uint32)
            faces = mapbox_earcut.triangulate_float64(plane, ends).astype(np.int64).reshape(-1, 3)
            yield np.column_stack([plane, np.full(len(plane), up)]), faces
