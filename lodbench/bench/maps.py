"""Which map gives what: methods over every kind of map of one drawn place, the same photos and priors.

The maps are the town's own levels of detail and what an aerial survey of it delivers: a surface model, alone
and with an orthophoto, drawn from the town's textured survey, noise included.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lodbench.bench import SEED, Figure, Progress, Report, no_progress, option, words
from lodbench.citymodel.mesh.texture_files import open_textured_map
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.read import open_scene
from lodbench.datasets.query import Dataset
from lodbench.errors import ConfigError
from lodbench.evaluation.queries import ERROR
from lodbench.evaluation.recall import PROBABILITY_THRESHOLD, hits_of
from lodbench.harness.city import open_city
from lodbench.harness.runs.run import RunSettings, run_method
from lodbench.methods.registry import make_method
from lodbench.reporting.aligned_text import format_columns
from lodbench.reporting.figures import SERIES, draw_figure
from lodbench.segmentation.masks import MaskFiles, MasksParams
from lodbench.storage import make_folder
from lodbench.synthesis.demo import DemoParams, open_demo, textured_map_of_demo
from lodbench.synthesis.queries import written_once
from lodbench.synthesis.surface_survey import write_surface_model
from lodbench.synthesis.town.build import CITY_FILE, FINE_CITY_FILE

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure as Canvas

_CRS = "EPSG:25832+7837"
_CELL_M, _NOISE_M, _SIDE_M = 0.5, 0.05, 1300.0
# What each map is: its file, level of detail, rule for an absent level 1, and whether the orthophoto is used.
MAPS: dict[str, tuple[str, str, str | None, bool]] = {
    "LoD1": (CITY_FILE, "1", None, False),
    "LoD2": (CITY_FILE, "2", None, False),
    "LoD3": (FINE_CITY_FILE, "3", None, False),
    "DSM": ("dsm.tif", "2", None, False),
    "DSM blocks": ("dsm.tif", "1", "median", False),
    "DSM + orthophoto": ("dsm.tif", "2", None, True),
}


@dataclass(frozen=True, slots=True)
class MapsOptions:
    """What to measure.

    Raises:
        ConfigError: A map is not known, or there is no query.
    """

    methods: tuple[str, ...] = option(
        ("region", "contour_alignment"), "methods, comma-separated", flag="method", parse=words
    )
    maps: tuple[str, ...] = option(tuple(MAPS), "maps, comma-separated", parse=words)
    queries: int = option(20, "photos per split, in place and out of place")
    town_seed: int = option(0, SEED + " of the town")

    def __post_init__(self) -> None:
        unknown = [name for name in self.maps if name not in MAPS]
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
    jobs = list(product(options.maps, options.methods))
    tables = []
    for done, (name, method) in enumerate(jobs, start=1):
        tables.append(_queries_of(demo, survey, name, method, options))
        progress(done, len(jobs))
    queries = pd.concat(tables)
    rows = [
        (name, method, queries[(queries["map"] == name) & (queries["method"] == method)])
        for name, method in jobs
    ]
    lines = [
        _table(rows),
        f"{demo.version}, {options.queries} photos per split at most, tilt=prior; the surface model: "
        f"{_CELL_M:g} m cells, {_NOISE_M:g} m noise, of the town's survey years before the photos, trees "
        "included. Masks for contour_alignment are the demo's.",
    ]
    return Report("\n".join(lines), list(_figures(rows)), queries, partial(_pictures, rows))


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


def _queries_of(demo: Dataset, survey: Path, name: str, method: str, options: MapsOptions) -> pd.DataFrame:
    file, lod, rule, has_colours = MAPS[name]
    city = (survey if file == "dsm.tif" else demo.root) / file
    reading = ReadOptions(orthophoto=str(survey / "dop.tif") if has_colours else None)
    dataset = replace(demo, city_model=city, lod=lod, city_options=reading, roof_height=rule)
    # Read before the clock runs.
    scene = open_city(city, lod, reading, rule).scene
    started = time.process_time()
    with tempfile.TemporaryDirectory() as scratch:
        settings = RunSettings(Path(scratch), limit=options.queries)
        run = run_method(make_method(method), dataset, MaskFiles(MasksParams()), settings)
    spent = time.process_time() - started
    return run.queries.assign(
        map=name,
        method=method,
        triangles=len(scene.triangles),
        cpu_s=spent / max(len(run.queries), 1),
    )


Rows = Sequence[tuple[str, str, Any]]


def _found(queries: pd.DataFrame) -> float:
    return 100.0 * float(hits_of(queries[list(ERROR)].to_numpy(), PROBABILITY_THRESHOLD).mean())


def _table(rows: Rows) -> str:
    splits = list(dict.fromkeys(rows[0][2]["split"]))
    head = ["", *(f"{split} %" for split in splits), "median m", "median deg", "triangles", "CPU s/query"]
    lines = [head]
    for name, method, queries in rows:
        shares = [f"{_found(queries[queries['split'] == split]):.0f}" for split in splits]
        medians = [f"{queries[error].median():.2f}" for error in ERROR]
        first = queries.iloc[0]
        lines.append(
            [f"{method}  {name}", *shares, *medians, f"{first['triangles']:,}", f"{first['cpu_s']:.1f}"]
        )
    return format_columns(lines)


def _figures(rows: Rows) -> Iterator[Figure]:
    for name, method, queries in rows:
        for split, own in queries.groupby("split", sort=False):
            yield Figure(f"within (2 m, 2 deg), {method}, {name}, {split}", _found(own), "%")
        yield Figure(f"median error, {method}, {name}", float(queries[ERROR[0]].median()), "m")


def _pictures(rows: Rows) -> dict[str, bytes]:
    """Returns errors of every query by map and method, with their medians."""
    maps, methods = (list(dict.fromkeys(row[at] for row in rows)) for at in (0, 1))

    def draw(canvas: Canvas) -> None:
        axis = canvas.subplots()
        for name, method, queries in rows:
            place = maps.index(name) + 0.36 * (methods.index(method) - 0.5 * (len(methods) - 1))
            errors = np.sort(queries[ERROR[0]].clip(upper=100.0).to_numpy())
            colour = SERIES[methods.index(method) % len(SERIES)]
            spread = place + 0.24 * (np.linspace(0.0, 1.0, len(errors)) - 0.5)
            axis.plot(spread, errors, "o", color=colour, markersize=3.5, alpha=0.75, markeredgewidth=0)
            axis.hlines(np.median(errors), place - 0.16, place + 0.16, color=colour, linewidth=1.5)
            axis.annotate(f"{_found(queries):.0f} %", (place, 110.0), ha="center", fontsize=8, color=colour)
        axis.axhline(2.0, color="#808080", linewidth=0.8, linestyle="--")
        axis.set_yscale("log")
        axis.yaxis.set_major_formatter("{x:g}")
        axis.set_ylim(0.05, 170.0)
        axis.set_ylabel("error m, one dot per photo; bar: median; above: within (2 m, 2 deg)")
        axis.set_xticks(range(len(maps)), maps)
        for number, method in enumerate(methods):
            axis.plot([], [], "o", color=SERIES[number % len(SERIES)], label=method)
        axis.legend(loc="lower left", frameon=False)

    return {
        f"maps.{kind}": content for kind, content in draw_figure(1.6 + 1.5 * len(maps), 4.6, draw).items()
    }
