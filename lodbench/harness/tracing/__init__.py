"""Maps traced in posed photos: roof outlines in two or more, snapped to the edges of all, as LoD1 prisms."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.own import find_photo
from lodbench.datasets.pose_text import FoundPose, LayoutGuard, read_json
from lodbench.errors import DatasetError
from lodbench.geometry import Camera, Pose
from lodbench.geometry.lens import distort
from lodbench.geometry.similarity import Similarity
from lodbench.photos.pose import HeightOptions
from lodbench.segmentation.masks import read_photo
from lodbench.storage import write_text

Floats = NDArray[np.float64]

# Kind -> the fewest points of one.
KINDS = {"roof": 3, "ground": 1, "length": 2}
_LAYOUT = (
    '{"traced": [{"kind": "roof", "name": "A1", "photos": {"a.jpg": [[u, v], ...], "b.jpg": [[u, v], ...]}}]}'
)


@dataclass(frozen=True, slots=True, eq=False)
class Traced:
    """One thing traced in two or more photos, its points in the same order in each.

    Attributes:
        kind: ``roof``: the corners of a level roof; ``ground``: places on level ground; ``length``: the two
            ends of a known length.
        name: Of the building, or of whatever it is.
        pixels: By photo, (N, 2) column and row in the photo as stored, the first pixel's centre at 0.5.
        metres: Of a ``length``.
    """

    kind: str
    name: str
    pixels: Mapping[str, Floats]
    metres: float | None = None


def read_tracing(path: Path, photos: Collection[str]) -> tuple[Traced, ...]:
    """Returns what a file holds, as the page saves it.

    Args:
        path: JSON.
        photos: Names of the model's images.

    Raises:
        DatasetError: It cannot be read, names a photo that the model lacks, or something in it is malformed.
    """
    return parse_tracing(read_json(path), str(path), photos)


def is_tracing(path: Path) -> bool:
    """Tells whether a file is a tracing, not a city model that is JSON too."""
    return path.suffix == ".json" and "traced" in read_json(path)


def parse_tracing(values: Mapping[str, Any], where: str, photos: Collection[str]) -> tuple[Traced, ...]:
    """Returns what JSON values hold, see ``read_tracing``.

    Raises:
        DatasetError: Something is malformed; the message names the item.
    """
    with LayoutGuard(where, _LAYOUT):
        listed = values["traced"]
        if not isinstance(listed, list):
            raise ValueError("traced is not a list")
    found = []
    for number, item in enumerate(listed, start=1):
        with LayoutGuard(f"{where}, item {number}", _LAYOUT):
            found.append(_parsed(item, photos))
    names = [item.name for item in found if item.kind == "roof"]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise DatasetError(f"{where}: two roofs are called {twice}.", "Give each building a name of its own.")
    return tuple(found)


def _parsed(item: Any, photos: Collection[str]) -> Traced:
    if not isinstance(item, dict) or not isinstance(item["photos"], dict):
        raise ValueError("it is no object with photos")
    kind, name = str(item["kind"]), str(item["name"]).strip()
    if kind not in KINDS:
        raise ValueError(f"the kind {kind!r} is none of {', '.join(KINDS)}")
    if not name:
        raise ValueError("it has no name")
    unknown = [photo for photo in item["photos"] if photo not in photos]
    if unknown:
        raise ValueError(f"{name}: the model has no image {unknown[0]!r}")
    pixels = {photo: np.array(points, np.float64) for photo, points in item["photos"].items()}
    shapes = {points.shape for points in pixels.values()}
    if len(pixels) < 2 or len(shapes) != 1 or (shape := shapes.pop())[1:] != (2,):
        counts = " and ".join(str(len(points)) for points in pixels.values())
        raise ValueError(f"{name}: the same corners in two photos are needed, not {counts or 'none'}")
    if shape[0] < KINDS[kind] or (kind == "length" and shape[0] != 2):
        raise ValueError(f"{name}: {shape[0]} points are no {kind}")
    metres = float(item["metres"]) if kind == "length" else None
    if metres is not None and not metres > 0:
        raise ValueError(f"{name}: a length is above 0 m, not {metres:g}")
    return Traced(kind, name, pixels, metres)


def write_tracing(traced: Sequence[Traced], path: Path) -> None:
    """Writes what was traced, to the hundredth of a pixel."""
    listed = [
        {
            "kind": item.kind,
            "name": item.name,
            **({} if item.metres is None else {"metres": item.metres}),
            "photos": {photo: np.round(points, 2).tolist() for photo, points in item.pixels.items()},
        }
        for item in traced
    ]
    lines = ",\n  ".join(json.dumps(item, ensure_ascii=False) for item in listed)
    write_text(path, f'{{"traced": [\n  {lines}\n]}}\n')


@dataclass(frozen=True, slots=True, kw_only=True)
class TraceRequest:
    """A reconstruction, and how its frame becomes the map's.

    Attributes:
        model: Folder of a COLMAP model.
        images: Folder that its names are relative to.
        start: Rough poses in the map's coordinates, or a similarity of ``lodbench georeference``; or None.
        crs: The map's reference system; with no ``start``, the photos' own positions place the model in it.
        scale: Metres per unit of the model, or None.
        is_metric: Whether the model is in the map's coordinates already.
        heights: How the drone's heights become the map's.
        queries: Patterns of names of photos that the map must not use, as they are the benchmark's queries;
            empty for every second one that nothing is traced in; None where there is no benchmark.
    """

    model: Path
    images: Path
    start: Path | None = None
    crs: str | None = None
    scale: float | None = None
    is_metric: bool = False
    heights: HeightOptions = field(default_factory=HeightOptions)
    queries: tuple[str, ...] | None = None


# Shorter line segments are texture, pixels.
_SHORTEST_PX = 12.0
# The fixed point of a lens's inverse: photos of drones need five rounds.
_LENS_ROUNDS = 30


@dataclass(slots=True, eq=False)
class View:
    """A posed photo.

    Attributes:
        name: As the model calls it.
        camera: Of the photo as stored, lens distortion included.
        pose: World to camera.
        photo: Its file.
        kept: Its line segments, once they were looked for: copies of the view share them.
    """

    name: str
    camera: Camera
    pose: Pose
    photo: Path
    kept: list[Floats] = field(default_factory=list, repr=False)

    def project(self, points: Floats) -> Floats:
        """Returns (N, 2) pixels of (N, 3) points of the world; NaN behind the camera."""
        return self.camera.project(points @ self.pose.rotation.T + self.pose.translation)

    def rays(self, pixels: Floats) -> Floats:
        """Returns (N, 3) unit directions, world axes, of (N, 2) pixels."""
        camera = self.camera
        seen = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        plain = seen
        if camera.distortion:
            for _ in range(_LENS_ROUNDS):
                bent = np.stack(distort(camera.lens, camera.distortion, plain[:, 0], plain[:, 1]), axis=1)
                plain = plain + seen - bent
        rays = np.column_stack([plain, np.ones(len(plain))]) @ self.pose.rotation
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    def shows(self, pixels: Floats) -> NDArray[np.bool_]:
        """Tells which of (N, 2) pixels are in the photo."""
        inside = (pixels >= 0) & (pixels <= [self.camera.width, self.camera.height])
        return np.asarray(inside.all(axis=1))

    def segments(self) -> Floats:
        """Returns (S, 4) line segments of the photo, ends in pixels (von Gioi et al., LSD, 2010); kept."""
        import cv2

        if not self.kept:
            grey = cv2.cvtColor(read_photo(self.photo), cv2.COLOR_RGB2GRAY)
            found = cv2.createLineSegmentDetector().detect(grey)[0]
            # OpenCV counts from pixel centres.
            ends = np.zeros((0, 4)) if found is None else np.reshape(found, (-1, 4)).astype(np.float64) + 0.5
            self.kept.append(ends[np.hypot(*(ends[:, 2:] - ends[:, :2]).T) >= _SHORTEST_PX])
        return self.kept[0]


def posed_views(images: Sequence[FoundPose], photos: Path, similarity: Similarity) -> dict[str, View]:
    """Returns the model's photos in the frame that a similarity leads to, by name.

    Those without a file, or a camera that is known here, are left out.

    Raises:
        DatasetError: No image has both.
    """
    views = {}
    for image in images:
        file = find_photo(photos, image.name)
        if image.camera is not None and file is not None:
            views[image.name] = View(image.name, image.camera, similarity.pose(image.pose), file)
    if all(image.camera is None for image in images):
        raise DatasetError(f"No image of the model can be used; {images[0].name}: {images[0].no_camera}")
    if not views:
        raise DatasetError(
            f"{photos} holds no photo of the model; the first is looked for as {images[0].name}.",
            "`--images` is the folder of the model's photos.",
        )
    return views


def triangulated(pixels: Mapping[str, Floats], views: Mapping[str, View]) -> Floats:
    """Returns (N, 3) the places nearest to the rays of all photos.

    Raises:
        DatasetError: A photo is not there, or the rays of a point are parallel.
    """
    count = len(next(iter(pixels.values())))
    normal, side = np.zeros((count, 3, 3)), np.zeros((count, 3))
    for name, points in pixels.items():
        if name not in views:
            raise DatasetError(
                f"There is no photo {name}.", "`--images` is the folder of the model's photos."
            )
        rays, center = views[name].rays(points), views[name].pose.center
        across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
        normal, side = normal + across, side + across @ center
    if np.linalg.eigvalsh(normal)[:, 0].min() < 1e-6:
        raise DatasetError(
            f"The rays from {' and '.join(pixels)} are parallel.", "Trace in photos taken further apart."
        )
    return np.asarray(np.linalg.solve(normal, side[..., None])[..., 0])
