"""A city made of footprints: as high as a surface model, photos or attributes say, and a page of it."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import (
    GEOMETRY_EMPTY,
    HEIGHT_MISSING,
    UNDERGROUND,
    finding_catalogue,
)
from lodbench.citymodel.convert import convert_city
from lodbench.citymodel.model import CityModel, SurfaceKind
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.read import read_city_model
from lodbench.citymodel.source import open_sources
from lodbench.errors import CityModelError
from lodbench.harness.city_photos import with_photo_heights
from lodbench.reporting.map_figure import Marked, draw_plan
from lodbench.reporting.page import markup, rendered
from lodbench.storage import write_text

# Why a footprint is in no city, by its finding.
_LEFT_OUT = {
    HEIGHT_MISSING: "no height",
    UNDERGROUND: "below the ground",
    GEOMETRY_EMPTY: "no area",
}
# Blocks are this high until photos measure them, metres.
_DEFAULT_M = 9.0


def make_city(
    footprints: Path,
    out: Path,
    options: ReadOptions,
    progress: Callable[[int, int], None] | None = None,
    photos: Path | None = None,
    poses: Path | None = None,
) -> dict[str, Any]:
    """Writes footprints as LoD1 buildings that say where their heights come from, and a page of it.

    Attributes of each building: ``measuredHeight``, ``height_from``, ``ground_from``; of those measured in a
    surface model ``eaves_height_m``, ``ridge_height_m`` and ``roof_cells`` too, in photos ``height_sigma_m``
    and ``height_photos``.

    Args:
        footprints: A file of footprints.
        out: The city to write; the page is beside it, with ``.html`` in place of its last ending.
        options: ``surface``, ``terrain``, and how columns are called.
        progress: As for ``read_city_model``.
        photos: Photos that measure heights where no surface model does; see ``with_photo_heights``.
        poses: Their poses, where they are no dataset.

    Returns:
        What was written, as JSON values by name.

    Raises:
        CityModelError: A file cannot be read, is no file of footprints, or no footprint has a height.
        DatasetError: There are no photos with known poses and cameras.
        OSError: The disk is full.
    """
    if any(source.vector_path is None for source in open_sources(footprints)):
        raise CityModelError(
            f"{footprints} is no file of footprints by its ending.",
            "Known: .osm.pbf, .osm, .gpkg, .geojson, .shp, .fgb, .gdb, .parquet.",
        )
    # Photos measure the roofs of blocks, also of those that nothing else gives a height.
    default_m = _DEFAULT_M if photos is not None and options.default_height_m is None else None
    detailed = replace(options, has_details=True, default_height_m=options.default_height_m or default_m)
    model = read_city_model(footprints, options=detailed, progress=progress)
    used = 0
    if photos is not None:
        model, used = with_photo_heights(model, photos, poses, keeps_default=default_m is None)
    buildings = _buildings(model)
    left_out: dict[str, list[str]] = defaultdict(list)
    for item in model.findings.items:
        if item.code in _LEFT_OUT:
            left_out[_LEFT_OUT[item.code]].append(item.object_id)
    conversion = convert_city(model, out, options=options)
    meanings = {str(code): code.meaning for code in finding_catalogue()}
    counts = conversion.findings.counts()
    page = out.with_suffix(".html")
    reported = [(code, count, meanings[code]) for code, count in counts.items()]
    lines = [f"Footprints: {footprints.name}."]
    lines += [f"Surface model: {Path(options.surface).name}."] if options.surface else []
    lines += [f"Terrain model: {Path(options.terrain).name}."] if options.terrain else []
    lines += [f"Photos: {used}."] if used else []
    write_text(page, city_page(out.name, [" ".join(lines)], buildings, left_out, reported))
    return {
        "written": str(out),
        "page": str(page),
        "buildings": len(buildings),
        "photos": used,
        "crs": model.crs,
        "heights_from": dict(Counter(each.height_from for each in buildings).most_common()),
        "grounds_from": dict(Counter(each.ground_from for each in buildings).most_common()),
        "left_out": {why: len(names) for why, names in left_out.items()},
        "findings": counts,
        "finding_objects": conversion.findings.objects(),
    }


def _buildings(model: CityModel) -> list[MadeBuilding]:
    """Returns the buildings of a city of blocks, with the rings of their floors in the city's coordinates."""
    polygons, objects = model.polygons, model.objects
    rings: dict[int, list[Any]] = defaultdict(list)
    ground_m = np.full(len(model.building_ids), np.nan)
    for n in np.flatnonzero(polygons.kind == SurfaceKind.GROUND).tolist():
        building, first = int(polygons.building[n]), polygons.polygon_starts[n]
        starts = polygons.ring_starts[first : polygons.polygon_starts[n + 1] + 1]
        rings[building] += [
            polygons.points[start:end, :2] + model.origin[:2] for start, end in pairwise(starts.tolist())
        ]
        ground_m[building] = polygons.points[starts[0], 2] + model.origin[2]
    attributes = () if objects is None else objects.attributes
    return [
        MadeBuilding(
            name,
            float(reported["measuredHeight"]),
            float(ground),
            reported["height_from"],
            reported["ground_from"],
            rings[n],
            reported.get("height_sigma_m"),
        )
        for n, (name, ground, reported) in enumerate(
            zip(model.building_ids, ground_m.tolist(), attributes, strict=True)
        )
    ]


# Rows of the table of buildings: a browser sorts them in a moment. The city file has all.
_MAX_ROWS = 3000


class MadeBuilding(NamedTuple):
    """A building of a city that was made.

    Attributes:
        name: Its id.
        height_m: Above the ground.
        ground_m: Height of the ground.
        height_from, ground_from: What gave them, in words.
        rings: (N, 2) east and north each, of its outline and holes.
        sigma_m: Standard deviation of the height, None where nothing says.
    """

    name: str
    height_m: float
    ground_m: float
    height_from: str
    ground_from: str
    rings: Sequence[NDArray[np.float64]]
    sigma_m: float | None = None


def city_page(
    title: str,
    lines: Sequence[str],
    buildings: Sequence[MadeBuilding],
    left_out: Mapping[str, Sequence[str]],
    findings: Sequence[tuple[str, int, str]],
) -> str:
    """Returns the page as HTML.

    Args:
        title: Its heading.
        lines: What it was made from, a sentence each.
        buildings: Those of the city.
        left_out: Ids of footprints that are not in it, by why.
        findings: Code and name, how often, and what each kind means.
    """
    sources = sorted(
        {each.height_from for each in buildings}, key=lambda name: (name != "surface model", name)
    )
    by_source = {name: [each for each in buildings if each.height_from == name] for name in sources}
    groups = {
        name: [Marked(f"{each.name}: {each.height_m:.1f} m, {name}", each.rings) for each in of_source]
        for name, of_source in by_source.items()
    }
    rows = [
        (
            name,
            len(own),
            *(f"{value:.1f}" for value in np.percentile([b.height_m for b in own], (5, 50, 95))),
            _median([b.sigma_m for b in own if b.sigma_m is not None]),
        )
        for name, own in by_source.items()
    ]
    # Those that no surface model measured are to be looked at first.
    order = sorted(buildings, key=lambda each: (each.height_from == "surface model", each.name))
    return rendered(
        "city.html.jinja",
        title=title,
        lines=lines,
        map=markup(draw_plan(groups)),
        rows=rows,
        left_out=[(why, len(names), ", ".join(names[:5])) for why, names in left_out.items()],
        buildings=order[:_MAX_ROWS],
        count=len(buildings),
        findings=findings,
    )


def _median(sigmas_m: Sequence[float]) -> str:
    return f"{np.median(sigmas_m):.2f}" if sigmas_m else ""
