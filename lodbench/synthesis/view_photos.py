"""Drawn photos of seeded views and flights, in a named look, and COLMAP's reconstruction of a flight's."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.errors import DatasetError
from lodbench.extras import require
from lodbench.geometry import Camera
from lodbench.geometry.lens import distort
from lodbench.storage import make_folder, random_stream
from lodbench.synthesis.photo import CameraResponse, Look, PhotoRenderer, draw_look, look_ranges
from lodbench.synthesis.photo.renderer import photo_file
from lodbench.synthesis.surroundings import make_surroundings
from lodbench.synthesis.view_sampling import SyntheticQuery

# What photos are drawn at, pixels.
PHOTO_SIZE = (1204, 902)


class Photographer:
    """Draws photos of one city in a look of ``conf/training``; a photo depends on seed and names only.

    Raises:
        ConfigError: There is no such look.
    """

    def __init__(self, scene: Scene, look: str, seed: int) -> None:
        self._ranges, self._seed = look_ranges(look), seed
        props, land = make_surroundings(scene, seed)
        self._renderer = PhotoRenderer(scene, props, land.cover)

    def views(self, queries: Sequence[SyntheticQuery], cameras: Sequence[Camera]) -> list[SyntheticQuery]:
        """Returns queries (scene frame) with photos, each in its own light; names become those of JPEGs.

        Args:
            queries: What is photographed.
            cameras: What takes each.
        """
        return [
            self._taken(query, camera, *self._look("views", "look", query.name))
            for query, camera in zip(queries, cameras, strict=True)
        ]

    def flight(self, queries: Sequence[SyntheticQuery], camera: Camera, number: int) -> list[SyntheticQuery]:
        """Returns a flight's queries with photos: one sun, exposures apart; else as ``views``."""
        light, _ = self._look("flight", number, "look")
        return [self._taken(query, camera, light, self._look("look", query.name)[1]) for query in queries]

    def _look(self, *stream: str | int) -> tuple[Look, CameraResponse]:
        return draw_look(self._ranges, random_stream(self._seed, *stream))

    def _taken(
        self, query: SyntheticQuery, camera: Camera, look: Look, response: CameraResponse
    ) -> SyntheticQuery:
        photo = draw_through_lens(
            lambda pinhole: self._renderer.photo(pinhole, query.truth, look, response), camera
        )
        return query._replace(name=f"{query.name}.jpg", photo=photo_file(photo, ".jpg", response))


def reconstruct(queries: Sequence[SyntheticQuery], camera: Camera, folder: Path) -> None:
    """Writes COLMAP's reconstruction of a flight's photos, its own frame and focal length.

    Photos that COLMAP does not register are not in it.

    Raises:
        ConfigError: pycolmap is not installed.
        DatasetError: COLMAP finds no model.
    """
    pycolmap = require("pycolmap", "pnp", "dataset.reconstruct=true")
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    with tempfile.TemporaryDirectory() as made:
        photos, database = make_folder(Path(made) / "photos"), Path(made) / "database.db"
        for query in queries:
            (photos / query.name).write_bytes(query.photo or b"")
        reader = pycolmap.ImageReaderOptions(
            camera_model="PINHOLE",
            camera_params=",".join(map(str, (camera.fx, camera.fy, camera.cx, camera.cy))),
        )
        pycolmap.set_random_seed(0)
        pycolmap.extract_features(
            database, photos, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader
        )
        pycolmap.match_exhaustive(database)
        models = pycolmap.incremental_mapping(database, photos, made)
        if not models:
            raise DatasetError(f"COLMAP finds no model of {queries[0].name} and the photos with it.")
        largest = max(models.values(), key=lambda model: model.num_reg_images())
        make_folder(folder)
        largest.write_text(folder)


# Each iteration leaves |k1| r^2 of the error, below 0.2 for lenses of drones.
_ITERATIONS = 30


def draw_through_lens(draw: Callable[[Camera], NDArray[Any]], lens: Camera) -> NDArray[Any]:
    """Returns (H, W, ...) what a lens shows of what ``draw`` returns for a pinhole.

    Drawn with as short a focal length as the lens's corners need. Labels and masks keep their values (nearest
    pixel), photos are interpolated linearly.

    Args:
        draw: Returns the picture of a pinhole, of its size; booleans, integers, or (H, W, 3) of a photo.
        lens: With or without distortion; without, its picture is returned as drawn.
    """
    if not lens.distortion:
        return draw(lens)
    columns, rows = np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5
    seen_x, seen_y = np.meshgrid((columns - lens.cx) / lens.fx, (rows - lens.cy) / lens.fy)
    ray_x, ray_y = _undistort(lens, seen_x, seen_y)
    axes = ((ray_x, seen_x), (ray_y, seen_y))
    reach = max(1.0, *(float(np.abs(ray).max() / np.abs(seen).max()) for ray, seen in axes))
    pinhole = replace(lens.without_distortion(), fx=lens.fx / reach, fy=lens.fy / reach)
    picture = draw(pinhole)
    x, y = pinhole.fx * ray_x + pinhole.cx, pinhole.fy * ray_y + pinhole.cy
    if picture.ndim == 2:
        row, column = np.clip(y.astype(int), 0, lens.height - 1), np.clip(x.astype(int), 0, lens.width - 1)
        return np.asarray(picture[row, column])
    import cv2

    # OpenCV counts from pixel centres, COLMAP from corners.
    at = (x - 0.5).astype(np.float32), (y - 0.5).astype(np.float32)
    return np.asarray(cv2.remap(picture, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def _undistort(lens: Camera, seen_x: NDArray[Any], seen_y: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Returns the pinhole's normalised coordinates of the lens's, by fixed-point iteration."""
    x, y = seen_x, seen_y
    for _ in range(_ITERATIONS):
        distorted_x, distorted_y = distort(lens.lens, lens.distortion, x, y)
        x, y = x + seen_x - distorted_x, y + seen_y - distorted_y
    return x, y
