"""Ground heights from a raster terrain model: ESRI ASCII grids, and through rasterio what GDAL reads."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import BASE_MOVED, GROUND_DEFAULTED, HEIGHT_NO_DATA, OPTION_UNUSED
from lodbench.citymodel.crs import resolve_crs
from lodbench.citymodel.model import TALLEST_M, Polygons
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.raw import RawCity
from lodbench.citymodel.vector.gdal import opened_raster, raster_driver
from lodbench.errors import CityModelError
from lodbench.findings import Findings

_MAX_CELLS = 1 << 30
# No land lies lower or higher, metres: what does is a mark for cells where nobody measured, -9999 mostly.
LOWEST_M, HIGHEST_M = -500.0, 9000.0
# What bands of rasters call their unit, metres; where they do not, it is that of their reference system.
_UNITS_M = {
    "m": 1.0, "metre": 1.0, "meter": 1.0, "metres": 1.0, "meters": 1.0, "ft": 0.3048, "foot": 0.3048,
    "feet": 0.3048, "us survey foot": 1200 / 3937, "us-ft": 1200 / 3937, "ftus": 1200 / 3937,
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Terrain:
    """Heights on a grid.

    Attributes:
        heights: (rows, columns) float64, north to south, in the raster's unit; NaN where there is none.
        west, north: Outer corner of the first cell.
        cell_x, cell_y: Size of a cell, both positive.
    """

    heights: NDArray[np.float64]
    west: float
    north: float
    cell_x: float
    cell_y: float

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns (N,) heights at points (N, 2): those of the cells they lie in, NaN outside."""
        rows, columns = self.heights.shape
        column = np.floor((points[:, 0] - self.west) / self.cell_x)
        row = np.floor((self.north - points[:, 1]) / self.cell_y)
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        heights = np.full(len(points), np.nan)
        heights[inside] = self.heights[row[inside].astype(int), column[inside].astype(int)]
        return heights


def ground_under(points: NDArray[np.float64], crs: str, options: ReadOptions) -> NDArray[np.float64]:
    """Returns (N,) terrain heights under points given as easting or longitude first; NaN where there is none.

    Args:
        points: (N, 2) in ``crs``.
        crs: Their reference system, in whose unit of height the answer is; that of an ASCII grid, too.
        options: ``terrain`` names the raster.

    Raises:
        CityModelError: The raster cannot be read.
    """
    path = Path(str(options.terrain))
    if not path.is_file():
        raise CityModelError(f"There is no terrain model at {path}.", "Check the path.")
    unit_m = height_unit_m(crs)
    if path.suffix.lower() == ".asc":
        heights_m = read_ascii(path).at(points) * unit_m
    else:
        heights_m = _raster_heights_m(path, points, crs)
    return np.where((heights_m > LOWEST_M) & (heights_m < HIGHEST_M), heights_m / unit_m, np.nan)


def height_unit_m(crs: str | None) -> float:
    """Returns metres per unit of height of a reference system; 1 for one that is not known."""
    known = None if crs is None else resolve_crs(crs)
    return 1.0 if known is None else known.height_unit_m


def _raster_heights_m(path: Path, points: NDArray[np.float64], crs: str) -> NDArray[np.float64]:
    """Returns (N,) heights of a raster in metres; only the part of it under the points is read."""
    instead = "Or convert the raster to an ASCII grid (.asc)."
    with opened_raster(path, raster_driver(path), instead) as raster:
        grid = empty_grid(raster.transform, path)
        own_crs = crs if raster.crs is None else raster.crs.to_wkt()
        if raster.crs is not None:
            points = _projected(points, crs, own_crs)
        rows, columns = _window(grid, points, raster.shape)
        if (rows[1] - rows[0]) * (columns[1] - columns[0]) > _MAX_CELLS:
            raise CityModelError(f"{path} has too many cells under the city.", "Warp it to larger cells.")
        heights_m = read_band_m(raster, own_crs, rows, columns)
    part = replace(
        grid,
        heights=heights_m,
        west=grid.west + columns[0] * grid.cell_x,
        north=grid.north - rows[0] * grid.cell_y,
    )
    return part.at(points)


def read_band_m(
    raster: Any, crs: str | None, rows: tuple[int, int], columns: tuple[int, int]
) -> NDArray[np.float64]:
    """Returns a window of a raster's first band as heights in metres, NaN where there is none.

    Scale and offset of the band count; so does its unit, and where it names none that of the system.

    Args:
        raster: As ``opened_raster`` yields it.
        crs: Its reference system.
        rows: First and last (not included).
        columns: Likewise.
    """
    unit_m = _UNITS_M.get(str(raster.units[0]).strip().lower()) or height_unit_m(crs)
    band = raster.read(1, window=(rows, columns), masked=True)
    heights: NDArray[np.float64] = band.astype(np.float64).filled(np.nan)
    heights_m: NDArray[np.float64] = (heights * raster.scales[0] + raster.offsets[0]) * unit_m
    return heights_m


def empty_grid(step: Any, path: Path) -> Terrain:
    """Returns the place and the cells of a raster, without heights, by its affine transform.

    Raises:
        CityModelError: It has none, or is turned.
    """
    if step.is_identity:
        raise CityModelError(
            f"The raster {path} does not say where it lies; a world file beside it is not read.",
            "Put its place into it: gdal_translate -of GTiff FILE PLACED.tif",
        )
    if step.b or step.d or step.e >= 0:
        raise CityModelError(f"The raster {path} is turned.", "Warp it to north up (gdalwarp).")
    return Terrain(np.zeros((0, 0)), step.c, step.f, step.a, -step.e)


def _projected(points: NDArray[np.float64], crs: str, target: str) -> NDArray[np.float64]:
    from pyproj import Transformer

    transformer = Transformer.from_crs(crs, target, always_xy=True)
    return np.stack(transformer.transform(points[:, 0], points[:, 1]), axis=1)


def _window(
    grid: Terrain, points: NDArray[np.float64], shape: tuple[int, int]
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Returns the first and last rows and columns of a grid that hold all the points it covers."""
    finite = points[np.isfinite(points).all(axis=1)]
    columns = np.floor((finite[:, 0] - grid.west) / grid.cell_x)
    rows = np.floor((grid.north - finite[:, 1]) / grid.cell_y)
    is_inside = (rows >= 0) & (rows < shape[0]) & (columns >= 0) & (columns < shape[1])
    if not is_inside.any():
        return (0, 1), (0, 1)
    rows, columns = rows[is_inside].astype(int), columns[is_inside].astype(int)
    return (int(rows.min()), int(rows.max()) + 1), (int(columns.min()), int(columns.max()) + 1)


def read_ascii(path: Path) -> Terrain:
    """Returns an ESRI ASCII grid; its reference system is taken to be that of the footprints."""
    header: dict[str, float] = {}
    try:
        with path.open(encoding="ascii") as stream:
            position = 0
            while (line := stream.readline()).split()[:1] and line.split()[0][0].isalpha():
                name, value = line.split()[:2]
                header[name.lower()] = float(value)
                position = stream.tell()
            shape = int(header["nrows"]), int(header["ncols"])
            if not 0 < shape[0] * shape[1] <= _MAX_CELLS:
                raise ValueError("the size is out of range")
            cells = [header.get(name) or header["cellsize"] for name in ("dx", "dy")]
            placing = [value for name, value in header.items() if name != "nodata_value"]
            if not all(map(math.isfinite, placing)) or min(cells) <= 0:
                raise ValueError("its place is not finite, or its cells have no size")
            stream.seek(position)
            heights = np.array(stream.read().split(), dtype=np.float64).reshape(shape)
    except (OSError, ValueError, KeyError, OverflowError) as error:
        raise CityModelError(
            f"{path} is no ASCII grid ({error}).", "It begins with ncols and nrows."
        ) from None
    heights[heights == header.get("nodata_value", -9999.0)] = np.nan
    width, height = cells
    west = header.get("xllcorner", header.get("xllcenter", 0.0) - 0.5 * width)
    south = header.get("yllcorner", header.get("yllcenter", 0.0) - 0.5 * height)
    return Terrain(heights, west, south + shape[0] * height, width, height)


# What formats of footprints alone are read by, and what sets buildings on the ground where that is requested.
_FOOTPRINTS = ("footprints", "surfaces")
_OF_FOOTPRINTS = (
    "layer", "height_column", "storeys_column", "storey_height_m", "ground_column", "default_height_m",
)  # fmt: skip
_OF_GROUND = ("ground_m", "terrain")
# What has its heights in z, whatever is requested.
_UPRIGHT = (*_FOOTPRINTS, "CityGML", "CityJSON", "CityJSONSeq")


def tell_unused(format: str, options: ReadOptions, findings: Findings) -> None:
    """Adds a finding for every option that was given and that a city of this format does not hear."""
    unheard = {}
    if format not in _FOOTPRINTS:
        unheard = {name: f"{name}: it is of footprints" for name in _OF_FOOTPRINTS}
        if options.base != "ground":
            unheard |= {name: f"{name}: base=ground sets buildings on the ground" for name in _OF_GROUND}
    if format in _UPRIGHT:
        unheard["up_axis"] = "up_axis: it is of meshes"
    if not format.startswith("City"):
        unheard["date"] = "date: it is of CityGML and CityJSON"
    usual = ReadOptions()
    for name, why in unheard.items():
        if getattr(options, name) != getattr(usual, name):
            findings.add(OPTION_UNUSED, "", why)


def move_bases(
    polygons: Polygons,
    building_ids: tuple[str, ...],
    label: str | None,
    options: ReadOptions,
    findings: Findings,
) -> None:
    """Moves the bottoms of buildings, in place, as ``options.base`` says.

    ``ground`` adds the terrain height under each building's middle (or ``ground_m``) to all its
    heights: for sources such as Open City Model whose buildings all stand at 0. ``sunk`` lifts
    everything within ``sunk_m`` of a building's lowest point to that height: for sources such as
    swissBUILDINGS3D whose walls reach below the terrain.

    Args:
        polygons: In metres, not yet in the local frame.
        building_ids: For the findings.
        label: Reference system of the points.
        options: What to do.
        findings: Receives what was done, and buildings outside the terrain.
    """
    points = polygons.points
    if options.base == "as_given" or len(points) == 0:
        return
    building = np.repeat(polygons.building, np.diff(polygons.ring_starts[polygons.polygon_starts]))
    count = len(building_ids)
    if options.base == "sunk":
        lowest = np.full(count, np.inf)
        np.minimum.at(lowest, building, points[:, 2])
        points[:, 2] = np.maximum(points[:, 2], lowest[building] + options.sunk_m)
        detail = f"walls cut {options.sunk_m:g} m above their lowest point"
    else:
        heights = np.full(count, options.ground_m)
        if options.terrain is not None and label is not None:
            sizes = np.maximum(np.bincount(building, minlength=count), 1)
            middles = np.stack(
                [np.bincount(building, points[:, k], minlength=count) / sizes for k in (0, 1)], axis=1
            )
            found = ground_under(middles, label, options)
            for b in np.flatnonzero(~np.isfinite(found)):
                findings.add(GROUND_DEFAULTED, building_ids[b], f"ground_m={options.ground_m:g}")
            heights = np.where(np.isfinite(found), found, options.ground_m)
        points[:, 2] += heights[building]
        detail = f"set on {options.terrain or f'{options.ground_m:g} m'}"
    findings.add(BASE_MOVED, "", detail)


Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]


def mend_heights(polygons: Polygons, raw: RawCity, label: str | None) -> None:
    """Puts corners at impossible heights on the ground near them, in place; each building is a finding.

    Impossible is what lies below or above all land, and of a building taller than any the end that is further
    from the heights of the others. The ground is the lowest corner of the nearest building without such
    corners, else the lowest other corner of its own. Where all heights are impossible, their unit or zero is
    another: they stay, and so do those of meshes without a reference system.

    Args:
        polygons: In metres, heights above the sea or the ellipsoid, or of a local frame.
        raw: Names of the buildings, and what they are; its findings grow.
        label: Reference system of the points.
    """
    is_mesh = raw.lods == ("",)
    if len(polygons) == 0 or (is_mesh and label is None):
        return
    z = polygons.points[:, 2]
    lowest_m, highest_m = z.min(), z.max()
    if LOWEST_M < lowest_m and highest_m < HIGHEST_M and highest_m - lowest_m <= TALLEST_M:
        return
    point_polygon = np.repeat(
        np.arange(len(polygons)), np.diff(polygons.ring_starts[polygons.polygon_starts])
    )
    building = polygons.building[point_polygon]
    is_off = ~((z > LOWEST_M) & (z < HIGHEST_M))
    if is_off.all():
        return
    if not is_mesh:  # whose pieces may be mountains
        level = building * (int(polygons.lod.max()) + 1) + polygons.lod[point_polygon]
        is_off |= _wrong_ends(z, level, is_off) & _are_buildings(raw)[building]
    if not is_off.any():
        return
    count = len(raw.building_ids)
    lowest = np.full(count, np.inf)
    np.minimum.at(lowest, building[~is_off], z[~is_off])
    is_hurt = np.zeros(count, np.bool_)
    is_hurt[building[is_off]] = True
    ground = _ground_near(polygons.points, building, lowest, is_hurt)
    order = np.flatnonzero(is_off)
    for number, first in zip(*np.unique(building[order], return_index=True), strict=True):
        own, place = z[order[building[order] == number]], polygons.points[order[first]].copy()
        which = f"{own.min():.10g}" if np.ptp(own) == 0 else f"{own.min():.10g} to {own.max():.10g}"
        detail = f"{len(own)} corners at {which} m, put at {ground[number]:.2f} m"
        east, north, up = place.tolist()
        raw.findings.add(HEIGHT_NO_DATA, raw.building_ids[number], detail, place=(east, north, up))
    z[is_off] = ground[building[is_off]]


def _are_buildings(raw: RawCity) -> Flags:
    """Returns which of a city's objects are buildings, and no terrain or bridge."""
    is_building = np.ones(len(raw.building_ids), np.bool_)
    if raw.objects is not None:
        for number in np.flatnonzero(raw.objects.parents < 0).tolist():
            is_building[raw.objects.building[number]] = "Building" in raw.objects.types[number]
    return is_building


def _wrong_ends(z: Floats, group: NDArray[np.integer], is_off: Flags) -> Flags:
    """Returns which heights are the wrong end of a building, a group, that is taller than any.

    Without another one to compare with it is the lower end: the ground is more often lost than the roof.
    """
    numbers, place = np.unique(group, return_inverse=True)
    low, high = np.full(len(numbers), np.inf), np.full(len(numbers), -np.inf)
    np.minimum.at(low, place[~is_off], z[~is_off])
    np.maximum.at(high, place[~is_off], z[~is_off])
    is_tall = high - low > TALLEST_M
    is_sound = ~is_tall[place] & ~is_off
    middle = float(np.median(z[is_sound])) if is_sound.any() else np.inf
    is_low_end = np.abs(low - middle) >= np.abs(high - middle) if is_sound.any() else is_tall
    half = 0.5 * (low + np.where(is_tall, high, low))
    is_wrong: Flags = is_tall[place] & np.where(is_low_end[place], z < half[place], z > half[place])
    return is_wrong


def _ground_near(points: Floats, building: NDArray[np.integer], lowest: Floats, is_hurt: Flags) -> Floats:
    """Returns (B,) the lowest corner of each building; of the hurt ones that of the nearest that is sound."""
    from scipy.spatial import cKDTree

    sizes = np.maximum(np.bincount(building, minlength=len(lowest)), 1)
    middles = np.stack(
        [np.bincount(building, points[:, k], minlength=len(lowest)) / sizes for k in (0, 1)], axis=1
    )
    ground = np.where(np.isfinite(lowest), lowest, 0.0)
    sound = np.flatnonzero(~is_hurt & np.isfinite(lowest))
    hurt = np.flatnonzero(is_hurt)
    if len(sound):
        ground[hurt] = lowest[sound[cKDTree(middles[sound]).query(middles[hurt])[1]]]
    elif np.isfinite(lowest).any():
        ground[hurt] = np.where(np.isfinite(lowest[hurt]), lowest[hurt], lowest.min())
    return ground
