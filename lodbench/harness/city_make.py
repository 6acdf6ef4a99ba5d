"""A city made of footprints: as high as a surface model, photos or attributes say, and a page of it."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel import codes
from lodbench.citymodel.convert import convert_city
from lodbench.citymodel.derive import choose_buildings
from lodbench.citymodel.model import CityModel, SurfaceKind
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.read import mesh_model, read_city_model
from lodbench.citymodel.source import open_sources
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.own import find_photo
from lodbench.datasets.pose_files import brought, read_pose_file
from lodbench.datasets.pose_text import FoundPose
from lodbench.datasets.published.own_layout import without_lens
from lodbench.datasets.query import Entry, Query
from lodbench.errors import CityModelError, DatasetError
from lodbench.findings import Finding, Findings
from lodbench.harness.photo.localized import is_localized, read_localized_folder
from lodbench.methods.flight.roof_sweep import SweptHeight, footprint_heights
from lodbench.reporting.answers import is_trusted
from lodbench.reporting.maps import Marked, draw_plan
from lodbench.reporting.page import markup, rendered
from lodbench.storage import write_text

# Why a footprint is in no city, by its finding.
_LEFT_OUT = {
    codes.HEIGHT_MISSING: "no height",
    codes.UNDERGROUND: "below the ground",
    codes.GEOMETRY_EMPTY: "no area",
}
# Blocks are this high until photos measure them, metres.
_DEFAULT_M = 9.0
# Rows of the table of buildings: a browser sorts them in a moment. The city file has all.
_MAX_ROWS = 3000
# What `height_from` says of the two kinds that matter here.
BY_SURFACE, BY_DEFAULT, BY_PHOTOS = "surface model", "default_height_m", "photos"
# Fewer photos compare nothing.
_FEWEST = 3


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
    meanings = {str(code): code.meaning for code in codes.finding_catalogue()}
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


class MadeBuilding(NamedTuple):
    """A building of a city that was made."""

    name: str  # its id
    height_m: float  # above the ground
    ground_m: float  # height of the ground
    height_from: str  # what gave it, in words
    ground_from: str  # likewise
    rings: Sequence[NDArray[np.float64]]  # (N, 2) east and north each, of its outline and holes
    sigma_m: float | None = None  # standard deviation of the height, None where nothing says


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


def with_photo_heights(
    model: CityModel, photos: Path, poses: Path | None, *, keeps_default: bool
) -> tuple[CityModel, int]:
    """Returns a city of blocks as high as photos measure them, and how many photos that were.

    Heights of a surface model stay; all others are replaced where photos measure them. Attributes then are
    ``height_from``, ``height_sigma_m`` and ``height_photos``.

    Args:
        model: Blocks with details; those that nothing else gives a height with a default one.
        photos: A dataset with true poses in the text layout, or a folder of photos.
        poses: Of such a folder: what ``localize`` wrote, or a file of poses with cameras; None for a dataset.
        keeps_default: Whether buildings that have only the default height stay.

    Raises:
        DatasetError: Photos, poses or cameras cannot be read, or fewer than three photos have them.
        CityModelError: No building is left.
    """
    queries = posed_photos(photos, poses, model.crs, model.origin)
    swept = footprint_heights(queries, mesh_model(model, "finest").scene)
    objects = model.objects
    attributes = [] if objects is None else [dict(each) for each in objects.attributes]
    kept = {row: height for row, height in swept.items() if attributes[row]["height_from"] != BY_SURFACE}
    points = _raised(model, kept, attributes)
    unknown = [n for n, each in enumerate(attributes) if each["height_from"] == BY_DEFAULT]
    measured_ids = {model.building_ids[row] for row in kept}
    findings = Findings(list(_findings(model.findings, measured_ids, keeps_default)))
    model = replace(
        model,
        polygons=replace(model.polygons, points=points),
        objects=None if objects is None else replace(objects, attributes=tuple(attributes)),
        findings=findings,
    )
    if unknown and not keeps_default:
        lost = {model.building_ids[n] for n in unknown}
        ids = [name for name in model.building_ids if name not in lost]
        if not ids:
            raise CityModelError(
                f"The {len(queries)} photos of {photos} measure no height of the {len(lost)} footprints.",
                "Do ground heights and poses have the same zero? See ground_from in `city info`.",
            )
        model = choose_buildings(model, ids=ids)
    return model, len(queries)


def _raised(
    model: CityModel, heights: Mapping[int, SweptHeight], attributes: list[dict[str, object]]
) -> NDArray[np.float64]:
    """Returns points with buildings stretched to their heights, whose attributes are changed in place."""
    polygons = model.polygons
    points = polygons.points.copy()
    counts = np.diff(polygons.ring_starts[polygons.polygon_starts])
    owner = np.repeat(polygons.building, counts)
    order = np.argsort(owner, kind="stable")
    rows = np.split(order, np.cumsum(np.bincount(owner, minlength=len(model.building_ids)))[:-1])
    for building, swept in heights.items():
        z = points[rows[building], 2]
        floor, top = z.min(), z.max()
        points[rows[building], 2] = floor + (z - floor) * (swept.height_m / (top - floor))
        known = attributes[building]
        higher = swept.height_m - float(top - floor)
        known["measuredHeight"] = round(float(str(known["measuredHeight"])) + higher, 3)
        known["height_from"] = BY_PHOTOS
        known["height_sigma_m"] = round(swept.sigma_m, 2)
        known["height_photos"] = swept.photos
    return points


def _findings(findings: Findings, measured: set[str], keeps_default: bool) -> Iterator[Finding]:
    """Yields findings: of measured buildings none about heights, of others that theirs is missing."""
    for item in findings.items:
        if item.code not in (codes.HEIGHT_DEFAULTED, codes.HEIGHT_MISSING):
            yield item
        elif item.object_id not in measured:
            yield item if keeps_default else replace(item, code=codes.HEIGHT_MISSING)


def posed_photos(
    photos: Path, poses: Path | None, crs: str | None, origin: NDArray[np.float64]
) -> list[Query]:
    """Returns photos as pinholes with their poses in a city's local frame, whose origin is (3,).

    Raises:
        DatasetError: See ``with_photo_heights``.
    """
    entries = _of_dataset(photos, crs) if poses is None else _of_folder(photos, poses, crs)
    if len(entries) < _FEWEST:
        raise DatasetError(
            f"{len(entries)} photos of {photos} have a file, a pose and a camera; roofs need three.",
            "Name what localize wrote, or a file of poses with cameras, as `--poses`.",
        )
    anywhere = np.ones((1, 1), np.float32)
    return [
        Query(each.name, each.split, each.camera, each.prior.shifted(-origin), anywhere, each.image)
        for each in without_lens("city-make", entries)
        if each.camera is not None and each.prior is not None
    ]


def _of_dataset(folder: Path, crs: str | None) -> list[Entry]:
    dataset = open_folder(FolderParams(str(folder), crs=crs))
    if not dataset.truth:
        raise DatasetError(
            f"{folder} has no true poses, and rough ones measure no roof.",
            "Localize the photos first, and name the folder that this writes as `--poses`.",
        )
    images = [
        FoundPose(each.key, str(folder), dataset.truth[each.key], each.camera, dataset.crs)
        for each in dataset.entries
        if each.key in dataset.truth
    ]
    files = {each.key: each.image for each in dataset.entries}
    return _posed_entries(images, files, crs)


def _of_folder(folder: Path, poses: Path, crs: str | None) -> list[Entry]:
    if is_localized(poses):
        solved = read_localized_folder(poses)
        cameras = {entry.key: entry.camera for entry in solved.dataset.entries} if solved.dataset else {}
        answers = solved.run.predictions
        images = [
            FoundPose(key.partition("/")[2], str(poses), each.pose, cameras.get(key), solved.crs)
            for key, each in answers.items()
            if each.pose is not None and is_trusted(each.probability, each.score, each.mask_png != "")
        ]
    else:
        images = read_pose_file(poses, "auto")[1]
    files = {each.name: find_photo(folder, each.name) for each in images}
    return _posed_entries(images, files, crs)


def _posed_entries(images: list[FoundPose], files: Mapping[str, Path | None], crs: str | None) -> list[Entry]:
    whole = [each for each in images if each.camera is not None and files.get(each.name) is not None]
    return [
        Entry(each.name.replace("/", "_"), "photos", each.camera, each.pose, files[each.name], None)
        for each in brought(whole, crs)[0]
    ]
