"""Writes the demo as a folder in LoD-Loc's text layout, whole or not at all, by seed and look alone.

The town is two CityGML 2.0 files, as real cities deliver them: one with LoD1 and LoD2, and one, ten times as
large, with LoD3. The ground beside them is a CityGML relief (a TIN), and an ESRI ASCII grid, which footprint
readers take. What CityGML files look like is in ``templates``.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lodbench.citymodel import open_scene
from lodbench.citymodel.scene import Scene
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.errors import DatasetError
from lodbench.execution import Progress
from lodbench.geometry import EulerAngles, Pose
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.storage import digest_of, file_digest, random_stream, write_text
from lodbench.storage.json_text import parse_json
from lodbench.synthesis.mask_degradation import degrade_mask
from lodbench.synthesis.objects import SceneProps, write_props
from lodbench.synthesis.photo import LookRanges, PhotoRenderer, draw_look
from lodbench.synthesis.town.props import demo_props
from lodbench.synthesis.town.shapes import Points, look_named
from lodbench.synthesis.town.streets import Terrain
from lodbench.synthesis.town.town import CRS_NAME, OLD_TOWN_RADIUS_M, ORIGIN_M, TOWN_VERSION, Town, grow_town
from lodbench.synthesis.views import (
    FINE_SIZE,
    RGB_CAMERA,
    SyntheticQuery,
    ViewCheck,
    ViewSampling,
    first_accepted,
    sample_views,
    view_of,
    write_queries,
    written_once,
)

if TYPE_CHECKING:
    from jinja2 import Template

# Twice the size at which methods compare silhouettes: masks are finer than what is scored, as a
# network's are, and still small files.
QUERY_CAMERA = RGB_CAMERA.scaled(2 * FINE_SIZE[0], 2 * FINE_SIZE[1])
# IoU of the masks with the true silhouettes: its mean, as the paper's network does in and out of place,
# and how far single masks lie above or below it: a network is not equally good everywhere.
TARGET_IOU = {"in_place": (0.88, 0.09), "out_of_place": (0.80, 0.15)}
# The published priors in place; out of place errors beyond a local search, as in the paper's Table 3 (30 m).
PRIORS = {"in_place": UniformPrior(), "out_of_place": UniformPrior(x_m=30.0, y_m=30.0, yaw_deg=15.0)}

_BUILDING_SHARE = {"in_place": (0.10, 0.80), "out_of_place": (0.05, 0.80)}
# The flight over the old town: height of each line, tilt of its camera, and jitter around both.
_LINE_HEIGHTS_M = (112.0, 130.0, 148.0)
_LINE_PITCHES_DEG = (28.0, 50.0, 38.0)
_LINE_SPACING_M = 105.0
# Where the out-of-place views look: this far from the middle, away from the river.
_SUBURB_AT_M = 345.0
_SUBURB_HALF_M = 135.0
_SUBURB_HEIGHTS_M = (70.0, 150.0)
_ATTEMPTS = 50
# What the photos of one split share: the sun and the air of the day of their flight.
_OF_THE_DAY = ["sun_elevation_deg", "sun_azimuth_deg", "sun_share", "sun_warmth"]
_OF_THE_DAY += ["haze_range_m", "sky_white", "dryness"]


class DemoSplit(NamedTuple):
    """The queries of one split, and how many draws of views were rejected for it."""

    name: str
    queries: tuple[SyntheticQuery, ...]
    rejections: int


def make_splits(town: Town, scene: Scene, props: SceneProps, count: int) -> list[DemoSplit]:
    """Returns both splits of a town in its LoD3 scene, half of the queries each, the odd one in place.

    Raises:
        DatasetError: No acceptable view is found somewhere.
    """
    camera = _QueryCamera(town, scene, props)
    offset_m = ORIGIN_M - scene.origin
    check = ViewCheck(scene, camera.renderer, QUERY_CAMERA, _BUILDING_SHARE["in_place"])
    flight, rejections = _fly_over(town, check, offset_m, count - count // 2)
    x, y = -town.streets.to_river * _SUBURB_AT_M + offset_m[:2]
    area_m = (x - _SUBURB_HALF_M, y - _SUBURB_HALF_M, x + _SUBURB_HALF_M, y + _SUBURB_HALF_M)
    share = _BUILDING_SHARE["out_of_place"]
    sampling = ViewSampling(_SUBURB_HEIGHTS_M, building_share=share, area_m=area_m, seed=town.seed)
    views = sample_views(scene, camera.renderer, QUERY_CAMERA, sampling, count // 2, "demo", "out_of_place")
    return [
        DemoSplit("in_place", camera.take("in_place", flight), rejections),
        DemoSplit("out_of_place", camera.take("out_of_place", views.poses), views.rejections),
    ]


class _QueryCamera:
    """Takes the queries of a town: masks and photos of its scene and props."""

    def __init__(self, town: Town, scene: Scene, props: SceneProps) -> None:
        self._town = town
        self.renderer = SilhouetteRenderer(scene, threads=1)
        self._photos = PhotoRenderer(scene, props)

    def take(self, split: str, truths: Sequence[Pose]) -> tuple[SyntheticQuery, ...]:
        """Returns a prior, a photo and a mask for each true pose of a split, from streams of their own."""
        targets, day = _target_ious(split, self._town.seed, len(truths)), self._day(split)
        queries, lowest_m = [], float(self.renderer.scene.vertices[:, 2].min())
        with Progress(f"demo town, made once: photos {split}", len(truths)) as progress:
            for k, truth in enumerate(truths):
                name = f"{split}_{k:04d}.jpg"
                # Where the view's centre meets the lowest ground.
                drop_m = float(truth.center[2]) - lowest_m
                clean = self.renderer.render(QUERY_CAMERA, truth)
                rough, iou = degrade_mask(
                    # A network cannot see through trees; their shapes are those of the photo.
                    clean & ~self._photos.occluders(QUERY_CAMERA, truth),
                    targets[k],
                    random_stream(self._town.seed, "demo", name, "mask"),
                    trees=False,
                    pixels_per_m=QUERY_CAMERA.fx * -float(truth.rotation[2, 2]) / drop_m,
                    truth=clean,
                )
                prior = PRIORS[split].draw(truth, random_stream(self._town.seed, "demo", name, "prior"))
                look, response = draw_look(day, random_stream(self._town.seed, "demo", name, "photo"))
                # The town's own patterns stay as they are from photo to photo.
                photo = self._photos.jpeg(QUERY_CAMERA, truth, look._replace(seed=self._town.seed), response)
                queries.append(SyntheticQuery(name, truth, prior, rough, iou, photo))
                progress.advance()
        return tuple(queries)

    def _day(self, split: str) -> LookRanges:
        """Returns from what the looks of a split's photos are drawn: sun and air are drawn already."""
        day, ranges = random_stream(self._town.seed, "demo", split, "day"), self._town.look.days
        drawn = {name: float(day.uniform(*getattr(ranges, name))) for name in _OF_THE_DAY}
        return replace(ranges, **{name: (value, value) for name, value in drawn.items()})


def _target_ious(name: str, seed: int, count: int) -> list[float]:
    """Returns the IoU each mask of a split is to have: evenly spread around the mean, in random order."""
    mean, spread = TARGET_IOU[name]
    even = mean + spread * ((2 * np.arange(count) + 1) / count - 1)
    return [float(iou) for iou in random_stream(seed, "demo", name, "iou").permutation(even)]


def _fly_over(town: Town, check: ViewCheck, offset_m: Points, count: int) -> tuple[list[Pose], int]:
    """Returns views along three parallel flight lines over the old town, to and fro, and the rejections.

    The camera looks ahead along the line; a station that shows too few or too many buildings is
    tried again with more jitter.
    """
    turn = float(random_stream(town.seed, "demo", "flight").uniform(-180.0, 180.0))
    poses, rejections = [], 0
    for index in range(count):
        line, place = index * 3 // count, (index * 3 % count) / count
        streams = (random_stream(town.seed, "demo", "in_place", index, k) for k in range(_ATTEMPTS))
        drawn = (_station(town, line, place, turn, 1.0 + k, stream) for k, stream in enumerate(streams))
        stations = (pose.shifted(offset_m) for pose in drawn)
        pose, rejected = first_accepted(stations, check)
        rejections += rejected
        if pose is None:
            raise DatasetError(
                f"The demo town of seed {town.seed} shows too few buildings from its flight line {line}.",
                "Take another seed.",
            )
        poses.append(pose)
    return poses, rejections


def _station(
    town: Town, line: int, place: float, turn: float, jitter: float, generator: np.random.Generator
) -> Pose:
    """Returns the view from one place, in [0, 1), of a flight line, town metres."""
    along = np.array([-np.sin(np.radians(turn)), np.cos(np.radians(turn))])
    across = np.array([along[1], -along[0]])
    forward = line % 2 == 0
    way = 2.0 * place - 1.0 if forward else 1.0 - 2.0 * place
    middle = along * way * OLD_TOWN_RADIUS_M + across * (line - 1) * _LINE_SPACING_M
    middle = middle + generator.normal(0.0, 4.0 * jitter, size=2)
    target = np.append(middle, town.terrain.height(middle[None])[0])
    height = np.clip(_LINE_HEIGHTS_M[line] + generator.normal(0.0, 3.0 * jitter), 100.0, 160.0)
    pitch = np.clip(_LINE_PITCHES_DEG[line] + generator.normal(0.0, 2.0 * jitter), 20.0, 60.0)
    yaw = turn + (0.0 if forward else 180.0) + generator.normal(0.0, 3.0)
    return view_of(
        target, float(height), EulerAngles(float(pitch), float(generator.normal(0, 0.3)), float(yaw))
    )


CITY_FILE = "town.gml"
FINE_CITY_FILE = "town_lod3.gml"
RELIEF_FILE = "relief.gml"
TERRAIN_FILE = "terrain.asc"
PROPS_FILE = "props.npz"
MANIFEST_FILE = "demo.json"
# The code that makes the demo.
DEMO_CODE = (
    *("synthesis/town/*.py", "synthesis/town/*.yaml", "synthesis/town/templates/*"),
    *(
        f"synthesis/{name}.py"
        for name in ("objects", "photo", "views", "surroundings", "land_cover", "mask_*")
    ),
    *("citymodel/scene.py", "datasets/prior_sources.py"),
    *(f"kernels/{name}.py" for name in ("looks", "shading", "surfaces")),
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
    wanted = {
        "town_version": TOWN_VERSION,
        "look": look_named(look).name,
        "seed": seed,
        "num_queries": num_queries,
    }
    if root.exists() and _is_same_demo(root, wanted):
        return root
    return written_once(root, partial(_write_demo, wanted))


@cache
def code_digest(*patterns: str) -> str:
    """Returns a digest of files of this package, for what is made by them: other code, another name."""
    package = Path(__file__).parents[2]
    files = [file for pattern in patterns for file in sorted(package.glob(pattern))]
    return digest_of([file_digest(file) for file in files], length=8)


def _is_same_demo(root: Path, wanted: dict[str, Any]) -> bool:
    """Returns whether a finished demo with these parameters stands at a path."""
    try:
        manifest = parse_json((root / MANIFEST_FILE).read_text(encoding="utf-8"))
        stored = {key: manifest[key] for key in wanted}
    except (OSError, ValueError, KeyError, TypeError):
        raise DatasetError(
            f"{root} exists and is no demo dataset.", "Name another folder, or remove it."
        ) from None
    if stored != wanted:
        raise DatasetError(
            f"{root} holds another demo: {stored} instead of {wanted}.", "Name another folder, or remove it."
        )
    return True


def _write_demo(wanted: dict[str, Any], folder: Path) -> None:
    town = grow_town(wanted["seed"], wanted["look"])
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
    splits = make_splits(town, scene, props, wanted["num_queries"])
    for split in splits:
        write_queries(folder / split.name, split.queries, QUERY_CAMERA, scene.origin, _POSE_DECIMALS)
    manifest = wanted | _manifest(town, splits)
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
