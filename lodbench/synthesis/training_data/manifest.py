"""``manifest.json``, what a training set was made of, so that it can be made again; and its contact sheet."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench import __version__
from lodbench.citymodel.options import ReadOptions, told_options
from lodbench.citymodel.source import open_sources
from lodbench.citymodel.texture_files import files_of_textured
from lodbench.datasets.pictures import encoded, read_picture
from lodbench.errors import DatasetError
from lodbench.storage import digest_of, file_digest, make_folder, remove_leftovers, write_bytes, write_text
from lodbench.storage.digest import digest_of_code
from lodbench.storage.json_text import parse_json
from lodbench.synthesis.training_data.params import GenerateParams
from lodbench.synthesis.training_data.plan_views import SPLITS, PlannedView, ViewPlan
from lodbench.synthesis.training_data.view_writer import PictureParts, files_of

MANIFEST_FILE, SHEET_FILE = "manifest.json", "overview.png"
SCHEMA = 1
_LIBRARIES = ("numpy", "numba", "opencv-python-headless", "scipy")
_LAYERS = ("geometry", "citymodel", "datasets", "rendering", "synthesis")
# Settings that name files, whose content is named instead; and those that change no byte.
_PATHS = ("city", "texture_model", "props", "terrain", "poses")
_IDLE = ("out", "sheet", "workers")
# Views on the contact sheet, strips in each of its rows, and the colour of masks.
_VIEWS, _PER_ROW = 8, 2
_MASK_BGR = np.array([60.0, 170.0, 255.0])

Picture = NDArray[np.uint8]


def begin_manifest(
    params: GenerateParams, options: ReadOptions, parts: PictureParts, plan: ViewPlan, out: Path
) -> dict[str, Any]:
    """Writes the manifest of a set about to be made, unless the same is there; returns it.

    Raises:
        DatasetError: The folder holds another set, or something else.
    """
    manifest = _manifest(params, options, parts, plan)
    path = out / MANIFEST_FILE
    remove_leftovers(out)
    if out.exists() and any(out.iterdir()):
        found = _read(path)
        if not isinstance(found.get("settings"), dict):
            raise DatasetError(
                f"{out} holds something else than a training set.", "Name a new or empty folder with out=."
            )
        if found.get("digest") != manifest["digest"]:
            changed = _difference(found, manifest)
            raise DatasetError(
                f"{out} holds another training set{changed}.", "Name another folder with out=, or remove it."
            )
        return manifest
    make_folder(out)
    _write(manifest | {"state": "unfinished"}, path)
    return manifest


def finish_manifest(manifest: dict[str, Any], out: Path) -> None:
    """Writes the manifest of a finished set."""
    _write(manifest | {"state": "finished"}, out / MANIFEST_FILE)


def _manifest(
    params: GenerateParams, options: ReadOptions, parts: PictureParts, plan: ViewPlan
) -> dict[str, Any]:
    scene = parts.scene
    settings = {key: value for key, value in asdict(params).items() if key not in _IDLE}
    paths = {key: Path(settings[key]).expanduser() for key in _PATHS if settings[key] is not None}
    inputs = {
        key: _texture_digests(path) if key == "texture_model" else _digests(path)
        for key, path in paths.items()
    }
    identity = {
        "settings": {key: value for key, value in settings.items() if key not in _PATHS},
        "inputs": {key: sorted(digests.values()) for key, digests in inputs.items()},
        # Other options of the source read another city from the same file.
        "cities": parts.cities_digest(),
        "code": _code_digest(),
        "schema": SCHEMA,
    }
    counts = Counter(view.split for view in plan.views)
    return {
        "schema": SCHEMA,
        "digest": digest_of(identity),
        "code": identity["code"],
        "settings": settings,
        "source": told_options(options),
        "inputs": inputs,
        "versions": {"lodbench": __version__} | {name: version(name) for name in _LIBRARIES},
        "city": dict(buildings=scene.num_buildings, lod=scene.lod, crs=scene.crs, scene=scene.digest()),
        "frame": "poses: world to camera, in the city's coordinates, metres; pitch 0 looks straight down",
        "views": {split: counts[split] for split in SPLITS},
        "candidates": plan.candidates,
        "skipped": plan.skipped,
    }


def _digests(path: Path) -> dict[str, str]:
    """Returns the SHA-256 of a file, or of every file of a folder of tiles, by name."""
    if path.is_dir():
        return {source.path.name: file_digest(source.path) for source in open_sources(path)}
    return {path.name: file_digest(path)}


def _texture_digests(path: Path) -> dict[str, str]:
    """Returns the SHA-256 of every file of a textured mesh: its materials and pictures are what is drawn."""
    root = path if path.is_dir() else path.parent
    files = dict.fromkeys(files_of_textured(path))
    return {file.relative_to(root).as_posix(): file_digest(file) for file in files}


def _read(path: Path) -> dict[str, Any]:
    try:
        found = parse_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _difference(found: dict[str, Any], wanted: dict[str, Any]) -> str:
    """Returns the first setting that differs, or what else does, for a message."""
    old = found["settings"]
    for key, value in json.loads(json.dumps(wanted["settings"])).items():
        if key not in _PATHS and old.get(key) != value:
            return f" ({key} is {old.get(key)} there)"
    if found.get("code") != wanted["code"]:
        return " (made by another version of lodbench or of its libraries)"
    return " (of other input files, or read in another way)"


@cache
def _code_digest() -> str:
    """Returns a digest of what plans and draws views: poses of one version suit no pictures of another."""
    package = Path(__file__).parents[2]
    files = [file for layer in _LAYERS for file in sorted((package / layer).rglob("*.py"))]
    return digest_of_code(files, _LIBRARIES)


def _write(manifest: dict[str, Any], path: Path) -> None:
    text = json.dumps(manifest, indent=1, sort_keys=True, allow_nan=False, ensure_ascii=False)
    write_text(path, text + "\n")


def write_sheet(params: GenerateParams, views: Sequence[PlannedView], path: Path) -> None:
    """Writes picture, mask and overlay of eight views, evenly chosen, side by side."""
    chosen = [views[k] for k in np.unique(np.linspace(0, len(views) - 1, _VIEWS).round().astype(int))]
    strips = [_strip(params, view, path.parent, params.sheet) for view in chosen]
    strips += [np.full_like(strips[0], 255)] * (-len(strips) % _PER_ROW)
    rows = [np.hstack(strips[k : k + _PER_ROW]) for k in range(0, len(strips), _PER_ROW)]
    write_bytes(path, encoded(np.vstack(rows), ".png", [cv2.IMWRITE_PNG_COMPRESSION, 9]))


def _strip(params: GenerateParams, view: PlannedView, folder: Path, tile: int) -> Picture:
    """Returns the picture (or grey), the mask, and the mask's outline and tint over the picture."""
    files = {path.parent.name: path for path in files_of(params, view, folder)}
    size = (tile, max(1, round(tile * params.size[1] / params.size[0])))
    mask = _picture(files["masks"], size)
    photo = _picture(files["images"], size) if "images" in files else np.full_like(mask, 128)
    share = mask / 255.0 * 0.45
    overlay = (photo * (1.0 - share) + _MASK_BGR * share).astype(np.uint8)
    is_building = (mask[..., 0] > 127).astype(np.uint8)
    outlines, _ = cv2.findContours(is_building, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(overlay, outlines, -1, (255, 255, 255), 1, cv2.LINE_AA)
    strip = np.hstack([photo, mask, overlay])
    return np.pad(strip, ((2, 2), (2, 2), (0, 0)), constant_values=255)


def _picture(path: Path, size: tuple[int, int]) -> Picture:
    picture = read_picture(path)
    if picture is None:
        raise DatasetError(f"{path} is not a picture.", "Delete it and give the same command again.")
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
