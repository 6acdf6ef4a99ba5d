"""``manifest.json``: what a training set was made of, so that it can be made again."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

from lodbench import __version__
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.source import open_sources
from lodbench.errors import DatasetError
from lodbench.storage import digest_of, file_digest, make_folder, remove_leftovers, write_text
from lodbench.storage.json_text import parse_json
from lodbench.synthesis.training_data.params import GenerateParams
from lodbench.synthesis.training_data.plan_views import SPLITS, ViewPlan

MANIFEST_FILE = "manifest.json"
SCHEMA = 1
_LIBRARIES = ("numpy", "numba", "opencv-python-headless")
# Settings that name files, whose content is named instead; and those that change no byte.
_PATHS = ("city", "texture_model", "props", "terrain", "poses")
_IDLE = ("out", "sheet", "workers")


def begin_manifest(params: GenerateParams, scene: Scene, plan: ViewPlan, out: Path) -> dict[str, Any]:
    """Writes the manifest of a set about to be made, unless the same is there; returns it.

    Raises:
        DatasetError: The folder holds another set, or something else.
    """
    manifest = _manifest(params, scene, plan)
    path = out / MANIFEST_FILE
    remove_leftovers(out)
    if out.exists() and any(out.iterdir()):
        found = _read(path)
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


def _manifest(params: GenerateParams, scene: Scene, plan: ViewPlan) -> dict[str, Any]:
    settings = {key: value for key, value in asdict(params).items() if key not in _IDLE}
    inputs = {key: _digests(Path(settings[key]).expanduser()) for key in _PATHS if settings[key] is not None}
    identity = {
        "settings": {key: value for key, value in settings.items() if key not in _PATHS},
        "inputs": {key: sorted(digests.values()) for key, digests in inputs.items()},
        "schema": SCHEMA,
    }
    counts = Counter(view.split for view in plan.views)
    return {
        "schema": SCHEMA,
        "digest": digest_of(identity),
        "settings": settings,
        "inputs": inputs,
        "versions": {"lodbench": __version__} | {name: version(name) for name in _LIBRARIES},
        "city": {
            "buildings": scene.num_buildings,
            "lod": scene.lod,
            "crs": scene.crs,
            "scene": scene.digest(),
        },
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


def _read(path: Path) -> dict[str, Any]:
    try:
        found = parse_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _difference(found: dict[str, Any], wanted: dict[str, Any]) -> str:
    """Returns the first setting that differs, for a message."""
    old = found.get("settings")
    if not isinstance(old, dict):
        return ", or no training set at all"
    for key, value in json.loads(json.dumps(wanted["settings"])).items():
        if key not in _PATHS and old.get(key) != value:
            return f" ({key} is {old.get(key)} there)"
    return " (of other input files)"


def _write(manifest: dict[str, Any], path: Path) -> None:
    text = json.dumps(manifest, indent=1, sort_keys=True, allow_nan=False, ensure_ascii=False)
    write_text(path, text + "\n")
