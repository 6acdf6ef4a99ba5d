"""A surface model as a city: what rises above the ground, in plane pieces with walls, as level 2."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import SURFACE_NO_DATUM, SURFACE_PLANTS, SURFACE_SIMPLIFIED
from lodbench.citymodel.crs import resolve_crs
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.raw import GrowingArray, NotACity, RawCity, starts_of
from lodbench.citymodel.surface.files import open_surface
from lodbench.citymodel.surface.grid import Span, SurfaceGrid
from lodbench.citymodel.surface.ground import find_ground
from lodbench.citymodel.surface.orthophoto import green_of
from lodbench.citymodel.surface.regions import LEAST_RISE_M, TOLERANCE_M, RegionCounts, windows_of
from lodbench.citymodel.surface.solids import solids_of
from lodbench.findings import Findings


def read_surface(path: Path, source: str, options: ReadOptions) -> RawCity:
    """Returns what rises above the ground of a surface model as buildings of level 2.

    A building is a connected region, less what is taken as vegetation, parted at steps of 1.5 m; its id is
    the row and column of its first cell. The surface is read block by block, twice.

    Args:
        path: GeoTIFF, ASCII grid, LAS, LAZ, or a folder of tiles.
        source: Name for messages.
        options: ``crs``, ``terrain``, ``orthophoto``.

    Raises:
        CityModelError: It cannot be read, or has no height.
        NotACity: Nothing rises above the ground.
    """
    grid = open_surface(path, options.crs)
    return surface_city(grid, source, options, green_of(grid, options))


def surface_city(
    grid: SurfaceGrid,
    source: str,
    options: ReadOptions,
    is_green: Callable[[Span, Span], NDArray[np.bool_]] | None = None,
) -> RawCity:
    """Returns what rises above the ground of a grid; see ``read_surface``.

    Args:
        grid: Heights.
        source: Name for messages.
        options: ``terrain``.
        is_green: Tells which cells of two spans are green; None where no orthophoto says so.

    Raises:
        CityModelError: The grid has no height.
        NotACity: Nothing rises above the ground.
    """
    findings, counts = Findings(), RegionCounts()
    ground = find_ground(grid, options, findings)
    columns: dict[str, GrowingArray] = {
        "points": GrowingArray(np.float64, (3,)),
        "ring_lengths": GrowingArray(np.int64),
        "ring_counts": GrowingArray(np.int64),
        "building": GrowingArray(np.int32),
        "kind": GrowingArray(np.uint8),
    }
    ids: list[str] = []
    for window in windows_of(grid, ground, counts, is_green):
        solids = solids_of(window)
        if solids is None:
            continue
        place = solids.points[:, :2] + window.corner[::-1]
        z = solids.points[:, 2:] / grid.height_unit_m
        columns["points"].extend(np.hstack([grid.places(place[:, 0], place[:, 1]), z]))
        columns["ring_lengths"].extend(solids.ring_lengths)
        columns["ring_counts"].extend(solids.ring_counts)
        columns["building"].extend(solids.building + len(ids))
        columns["kind"].extend(solids.kind)
        ids += [f"r{row}c{column}" for row, column in solids.first.tolist()]
    if not ids:
        raise NotACity(
            f"Nothing in {source} rises {LEAST_RISE_M:g} m above the ground.", "Is it a terrain model?"
        )
    _tell(grid, counts, findings)
    found = {name: column.finish() for name, column in columns.items()}
    count = len(found["kind"])
    return RawCity(
        source=source,
        format="surface model",
        srs_names=(grid.crs,),
        building_ids=tuple(ids),
        lods=("2",),
        points=found["points"],
        ring_starts=starts_of(found["ring_lengths"]),
        polygon_starts=starts_of(found["ring_counts"]),
        building=found["building"],
        lod=np.zeros(count, np.int16),
        kind=found["kind"],
        srs=np.zeros(count, np.int16),
        findings=findings,
        axis_orders=("east_first",),
    )


def _tell(grid: SurfaceGrid, counts: RegionCounts, findings: Findings) -> None:
    known = None if grid.crs is None else resolve_crs(grid.crs)
    if known is not None and known.vertical_code is None and not known.has_ellipsoidal_heights:
        findings.add(SURFACE_NO_DATUM, "", known.label)
    if counts.plants:
        findings.add(SURFACE_PLANTS, "", f"{counts.plants:,} patches, {counts.plants_m2:,.0f} m2")
    far = 100.0 * counts.far / max(counts.cells, 1)
    cut = f"; {counts.cut} long regions are cut where blocks end" if counts.cut else ""
    findings.add(
        SURFACE_SIMPLIFIED,
        "",
        f"{100 - far:.1f} % of {counts.cells:,} cells within {TOLERANCE_M:g} m of their plane{cut}",
    )
