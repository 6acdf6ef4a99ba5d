"""Which map gives what: methods over every kind of map of one drawn place, the same photos and priors.

The maps are the town's own levels of detail and what an aerial survey of it delivers: a surface model, alone
and with an orthophoto, drawn from the town's textured survey, noise included. Besides: what a hypothesis over
the surface model costs, and how high the roofs of its blocks are.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from lodbench.bench import Figure, Progress, Report, no_progress, plain_report, words
from lodbench.citymap import CityMap
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.read import open_scene
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.textured_map import open_textured_map
from lodbench.datasets.inputs import Input, declared_inputs
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Dataset
from lodbench.errors import ConfigError
from lodbench.evaluation.metrics import ERROR
from lodbench.evaluation.pose_errors import PROBABILITY_THRESHOLD, hits_of
from lodbench.geometry import Camera
from lodbench.harness.city import open_city
from lodbench.harness.runs.run import RunSettings, run_method
from lodbench.methods import Method
from lodbench.methods.registry import make_method
from lodbench.params import flag
from lodbench.reporting.aligned_text import format_columns
from lodbench.reporting.figures import SERIES, draw_figure
from lodbench.segmentation.masks import MaskFiles, MasksParams
from lodbench.storage import make_folder, random_stream
from lodbench.synthesis.demo import DemoParams, open_demo, textured_map_of_demo
from lodbench.synthesis.surveys import viewed_from_above, write_surface_model
from lodbench.synthesis.town.build import CITY_FILE, FINE_CITY_FILE
from lodbench.synthesis.views import FINE_SIZE, written_once

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure as Canvas

_CRS = "EPSG:25832+7837"
_CELL_M, _NOISE_M, _SIDE_M = 0.5, 0.05, 1300.0
# Maps whose hypotheses are timed, the surface model first; around so many views, so many each, so often.
_TIMED = ("DSM", "DSM blocks", "LoD1")
_VIEWS, _HYPOTHESES, _PASSES = 12, 256, 3
# A building stands free with no other so near; its height is right within this of the true median.
_FREE_M, _RIGHT_M = 3.0, 0.5
# What each map is: its file, level of detail, rule for an absent level 1, and whether the orthophoto is used.
MAPS: dict[str, tuple[str, str, str | None, bool]] = {
    "LoD1": (CITY_FILE, "1", None, False),
    "LoD2": (CITY_FILE, "2", None, False),
    "LoD3": (FINE_CITY_FILE, "3", None, False),
    "DSM": ("dsm.tif", "2", None, False),
    "DSM blocks": ("dsm.tif", "1", "median", False),
    "DSM + orthophoto": ("dsm.tif", "2", None, True),
    # Its textures have no error of place or shape: what bounds those of the others.
    "textured mesh": (CITY_FILE, "2", None, False),
}
_MESH, _TEXTURED = "textured mesh", ("DSM + orthophoto", "textured mesh")
Rows = Sequence[tuple[str, str, Any]]


@dataclass(frozen=True, slots=True)
class MapsOptions:
    """What to measure.

    Raises:
        ConfigError: A map is not known, or there is no query.
    """

    methods: tuple[str, ...] = flag(
        ("region", "contour_alignment"),
        "methods, comma-separated, settings after colons (uavd4l:matcher=xfeat); '' for the surface model's "
        "cost and heights alone (region,contour_alignment)",
        "--method",
        metavar="METHOD",
        type=words,
        action="store",
    )
    maps: tuple[str, ...] = flag(
        tuple(MAPS), f"maps, comma-separated ({','.join(MAPS)})", type=words, action="store"
    )
    queries: int = flag(20, "photos per split, in place and out of place (20)")
    town_seed: int = flag(0, "random seed of the town (0)")

    def __post_init__(self) -> None:
        unknown = [name for name in self.maps if name not in MAPS]
        for words_of_method in self.methods:
            _method(words_of_method)
        if unknown or not self.maps:
            raise ConfigError(f"{', '.join(unknown) or 'no map'} is no map.", f"Known: {', '.join(MAPS)}.")
        if self.queries < 1:
            raise ConfigError(f"queries={self.queries} is not a number of photos.")


def measure_maps(options: MapsOptions | None = None, progress: Progress = no_progress) -> Report:
    """Returns what methods find over every map of the demo town; ``data`` has a row per query.

    Raises:
        LodbenchError: The town or a map cannot be made or read.
    """
    import pandas as pd

    options = options or MapsOptions()
    demo = open_demo(DemoParams(town_seed=options.town_seed))
    survey = surveyed(demo.root, options.town_seed)
    jobs = [job for job in product(options.maps, options.methods) if _is_usable(*job)]
    tables = []
    for done, (name, method) in enumerate(jobs, start=1):
        tables.append(_queries_of(demo, survey, name, method, options))
        progress(done, len(jobs))
    surface = [*_costs(demo, survey), *_roof_heights(demo, survey)]
    if not jobs:
        return plain_report("surface model", surface)
    queries = pd.concat(tables)
    rows = [
        (name, method, queries[(queries["map"] == name) & (queries["method"] == method)])
        for name, method in jobs
    ]
    lines = [
        _table(rows),
        "",
        plain_report("surface model", surface).text,
        "",
        f"{demo.version}, {options.queries} photos per split at most, tilt=prior; the surface model: "
        f"{_CELL_M:g} m cells, {_NOISE_M:g} m noise, of the town's survey years before the photos, trees "
        "included. Masks for contour_alignment are the demo's.",
    ]
    return Report("\n".join(lines), [*_figures(rows), *surface], queries, partial(_pictures, rows))


def surveyed(root: Path, seed: int) -> Path:
    """Returns the folder of a demo's surface model and orthophoto, made first if they are not there."""

    def write(folder: Path) -> None:
        scene = open_scene(root / CITY_FILE, lod="1")
        mesh = open_textured_map(textured_map_of_demo(root, seed, "test"), scene)
        write_surface_model(
            make_folder(folder), mesh, scene.origin, _CRS, cell_m=_CELL_M, noise_m=_NOISE_M, side_m=_SIDE_M,
            seed=seed,
        )  # fmt: skip

    return written_once(root.with_name(f"{root.name}-surface-{_CELL_M:g}-{_NOISE_M:g}-{_SIDE_M:g}"), write)


def _method(words: str) -> Method:
    """Returns the method of ``NAME:SETTING=VALUE:...``.

    Raises:
        ConfigError: There is no such method or setting.
    """
    name, *settings = words.split(":")
    if not all("=" in setting for setting in settings):
        raise ConfigError(f"{words} is no method with settings.", "They are NAME=VALUE, after colons.")
    return make_method(name, **dict(setting.split("=", 1) for setting in settings))


def _is_usable(name: str, method: str) -> bool:
    """Tells whether a method that needs textures has a map with some, and another no map for these alone."""
    needs_texture = Input.TEXTURED_MAP in declared_inputs(_method(method), "requires", {Input.MASK})
    return name in _TEXTURED if needs_texture else name != _MESH


def _over(demo: Dataset, survey: Path, name: str) -> tuple[Dataset, Scene]:
    """Returns the demo over another map of the place, and that."""
    file, lod, rule, has_colours = MAPS[name]
    city = (survey if file == "dsm.tif" else demo.root) / file
    reading = ReadOptions(orthophoto=str(survey / "dop.tif") if has_colours else None)
    dataset = replace(demo, city_model=city, lod=lod, city_options=reading, roof_height=rule)
    return dataset, open_city(city, lod, reading, rule).scene


def _costs(demo: Dataset, survey: Path) -> Iterator[Figure]:
    """Yields CPU time per hypothesis over the surface model, its blocks and LoD1, in turns, and ratios."""
    maps = {name: CityMap(_over(demo, survey, name)[1], threads=1) for name in _TIMED}
    spent = dict.fromkeys(maps, 0.0)
    stream = random_stream(0, "bench maps", "hypotheses")
    views = [entry for entry in demo.entries if entry.camera is not None][::-1][:_VIEWS]
    for entry in views:
        truth, camera = demo.truth[entry.key], cast(Camera, entry.camera).scaled(*FINE_SIZE)
        poses = [UniformPrior().draw(truth, stream) for _ in range(_HYPOTHESES)]
        rotations, centers = np.array([p.rotation for p in poses]), np.array([p.center for p in poses])
        least = dict.fromkeys(maps, np.inf)
        for _, (name, city_map) in product(range(_PASSES), maps.items()):
            origin = city_map.scene.origin
            mask = city_map.render(camera, truth.shifted(-origin))
            started = time.process_time()
            city_map.counts(camera, rotations, centers - origin, mask)
            least[name] = min(least[name], time.process_time() - started)
        for name in maps:
            spent[name] += least[name]
    first = spent[_TIMED[0]]
    for name, seconds in spent.items():
        us = 1e6 * seconds / (len(views) * _HYPOTHESES)
        yield Figure(f"a hypothesis, {name}, {FINE_SIZE[0]} x {FINE_SIZE[1]}, one core", us, "us")
    for name in _TIMED[1:]:
        yield Figure(f"a hypothesis, {_TIMED[0]}, times {name}", first / spent[name], "")


def _roof_heights(demo: Dataset, survey: Path) -> Iterator[Figure]:
    """Yields how high the roofs of the surface model's blocks are beside the town's own at the survey."""
    truth = open_scene(demo.root / CITY_FILE, lod="2")
    errors = block_errors(truth, _over(demo, survey, "DSM blocks")[1])
    known = np.abs(errors[np.isfinite(errors)])
    yield Figure("buildings that stand free", len(errors), "")
    yield Figure("of these without a block", len(errors) - len(known), "")
    right = float((known <= _RIGHT_M).sum()) / max(len(errors), 1)
    yield Figure(f"of these within {_RIGHT_M:g} m of the true median roof", 100.0 * right, "%")
    yield Figure("median error of those with a block", float(np.median(known)) if len(known) else np.nan, "m")


def block_errors(truth: Scene, derived: Scene) -> NDArray[np.float64]:
    """Returns how much too high the blocks over each building that stands free are, metres; inf without any.

    Both are looked at from above, in cells of half a metre: medians over the building's cells are compared.
    Without any is a building fewer than half of whose cells have a block.

    Args:
        truth: The buildings, roofs as they are.
        derived: The blocks, in the same coordinates.
    """
    low, high = truth.extent_m
    west, north = float(np.floor(low[0])), float(np.ceil(high[1]))
    shape = int((north - low[1]) / _CELL_M) + 1, int((high[0] - west) / _CELL_M) + 1

    def from_above(scene: Scene) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        corners = scene.vertices[scene.triangles].astype(np.float64) + (scene.origin - truth.origin)
        return viewed_from_above(corners, west, north, _CELL_M, shape)

    roofs, triangle = from_above(truth)
    blocks, _ = from_above(derived)
    owner = np.where(triangle < 0, 0, np.searchsorted(truth.triangle_starts, triangle, side="right"))
    errors = []
    for cells in _free_standing(owner.astype(np.float32)):
        own = blocks.ravel()[cells]
        is_there = 2 * np.isfinite(own).sum() >= len(cells)
        gap = float(np.nanmedian(own) - np.median(roofs.ravel()[cells])) if is_there else np.inf
        errors.append(gap)
    return np.array(errors)


def _free_standing(owner: NDArray[np.float32]) -> Iterator[NDArray[np.int64]]:
    """Yields the cells of each building that no other is near to; ``owner`` is 0 where there is none."""
    import cv2

    side = 2 * round(_FREE_M / _CELL_M) + 1
    square = np.ones((side, side), np.uint8)
    highest = cv2.dilate(owner, square)
    lowest = cv2.erode(np.where(owner > 0, owner, np.float32(np.inf)), square)
    order = np.argsort(owner, axis=None, kind="stable")
    starts = np.flatnonzero(np.diff(owner.ravel()[order], prepend=-1.0))
    for cells in np.split(order, starts[1:]):
        own = owner.ravel()[cells[0]]
        if own > 0 and (highest.ravel()[cells] == own).all() and (lowest.ravel()[cells] == own).all():
            yield cells


def _queries_of(demo: Dataset, survey: Path, name: str, method: str, options: MapsOptions) -> pd.DataFrame:
    # Read before the clock runs.
    dataset, scene = _over(demo, survey, name)
    if name in _TEXTURED and name != _MESH and Input.TEXTURED_MAP in dataset.on_demand:
        dataset = replace(dataset, on_demand={Input.TEXTURED_MAP: lambda: survey / "dsm.tif"})
    started = time.process_time()
    with tempfile.TemporaryDirectory() as scratch:
        settings = RunSettings(Path(scratch), limit=options.queries)
        run = run_method(_method(method), dataset, MaskFiles(MasksParams()), settings)
    spent = time.process_time() - started
    return run.queries.assign(
        map=name, method=method, triangles=len(scene.triangles), cpu_s=spent / max(len(run.queries), 1)
    )


def _percent_within(queries: pd.DataFrame) -> float:
    return 100.0 * float(hits_of(queries[list(ERROR)].to_numpy(), PROBABILITY_THRESHOLD).mean())


def _table(rows: Rows) -> str:
    splits = list(dict.fromkeys(rows[0][2]["split"]))
    head = ["", *(f"{split} %" for split in splits), "median m", "median deg", "triangles", "CPU s/query"]
    lines = [head]
    for name, method, queries in rows:
        shares = [f"{_percent_within(queries[queries['split'] == split]):.0f}" for split in splits]
        medians = [f"{queries[error].median():.2f}" for error in ERROR]
        first = queries.iloc[0]
        lines.append(
            [f"{method}  {name}", *shares, *medians, f"{first['triangles']:,}", f"{first['cpu_s']:.1f}"]
        )
    return format_columns(lines)


def _figures(rows: Rows) -> Iterator[Figure]:
    for name, method, queries in rows:
        for split, own in queries.groupby("split", sort=False):
            yield Figure(f"within (2 m, 2 deg), {method}, {name}, {split}", _percent_within(own), "%")
        yield Figure(f"median error, {method}, {name}", float(queries[ERROR[0]].median()), "m")


def _pictures(rows: Rows) -> dict[str, bytes]:
    """Returns errors of every query by map and method, with their medians."""
    maps, methods = (list(dict.fromkeys(row[at] for row in rows)) for at in (0, 1))
    step = 0.84 / max(len(methods), 2)

    def draw(canvas: Canvas) -> None:
        axis = canvas.subplots()
        for name, method, queries in rows:
            place = maps.index(name) + step * (methods.index(method) - 0.5 * (len(methods) - 1))
            errors = np.sort(queries[ERROR[0]].clip(upper=100.0).to_numpy())
            colour = SERIES[methods.index(method) % len(SERIES)]
            spread = place + 0.66 * step * (np.linspace(0.0, 1.0, len(errors)) - 0.5)
            axis.plot(spread, errors, "o", color=colour, markersize=3.5, alpha=0.75, markeredgewidth=0)
            axis.hlines(
                np.median(errors), place - 0.44 * step, place + 0.44 * step, color=colour, linewidth=1.5
            )
            axis.annotate(
                f"{_percent_within(queries):.0f} %", (place, 110.0), ha="center", fontsize=8, color=colour
            )
        axis.axhline(2.0, color="#808080", linewidth=0.8, linestyle="--")
        axis.set_yscale("log")
        axis.yaxis.set_major_formatter("{x:g}")
        axis.set_ylim(0.02, 170.0)
        axis.set_ylabel("error m, one dot per photo; bar: median; above: within (2 m, 2 deg)")
        axis.set_xticks(range(len(maps)), maps)
        for number, method in enumerate(methods):
            axis.plot([], [], "o", color=SERIES[number % len(SERIES)], label=method)
        canvas.legend(loc="outside upper center", ncols=len(methods), frameon=False)

    return {
        f"maps.{kind}": content for kind, content in draw_figure(1.6 + 1.5 * len(maps), 4.6, draw).items()
    }
