"""The orthophoto of a surface model's place: what of it is green, and a textured mesh of both."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.crs import require_crs
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.surface.grid import Floats, Span, SurfaceGrid, open_surface
from lodbench.citymodel.textures import TexturedPart, require_room
from lodbench.citymodel.vector.gdal import opened_raster
from lodbench.errors import CityModelError, ConfigError, DatasetError

# What publishers deliver orthophotos as, by the one driver that may read each.
_DRIVERS = {".tif": "GTiff", ".tiff": "GTiff", ".jp2": "JP2OpenJPEG"}
# The longer side of a picture, pixels: a page holds it as text.
_MAX_PX = 1600
# Brightness of other than 8 bits is stretched between these percentiles.
_DARKEST, _BRIGHTEST = 1.0, 99.0


@dataclass(frozen=True, slots=True)
class Imagery:
    """An orthophoto over a city, ``open_imagery`` has looked at."""

    path: Path  # its file
    crs: str | None  # reference system of the city's plane, in which pictures are; None: that of the file

    @property
    def name(self) -> str:
        """Returns the file's name."""
        return self.path.name

    def within(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Returns (H, W, 4) blue, green, red, alpha of a rectangle, north up; 0 alpha where there is nothing.

        Args:
            low: (2,) east and north of its south-western corner, in the city's coordinates.
            high: (2,) of its north-eastern corner.

        Raises:
            CityModelError: The file cannot be read any more.
        """
        from rasterio.enums import Resampling
        from rasterio.transform import from_bounds
        from rasterio.vrt import WarpedVRT

        size = np.maximum(1, np.round(_MAX_PX * (high - low) / (high - low).max())).astype(int)
        width, height = (int(side) for side in size)
        with opened_raster(self.path, orthophoto_driver(self.path)) as raster:
            is_palette = bool(raster.colorinterp[0].name == "palette")
            warp_options = {
                "crs": _own_crs(raster, self.crs),
                "src_crs": _own_crs(raster, self.crs) if raster.crs is None else raster.crs,
                "transform": from_bounds(*low, *high, width, height),
                "width": width,
                "height": height,
                "resampling": Resampling.nearest if is_palette else Resampling.average,
                "add_alpha": not raster.nodatavals[0] and not _has_alpha(raster),
            }
            with WarpedVRT(raster, **warp_options) as warped:
                bands = warped.read(_bands(raster))
                alpha = warped.dataset_mask()
            colours = _of_palette(bands[0], raster) if is_palette else _as_bytes(bands, alpha > 0)
        picture = np.repeat(colours, 3, axis=0) if len(colours) == 1 else colours
        return np.ascontiguousarray(np.stack([*picture[::-1], alpha], axis=2).astype(np.uint8))


def open_imagery(path: Path, scene: Scene) -> Imagery:
    """Returns an orthophoto that lies over a city.

    Args:
        path: GeoTIFF or JPEG 2000 with its place inside.
        scene: The city.

    Raises:
        ConfigError: There is no such file, or its ending names no format of orthophotos.
        CityModelError: rasterio is not there, the file cannot be read, does not say where it lies, has a
            reference system where the city has none, or does not cover the city.
    """
    if not path.is_file():
        raise ConfigError(f"There is no imagery at {path}.", "Check the path.")
    with opened_raster(path, orthophoto_driver(path)) as raster:
        if raster.transform.is_identity:
            raise CityModelError(
                f"The imagery {path} does not say where it lies; a world file beside it is not read.",
                "Put its place into it: gdal_translate -of GTiff FILE PLACED.tif",
            )
        if raster.crs is not None and scene.crs is None:
            raise CityModelError(
                f"The imagery {path} has a reference system, and the city model has none.",
                "Name the city's: localize --crs EPSG:..., or run dataset.crs=EPSG:... before its report.",
            )
        _require_overlap(path, raster, scene)
    return Imagery(path.resolve(), scene.crs)


def orthophoto_driver(path: Path) -> str:
    """Returns the one driver that may read an orthophoto.

    Raises:
        ConfigError: Its ending names none.
    """
    driver = _DRIVERS.get(path.suffix.lower())
    if driver is None:
        raise ConfigError(f"{path} is no orthophoto by its ending.", f"Known: {', '.join(_DRIVERS)}.")
    return driver


def _own_crs(raster: Any, crs: str | None) -> Any:
    """Returns the city's plane as rasterio has it; the raster's own, or any plane in metres, without one."""
    from pyproj import CRS
    from rasterio.crs import CRS as RasterCRS

    if crs is not None:
        return RasterCRS.from_wkt(CRS.from_user_input(crs).to_2d().to_wkt("WKT2_2019"))
    return raster.crs or RasterCRS.from_epsg(3857)


def _require_overlap(path: Path, raster: Any, scene: Scene) -> None:
    """Refuses imagery that lies elsewhere."""
    from rasterio.warp import transform_bounds

    bounds = raster.bounds
    if raster.crs is not None:
        bounds = transform_bounds(raster.crs, _own_crs(raster, scene.crs), *bounds)
    corners = (scene.vertices[:, :2].min(axis=0), scene.vertices[:, :2].max(axis=0))
    low, high = (corner + scene.origin[:2] for corner in corners)
    away = np.maximum(0.0, np.maximum(np.array(bounds[:2]) - high, low - np.array(bounds[2:])))
    away_m = float(np.hypot(*away))
    if away_m > 0.0 or not np.isfinite(away_m):
        raise CityModelError(
            f"The imagery {path} lies {away_m / 1000:,.1f} km outside the city model.",
            "Take the tile of this place, or check its reference system.",
        )


def _has_alpha(raster: Any) -> bool:
    return any(each.name == "alpha" for each in raster.colorinterp)


def _bands(raster: Any) -> list[int]:
    """Returns the bands that are shown: red, green, blue, or the first."""
    colours = raster.count - _has_alpha(raster)
    return [1, 2, 3] if colours >= 3 else [1]


def _of_palette(numbers: NDArray[Any], raster: Any) -> NDArray[np.uint8]:
    table = np.zeros((256, 3), np.uint8)
    for number, colour in raster.colormap(1).items():
        table[number] = colour[:3]
    return np.moveaxis(table[numbers], 2, 0)


def _as_bytes(bands: NDArray[Any], is_there: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Returns bands in 8 bits; others than of 8 bits are stretched, all by the same factor."""
    if bands.dtype == np.uint8 or not is_there.any():
        return bands.astype(np.uint8)
    values = bands.astype(np.float64)
    dark, bright = np.nanpercentile(values[:, is_there], (_DARKEST, _BRIGHTEST))
    scaled = np.nan_to_num((values - dark) / max(bright - dark, 1e-9))
    return np.asarray(np.clip(255.0 * scaled, 0, 255).astype(np.uint8))


# Excess green (Woebbecke et al. 1995), 2g - r - b of colours that add up to 1, of leaves and grass at least.
_GREEN = 0.06
# The mesh follows the surface within this, metres; its squares have up to so many cells a side.
_TOLERANCE_M, _WIDEST = 0.25, 32
# Cells of a piece of the mesh, a side, each with a picture of its own; the least width of a pixel, metres.
_PIECE, _PIXEL_M = 512, 0.2


def read_colours(
    path: Path, grid: SurfaceGrid, rows: Span, columns: Span, per_cell: int
) -> NDArray[np.uint8]:
    """Returns (rows, columns, 3) RGB of an orthophoto over a window of a surface model, black outside of it.

    Args:
        path: GeoTIFF or JPEG 2000 of three bands or more, of 8 bits.
        grid: The surface model.
        rows: Of the window.
        columns: Likewise.
        per_cell: Pixels a cell is wide.

    Raises:
        CityModelError: It cannot be read, has no place, or is no colour picture of 8 bits.
    """
    from rasterio.crs import CRS
    from rasterio.enums import Resampling
    from rasterio.transform import from_origin
    from rasterio.vrt import WarpedVRT

    if not path.is_file():
        raise CityModelError(f"There is no orthophoto at {path}.", "Check the path.")
    west, north = (float(value) for value in grid.places(np.array([columns[0]]), np.array([rows[0]]))[0])
    with opened_raster(path, orthophoto_driver(path)) as raster:
        if raster.count < 3 or raster.dtypes[0] != "uint8":
            raise CityModelError(
                f"The orthophoto {path} has {raster.count} bands of {raster.dtypes[0]}.",
                "Three bands of 8 bits are read: gdal_translate -ot Byte -scale.",
            )
        own = raster.crs
        if own is None and raster.transform.is_identity:
            raise CityModelError(f"The orthophoto {path} does not say where it lies.", "Give it a place.")
        plane = own if grid.crs is None else CRS.from_wkt(require_crs(grid.crs).horizontal.to_wkt())
        warp_options = {
            "crs": plane, "src_crs": plane if own is None else own,
            "transform": from_origin(west, north, grid.cell[0] / per_cell, grid.cell[1] / per_cell),
            "width": per_cell * (columns[1] - columns[0]), "height": per_cell * (rows[1] - rows[0]),
            "resampling": Resampling.average,
        }  # fmt: skip
        with WarpedVRT(raster, **warp_options) as warped:
            return np.ascontiguousarray(np.moveaxis(warped.read([1, 2, 3]), 0, 2))


def green_of(grid: SurfaceGrid, options: ReadOptions) -> Callable[[Span, Span], NDArray[np.bool_]] | None:
    """Returns what tells which cells of two spans are green in ``options.orthophoto``; None without one."""
    if options.orthophoto is None:
        return None
    path = Path(options.orthophoto)

    return lambda rows, columns: are_green(read_colours(path, grid, rows, columns, 1))


def are_green(colours: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Returns which of (..., 3) RGB colours are of leaves and grass."""
    red, green, blue = np.moveaxis(colours.astype(np.float32), -1, 0)
    return np.asarray((2.0 * green - red - blue) / np.maximum(red + green + blue, 1.0) > _GREEN)


def textured_parts(path: Path, options: ReadOptions) -> list[TexturedPart]:
    """Returns a surface model under its orthophoto, ground and trees too, in its own coordinates.

    Squares of one to 32 cells, each within 0.25 m of the surface, as large as that allows; where squares of
    two sizes meet, gaps of less than that stay.

    Args:
        path: The surface model.
        options: ``orthophoto``, ``crs``.

    Raises:
        DatasetError: No orthophoto is named, or it has too many pixels.
        CityModelError: A file cannot be read.
    """
    if options.orthophoto is None:
        raise DatasetError(f"{path} has heights alone, no colours.", "Add source.options.orthophoto=FILE.")
    grid = open_surface(path, options.crs)
    per_cell = max(1, round(grid.cell_m / _PIXEL_M))
    require_room(
        grid.shape[0] * grid.shape[1] * per_cell**2,
        f"The orthophoto over {path} has",
        "Take the tiles round your queries only.",
    )
    parts = list(_parts(grid, Path(options.orthophoto), per_cell))
    if not parts:
        raise DatasetError(f"{path} has no heights.", "Is it the right tile?")
    return parts


def _parts(grid: SurfaceGrid, orthophoto: Path, per_cell: int) -> Iterator[TexturedPart]:
    for rows, columns in grid.blocks(_PIECE):
        # Corners are middles of cells: a piece ends at the first of the next.
        ends = min(rows[1] + 1, grid.shape[0]), min(columns[1] + 1, grid.shape[1])
        heights = grid.read((rows[0], ends[0]), (columns[0], ends[1]))
        corners = square_corners(heights, _TOLERANCE_M)
        if not len(corners):
            continue
        picture = read_colours(orthophoto, grid, (rows[0], ends[0]), (columns[0], ends[1]), per_cell)
        places = corners.reshape(-1, 2)
        z = heights[places[:, 0], places[:, 1]] / grid.height_unit_m
        middles = (places + (rows[0], columns[0]) + 0.5).astype(np.float64)
        plane = grid.places(middles[:, 1], middles[:, 0])
        uv = (places[:, ::-1] + 0.5) / np.array(heights.shape[::-1])
        uv[:, 1] = 1.0 - uv[:, 1]
        places_in_plane = np.column_stack([plane, z]).reshape(-1, 3, 3).astype(np.float64)
        yield TexturedPart(places_in_plane, uv.reshape(-1, 3, 2), picture)


def square_corners(heights: Floats, tolerance_m: float) -> NDArray[np.int64]:
    """Returns (T, 3, 2) row and column of triangles' corners, two a square, counter-clockwise on the map.

    Squares are the largest, of a power of two cells, whose triangles lie within the tolerance of the heights
    below them; those that hold a gap are left out, down to single cells.
    """
    triangles: list[NDArray[np.int64]] = []
    rows, columns = (each - 1 for each in heights.shape)
    is_open = np.ones((rows, columns), np.bool_)
    side = _WIDEST
    while side >= 1:
        starts = np.arange(0, rows - side + 1, side), np.arange(0, columns - side + 1, side)
        row, column = (each.reshape(-1) for each in np.meshgrid(*starts, indexing="ij"))
        is_free = is_open[row, column]
        row, column = row[is_free], column[is_free]
        fits = _off(heights, row, column, side) <= tolerance_m
        row, column = row[fits], column[fits]
        offsets = np.arange(side)
        is_open[(row[:, None, None] + offsets[:, None]), (column[:, None, None] + offsets)] = False
        a, b = np.stack([row, column], 1), np.stack([row + side, column], 1)
        c, d = np.stack([row + side, column + side], 1), np.stack([row, column + side], 1)
        triangles += [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
        side //= 2
    return np.concatenate(triangles)


def _off(heights: Floats, row: NDArray[Any], column: NDArray[Any], side: int) -> Floats:
    """Returns how far the heights in squares lie from the two triangles over them at most; inf with a gap."""
    offsets = np.arange(side + 1)
    own = heights[row[:, None, None] + offsets[:, None], column[:, None, None] + offsets]
    down, right = np.meshgrid(offsets / side, offsets / side, indexing="ij")
    corner = own[:, [0, side, side, 0], [0, 0, side, side]][:, :, None, None]
    a, b, c, d = corner[:, 0], corner[:, 1], corner[:, 2], corner[:, 3]
    lower = a + (b - a) * down + (c - b) * right
    upper = a + (d - a) * right + (c - d) * down
    off = np.abs(own - np.where(down >= right, lower, upper)).reshape(len(own), (side + 1) ** 2)
    return np.where(np.isnan(off).any(axis=1), np.inf, off.max(axis=1, initial=0.0))
