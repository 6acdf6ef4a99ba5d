"""Writes the demo as a folder in LoD-Loc's text layout, whole or not at all, by seed and look alone.

The town is two CityGML 2.0 files, as real cities deliver them: one with LoD1 and LoD2, and one, ten times as
large, with LoD3. The ground beside them is a CityGML relief (a TIN), and an ESRI ASCII grid, which footprint
readers take. What CityGML files look like is in ``templates``.
"""

from __future__ import annotations

import json
from collections import Counter
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lodbench.citymodel import open_scene
from lodbench.errors import DatasetError
from lodbench.storage import digest_of, file_digest, write_text
from lodbench.storage.json_text import parse_json
from lodbench.synthesis.objects.scene_props import write_props
from lodbench.synthesis.queries import write_queries, written_once
from lodbench.synthesis.town.looks import look_named
from lodbench.synthesis.town.props import demo_props
from lodbench.synthesis.town.queries import QUERY_CAMERA, TARGET_IOU, DemoSplit, make_splits
from lodbench.synthesis.town.shapes import Points
from lodbench.synthesis.town.terrain import Terrain
from lodbench.synthesis.town.town import CRS_NAME, ORIGIN_M, TOWN_VERSION, Town, grow_town

if TYPE_CHECKING:
    from jinja2 import Template

CITY_FILE = "town.gml"
FINE_CITY_FILE = "town_lod3.gml"
RELIEF_FILE = "relief.gml"
TERRAIN_FILE = "terrain.asc"
PROPS_FILE = "props.npz"
MANIFEST_FILE = "demo.json"
# The code that makes the demo.
DEMO_CODE = (
    *("synthesis/town/*.py", "synthesis/town/*.yaml", "synthesis/town/templates/*"),
    *("synthesis/objects/*.py", "synthesis/photo/*.py", "synthesis/queries.py"),
    *("synthesis/view_sampling.py", "synthesis/mask_*.py"),
    *("citymodel/building_boxes.py", "datasets/priors.py"),
)
# Of quaternions and of metres.
_POSE_DECIMALS = (12, 6)
# The ground's files cover the square of this half side around the town's middle.
REACH_M = 640.0
GRID_CELL_M = 4.0
TIN_STEP_M = 20.0


def build_demo(root: Path, *, num_queries: int = 40, seed: int = 0, look: str = "test") -> Path:
    """Builds the demo dataset in a folder, unless the same one is there already; returns the folder.

    The folder holds ``town.gml`` (LoD1 and LoD2), ``town_lod3.gml``, the ground as ``relief.gml`` (CityGML)
    and ``terrain.asc`` (raster), ``props.npz`` (what a photo shows), ``demo.json``, and per split
    ``in_place`` and ``out_of_place`` the files ``GT_pose.txt``, ``GPS_pose.txt``, ``intrinsic.txt``,
    ``Query_image/`` and ``masks/``. Poses are world to camera in the absolute coordinates of the city file.
    All bytes follow from the number of queries over both splits, the seed and the look, ``test`` or
    ``train``.

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
    town = grow_town(asked["seed"], asked["look"])
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


def citygml_text(town: Town, *, is_fine: bool = False) -> str:
    """Returns the file with LoD1 and LoD2, or the fine one with LoD3, coordinates in `CRS_NAME`."""
    # One envelope for both files, so that readers give them one frame.
    points = np.concatenate([solid.points for b in town.buildings for solid in (b.lod1, b.lod2, b.lod3)])
    buildings = town.standing if is_fine else town.mapped
    template = _template("town.gml.jinja")
    return template.render(name=title(town), points=points, buildings=buildings, is_fine=is_fine)


def title(town: Town) -> str:
    """Returns what a town's files call it."""
    return f"lodbench demo town, version {TOWN_VERSION}, look {town.look.name}, seed {town.seed}"


def ascii_grid_text(terrain: Terrain) -> str:
    """Returns ground heights at the middles of cells, north to south, metres with two decimals."""
    count = round(2 * REACH_M / GRID_CELL_M)
    heights = _grid(terrain, np.linspace(-REACH_M, REACH_M, 2 * count + 1)[1::2])[..., 2]
    west, south, _ = ORIGIN_M - REACH_M
    header = [f"ncols {count}", f"nrows {count}", f"xllcorner {west:.1f}", f"yllcorner {south:.1f}"]
    header += [f"cellsize {GRID_CELL_M:.1f}", "NODATA_value -9999"]
    rows = [" ".join(f"{height:.2f}" for height in row) for row in heights[::-1].tolist()]
    return "\n".join([*header, *rows]) + "\n"


def relief_text(terrain: Terrain, name: str) -> str:
    """Returns a CityGML file with one relief feature: a triangulated irregular network in `CRS_NAME`."""
    grid = _grid(terrain, np.arange(-REACH_M, REACH_M + 0.5 * TIN_STEP_M, TIN_STEP_M, dtype=np.float64))
    south_west, south_east, north_west, north_east = (
        grid[rows, columns].reshape(-1, 3)
        for rows in (slice(-1), slice(1, None))
        for columns in (slice(-1), slice(1, None))
    )
    halves = ((south_west, south_east, north_east), (south_west, north_east, north_west))
    rings = np.concatenate([np.stack([*corners, corners[0]], axis=1) for corners in halves])
    return _template("relief.gml.jinja").render(name=name, points=grid.reshape(-1, 3), rings=rings)


def _grid(terrain: Terrain, axis: Points) -> Points:
    """Returns points of the ground, (N, N, 3), rows from south to north."""
    places = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return terrain.on_ground(places).reshape(len(axis), len(axis), 3)


@cache
def _template(name: str) -> Template:
    """Returns a file of ``templates``, to be filled in."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("lodbench.synthesis.town"),
        autoescape=False,  # noqa: S701 - names and numbers of our own; escaping each takes longer than all else
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=StrictUndefined,
    )
    environment.globals |= {"coordinates": _coordinates, "crs_name": CRS_NAME}
    return environment.get_template(name)


def _coordinates(points: Points) -> str:
    """Returns points, (N, 3) local metres, as absolute coordinates.

    Whole millimetres, or tenths where the points need them.
    """
    fine = np.round(points, 4)
    decimals = 3 if (fine == np.round(points, 3)).all() else 4
    return " ".join(f"{value:.{decimals}f}" for value in (fine + ORIGIN_M).ravel().tolist())
