"""COLMAP's reconstruction of a flight's drawn photos."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from lodbench.errors import DatasetError
from lodbench.extras import require
from lodbench.geometry import Camera
from lodbench.storage import make_folder
from lodbench.synthesis.queries import SyntheticQuery


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
