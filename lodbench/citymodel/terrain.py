"""Ground heights from a raster terrain model: ESRI ASCII grids, and through rasterio what GDAL reads."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.options import ReadOptions
from lodbench.errors import CityModelError

_MAX_CELLS = 1 << 30


@dataclass(frozen=True, slots=True, eq=False)
class Terrain:
    """Heights on a grid.

    Attributes:
        heights_m: (rows, columns) float64, north to south; NaN where there is none.
        west, north: Outer corner of the first cell.
        cell_x, cell_y: Size of a cell, both positive.
        crs: Reference system of the grid, or None where the file names none.
    """

    heights_m: NDArray[np.float64]
    west: float
    north: float
    cell_x: float
    cell_y: float
    crs: str | None

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns (N,) heights at points (N, 2): those of the cells they lie in, NaN outside."""
        rows, columns = self.heights_m.shape
        column = np.floor((points[:, 0] - self.west) / self.cell_x)
        row = np.floor((self.north - points[:, 1]) / self.cell_y)
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        heights = np.full(len(points), np.nan)
        heights[inside] = self.heights_m[row[inside].astype(int), column[inside].astype(int)]
        return heights


def ground_under(points: NDArray[np.float64], crs: str, options: ReadOptions) -> NDArray[np.float64]:
    """Returns (N,) terrain heights under points given as easting or longitude first.

    Args:
        points: (N, 2) in ``crs``.
        crs: Their reference system.
        options: ``terrain`` names the raster.

    Raises:
        CityModelError: The raster cannot be read.
    """
    from pyproj import Transformer

    terrain = read_terrain(str(options.terrain))
    if terrain.crs is not None and terrain.crs != crs:
        transformer = Transformer.from_crs(crs, terrain.crs, always_xy=True)
        points = np.stack(transformer.transform(points[:, 0], points[:, 1]), axis=1)
    return terrain.at(points)


def read_terrain(path: str) -> Terrain:
    """Returns a terrain model.

    Raises:
        CityModelError: The file is missing or malformed, or rasterio is needed and not installed.
    """
    if not Path(path).is_file():
        raise CityModelError(f"There is no terrain model at {path}.", "Check the path.")
    if path.lower().endswith(".asc"):
        return _read_ascii(Path(path))
    try:
        import rasterio
    except ImportError:
        raise CityModelError(
            f"Reading {path} needs rasterio.", "Install it, or convert the raster to an ASCII grid (.asc)."
        ) from None
    try:
        with rasterio.open(path) as raster:
            heights = raster.read(1, masked=True).astype(np.float64).filled(np.nan)
            step = raster.transform
            crs = raster.crs.to_string() if raster.crs else None
    except rasterio.errors.RasterioError as error:
        raise CityModelError(
            f"{path} cannot be read as a raster: {error}.",
            "Try to open it in a GIS, or convert it to GeoTIFF.",
        ) from None
    return Terrain(heights, step.c, step.f, step.a, -step.e, crs)


def _read_ascii(path: Path) -> Terrain:
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
            stream.seek(position)
            heights = np.array(stream.read().split(), dtype=np.float64).reshape(shape)
    except (OSError, ValueError, KeyError) as error:
        raise CityModelError(
            f"{path} is no ASCII grid ({error}).", "It begins with ncols and nrows."
        ) from None
    heights[heights == header.get("nodata_value", -9999.0)] = np.nan
    size = header.get("cellsize", 1.0)
    half = 0.5 * size
    west = header.get("xllcorner", header.get("xllcenter", 0.0) - half)
    south = header.get("yllcorner", header.get("yllcenter", 0.0) - half)
    return Terrain(heights, west, south + shape[0] * size, size, size, None)
