"""Photos with known poses that measure the roofs over footprints, and the city with these heights."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import HEIGHT_DEFAULTED, HEIGHT_MISSING
from lodbench.citymodel.meshing import mesh_model
from lodbench.citymodel.model import CityModel
from lodbench.citymodel.subset import choose_buildings
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.own import find_photo
from lodbench.datasets.pose_files import brought, read_pose_file
from lodbench.datasets.pose_text import FoundPose
from lodbench.datasets.published.own_layout import without_lens
from lodbench.datasets.query import Entry, Query
from lodbench.errors import CityModelError, DatasetError
from lodbench.findings import Finding, Findings
from lodbench.harness.export.localized import is_localized, read_localized_folder
from lodbench.methods.flight.footprint_heights import SweptHeight, footprint_heights
from lodbench.reporting.answers import is_trusted

# What `height_from` says of the two kinds that matter here.
BY_SURFACE, BY_DEFAULT, BY_PHOTOS = "surface model", "default_height_m", "photos"
# Fewer photos compare nothing.
_FEWEST = 3


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
        if item.code not in (HEIGHT_DEFAULTED, HEIGHT_MISSING):
            yield item
        elif item.object_id not in measured:
            yield item if keeps_default else replace(item, code=HEIGHT_MISSING)


def posed_photos(
    photos: Path, poses: Path | None, crs: str | None, origin: NDArray[np.float64]
) -> list[Query]:
    """Returns photos as pinholes with their poses in a city's local frame.

    Args:
        photos: See ``with_photo_heights``.
        poses: Likewise.
        crs: Of the city.
        origin: (3,) of the city's local frame.

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
    found = [
        FoundPose(each.key, str(folder), dataset.truth[each.key], each.camera, dataset.crs)
        for each in dataset.entries
        if each.key in dataset.truth
    ]
    files = {each.key: each.image for each in dataset.entries}
    return _entries(found, files, crs)


def _of_folder(folder: Path, poses: Path, crs: str | None) -> list[Entry]:
    if is_localized(poses):
        solved = read_localized_folder(poses)
        cameras = {entry.key: entry.camera for entry in solved.dataset.entries} if solved.dataset else {}
        answers = solved.run.predictions
        found = [
            FoundPose(key.partition("/")[2], str(poses), each.pose, cameras.get(key), solved.crs)
            for key, each in answers.items()
            if each.pose is not None and is_trusted(each.probability, each.score, each.mask_png != "")
        ]
    else:
        found = read_pose_file(poses, "auto")[1]
    files = {each.name: find_photo(folder, each.name) for each in found}
    return _entries(found, files, crs)


def _entries(found: list[FoundPose], files: Mapping[str, Path | None], crs: str | None) -> list[Entry]:
    """Returns the photos that have a file and a camera, with their poses in the city's coordinates."""
    whole = [each for each in found if each.camera is not None and files.get(each.name) is not None]
    return [
        Entry(each.name.replace("/", "_"), "photos", each.camera, each.pose, files[each.name], None)
        for each in brought(whole, crs)[0]
    ]
