"""Writes the demo as a folder in LoD-Loc's text layout, whole or not at all."""

from __future__ import annotations

import json
from collections import Counter
from functools import cache, partial
from pathlib import Path
from typing import Any

from lodbench.citymodel import open_scene
from lodbench.errors import DatasetError
from lodbench.storage import digest_of, file_digest, write_text
from lodbench.storage.json_text import parse_json
from lodbench.synthesis.objects.scene_props import write_props
from lodbench.synthesis.queries import write_queries, written_once
from lodbench.synthesis.town.citygml_writer import (
    CRS_NAME,
    ascii_grid_text,
    citygml_text,
    relief_text,
    title,
)
from lodbench.synthesis.town.looks import look_named
from lodbench.synthesis.town.props import demo_props
from lodbench.synthesis.town.queries import QUERY_CAMERA, TARGET_IOU, DemoSplit, make_splits
from lodbench.synthesis.town.town import TOWN_VERSION, Town, grow_town

CITY_FILE = "town.gml"
FINE_CITY_FILE = "town_lod3.gml"
RELIEF_FILE = "relief.gml"
TERRAIN_FILE = "terrain.asc"
PROPS_FILE = "props.npz"
MANIFEST_FILE = "demo.json"
# The code that makes the demo.
DEMO_CODE = (
    *("synthesis/town/*.py", "synthesis/town/templates/*", "synthesis/objects/*.py", "synthesis/photo/*.py"),
    *("synthesis/queries.py", "synthesis/view_sampling.py", "synthesis/mask_*.py"),
    *("citymodel/building_boxes.py", "datasets/priors.py"),
)
# Of quaternions and of metres.
_POSE_DECIMALS = (12, 6)


def build_demo(root: Path, *, num_queries: int = 40, seed: int = 0, look: str = "test") -> Path:
    """Builds the demo dataset in a folder, unless the same one is there already.

    The folder holds ``town.gml`` (LoD1 and LoD2), ``town_lod3.gml``, the ground as ``relief.gml``
    (CityGML) and ``terrain.asc`` (raster), ``props.npz`` (what a photo shows), ``demo.json``, and per
    split ``in_place`` and ``out_of_place`` the files ``GT_pose.txt``, ``GPS_pose.txt``,
    ``intrinsic.txt``, ``Query_image/`` and ``masks/``. Poses are world to camera in the absolute
    coordinates of the city file. All bytes follow from the seed and the look.

    Args:
        root: The folder to create; its parents are made where missing.
        num_queries: Queries over both splits.
        seed: Seed of the town and everything in it.
        look: ``test`` or ``train``.

    Returns:
        ``root``.

    Raises:
        DatasetError: Fewer than two queries, an unknown look, or something else stands at ``root``.
    """
    if num_queries < 2:
        raise DatasetError(f"The demo has two splits, so it needs at least 2 queries, not {num_queries}.")
    asked = {
        "town_version": TOWN_VERSION,
        "look": look_named(look).name,
        "seed": seed,
        "num_queries": num_queries,
    }
    if root.exists() and _is_same_demo(root, asked):
        return root
    return written_once(root, partial(_write_demo, asked))


@cache
def code_digest(*patterns: str) -> str:
    """Returns a digest of files of this package, for what is made by them: other code, another name."""
    package = Path(__file__).parents[2]
    files = [file for pattern in patterns for file in sorted(package.glob(pattern))]
    return digest_of([file_digest(file) for file in files], length=8)


def _is_same_demo(root: Path, asked: dict[str, Any]) -> bool:
    """Returns whether a finished demo with these parameters stands at a path.

    Raises:
        DatasetError: Something else does.
    """
    try:
        manifest = parse_json((root / MANIFEST_FILE).read_text(encoding="utf-8"))
        found = {key: manifest[key] for key in asked}
    except (OSError, ValueError, KeyError, TypeError):
        raise DatasetError(
            f"{root} exists and is no demo dataset.", "Name another folder, or remove it."
        ) from None
    if found != asked:
        raise DatasetError(
            f"{root} holds another demo: {found} instead of {asked}.", "Name another folder, or remove it."
        )
    return True


def _write_demo(asked: dict[str, Any], folder: Path) -> None:
    town = grow_town(asked["seed"], look_named(asked["look"]))
    props = demo_props(town)
    texts = {
        CITY_FILE: citygml_text(town),
        FINE_CITY_FILE: citygml_text(town, is_fine=True),
        RELIEF_FILE: relief_text(town.terrain, f"{title(town)}: relief"),
        TERRAIN_FILE: ascii_grid_text(town.terrain),
    }
    for name, text in texts.items():
        write_text(folder / name, text, survives_power_cut=False)
    write_props(props, folder / PROPS_FILE)
    # The queries see the town as a reader does: through the file, in the frame it gives the scene.
    scene = open_scene(folder / FINE_CITY_FILE, lod="3")
    splits = make_splits(town, scene, props, asked["num_queries"])
    for split in splits:
        write_queries(folder / split.name, split.queries, QUERY_CAMERA, scene.origin, _POSE_DECIMALS)
    manifest = asked | _manifest(town, splits)
    text = json.dumps(manifest, indent=1, sort_keys=True, allow_nan=False)
    write_text(folder / MANIFEST_FILE, text + "\n", survives_power_cut=False)


def _manifest(town: Town, splits: list[DemoSplit]) -> dict[str, Any]:
    """Returns what there is to know about the demo besides its files."""
    return {
        "city": {
            "files": {"1": CITY_FILE, "2": CITY_FILE, "3": FINE_CITY_FILE},
            "crs": CRS_NAME,
            "buildings": len(town.mapped),
            "buildings_lod3": len(town.standing),
            "changed_since": dict(sorted(Counter(building.age.value for building in town.buildings).items())),
            "ground": {"relief": RELIEF_FILE, "raster": TERRAIN_FILE},
        },
        "props": PROPS_FILE,
        "frame": "world to camera, absolute coordinates of the CRS, metres",
        "splits": {
            split.name: {
                "queries": len(split.queries),
                "rejected_views": split.rejections,
                "target_iou": list(TARGET_IOU[split.name]),
                "mask_iou": {query.name: round(query.achieved_iou, 6) for query in split.queries},
            }
            for split in splits
        },
    }
