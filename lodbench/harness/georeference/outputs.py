"""What a placed reconstruction is written as: COLMAP, references for Metashape, Pix4D and ODM, a map."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from lodbench.citymodel.scene import Scene
from lodbench.datasets.exchange.colmap_moved import write_moved_colmap
from lodbench.datasets.exchange.geojson import camera_feature, footprint_feature, view_feature, write_geojson
from lodbench.datasets.exchange.photogrammetry import write_metashape, write_odm, write_pix4d
from lodbench.datasets.exchange.posed import read_json
from lodbench.datasets.map_frame import MapFrame
from lodbench.datasets.undistort import pinhole_of
from lodbench.errors import DatasetError, LodbenchError
from lodbench.harness.flights.map_findings import contradiction_features
from lodbench.harness.georeference.request import Georeferenced, GeoreferenceRequest
from lodbench.harness.photo.outputs import ground_below_m
from lodbench.storage import make_folder, write_text

SIMILARITY_FILE = "similarity.json"
_NAMES = {
    "colmap": "colmap",
    "metashape": "metashape_reference.txt",
    "pix4d": "calibrated_external_camera_parameters.txt",
    "odm": "geo.txt",
    "map": "cameras.geojson",
    "map findings": "map_findings.geojson",
}


def require_no_other(out: Path, model: Path) -> None:
    """Refuses a folder that holds the result of another model, or files of somebody else's under its names.

    Args:
        out: The folder, which need not be there.
        model: What is to be placed.

    Raises:
        DatasetError: It does.
    """
    there = [out / name for name in (SIMILARITY_FILE, *_NAMES.values()) if (out / name).exists()]
    if there and _model_of(out / SIMILARITY_FILE) != str(model.resolve()):
        raise DatasetError(
            f"{there[0]} is no result of placing {model} and would be written over.",
            "Name another folder: --out OTHER",
        )


def _model_of(file: Path) -> object:
    try:
        return read_json(file).get("model")
    except DatasetError:
        return None


def write_georeferenced(
    placed: Georeferenced, request: GeoreferenceRequest, scene: Scene, frame: MapFrame | None
) -> Georeferenced:
    """Writes a placed reconstruction; returns it with what was written, and what was not and why.

    Args:
        placed: What to write.
        request: Names the model and the folder.
        scene: The map.
        frame: Its coordinates on Earth, where they are known.
    """
    out, cameras, crs = request.out, list(placed.cameras), placed.crs
    make_folder(out)
    model, similarity_file = {"model": str(request.model.resolve())}, out / SIMILARITY_FILE
    if not similarity_file.exists():
        # Whose the others are, from the first on: a command that is killed can be given again.
        write_text(similarity_file, json.dumps(model) + "\n")
    writers: dict[str, Callable[[Path], None]] = {
        "colmap": lambda path: write_moved_colmap(request.model, placed.fitted.similarity, path),
        "metashape": lambda path: write_metashape(cameras, path, crs),
        "pix4d": lambda path: write_pix4d(cameras, path),
        "odm": lambda path: write_odm(cameras, path, crs),
    }
    if frame is not None:
        writers["map"] = lambda path: write_geojson(_features(placed, scene, frame), path)
        doubts = contradiction_features(scene, frame, placed.findings, "reconstruction")
        writers["map findings"] = lambda path: write_geojson(doubts, path)
    files, notes = {}, list(placed.notes)
    for name, write in writers.items():
        file = out / _NAMES[name]
        try:
            write(file)
            files[name] = file
        except LodbenchError as fault:
            notes.append(f"{name} was not written: {fault.message}")
    files["similarity"] = similarity_file
    written = replace(placed, files=files, notes=tuple(notes))
    text = json.dumps({**model, **written.to_json()}, indent=1, ensure_ascii=False)
    write_text(similarity_file, text + "\n")
    return written


def _features(placed: Georeferenced, scene: Scene, frame: MapFrame) -> list[dict[str, object]]:
    """Returns each camera, what it looks at and what it shows, as features of GeoJSON."""
    features = []
    for camera in placed.cameras:
        stated: dict[str, object] = {"name": camera.name, "kind": "estimate"}
        if camera.name in placed.used:
            stated["away_m"] = round(placed.used[camera.name], 3)
        features.append(camera_feature(frame, camera.pose, stated))
        features.append(view_feature(frame, camera.pose, {"name": camera.name}))
        if camera.camera is not None:
            ground = ground_below_m(scene, camera.pose)
            pinhole = pinhole_of(camera.camera)
            shown = footprint_feature(frame, pinhole, camera.pose, ground, {"name": camera.name})
            features += [] if shown is None else [shown]
    return features
