"""Drawn photos of seeded views and flights, in a named look, and COLMAP's reconstruction of a flight's."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from lodbench.citymodel.scene import Scene
from lodbench.errors import DatasetError
from lodbench.extras import require
from lodbench.geometry import Camera
from lodbench.storage import make_folder, random_stream
from lodbench.synthesis.lens_pictures import draw_through_lens
from lodbench.synthesis.photo import CameraResponse, Look, PhotoRenderer, draw_look, look_ranges
from lodbench.synthesis.photo.renderer import photo_file
from lodbench.synthesis.queries import SyntheticQuery
from lodbench.synthesis.surroundings.surroundings import make_surroundings

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
