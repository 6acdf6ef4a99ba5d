"""Maps of benchmarks that are rasters: a surface model under its orthophoto, as a city and as a textured map.

What OrthoLoC and AnyVisLoc have in common: samples as ``.npz`` with their photos in them, pinholes whose
pixels are counted from their centres, and such maps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.pose_text import lines_to_text
from lodbench.datasets.published.own_layout import kept_folder
from lodbench.errors import CityModelError, DatasetError, LodbenchError
from lodbench.geometry import Camera
from lodbench.photos.pictures import encoded
from lodbench.storage import make_folder, write_bytes

Floats = NDArray[np.float64]

_CITY, _TEXTURED = "city", "textured"
# Cells are this near to a regular grid, as a share of their width.
_REGULAR = 0.25


class Raster(NamedTuple):
    """Cells of a map, rows from north to south."""

    values: NDArray[Any]  # (H, W) heights in metres, NaN for none; or (H, W, 3) BGR
    # Outer corner of the first cell, metres
    west: float
    north: float
    cell: tuple[float, float]  # width and height of a cell, metres


class RasterMap(NamedTuple):
    """A surface model and its orthophoto, by a plain name that is unique in its dataset."""

    name: str
    heights: Raster
    picture: Raster


def raster_of(places: NDArray[Any], where: str) -> Raster:
    """Returns (H, W, 3) places of cells' middles as a raster of heights.

    Raises:
        DatasetError: There is none, or they lie on no grid of rows to the east.
    """
    x, y, z = np.moveaxis(places.astype(np.float64), 2, 0)
    is_known = np.isfinite(places).all(axis=2)
    if not is_known.any():
        raise DatasetError(f"{where}: dsm holds no height.", "Download it again.")
    steps = [each[np.isfinite(each)] for each in (np.diff(x, axis=1), -np.diff(y, axis=0))]
    cell = [float(np.median(each)) if len(each) else 0.0 for each in steps]
    rows, columns = np.nonzero(is_known)
    west, north = np.median(x[is_known] - columns * cell[0]), np.median(y[is_known] + rows * cell[1])
    off = np.abs([x[is_known] - west - columns * cell[0], y[is_known] - north + rows * cell[1]]).max()
    if not (min(cell) > 0 and off < _REGULAR * min(cell)):
        raise DatasetError(
            f"{where}: dsm is no regular grid of rows from north to south.", "Download it again."
        )
    heights = np.where(is_known, z, np.nan).astype(np.float32)
    return Raster(heights, float(west) - 0.5 * cell[0], float(north) + 0.5 * cell[1], (cell[0], cell[1]))


def kept_maps(
    name: str, sources: Iterable[Path], made_with: Any, stride: int, maps: Callable[[], Iterable[RasterMap]]
) -> tuple[Path, Path, str]:
    """Returns the city and the textured map of rasters, made in the cache, and a note.

    The city is what rises above the ground (see ``citymodel.surface``), a CityJSON file a map. Where nothing
    does, or cells are too coarse to show buildings, the textured surface is the city, and the note says so.

    Args:
        name: Of the dataset.
        sources: Files of the maps.
        made_with: What else they follow from, as JSON values.
        stride: Every which cell is a corner of the textured map.
        maps: Reads them, one by one.

    Raises:
        DatasetError: A map cannot be read.
    """

    def write(folder: Path) -> None:
        make_folder(folder / _TEXTURED)
        make_folder(folder / _CITY)
        for each in maps():
            _write_textured(folder / _TEXTURED, each, stride)
            _write_city(folder / _CITY / f"{each.name}.city.json", each)

    folder = kept_folder(f"{name}-map", sources, [made_with, stride, "city"], write)
    if any((folder / _CITY).iterdir()):
        return folder / _CITY, folder / _TEXTURED, ""
    note = "no building rises above the ground of the surface models: their whole surface is the city"
    return folder / _TEXTURED, folder / _TEXTURED, note


def _write_city(target: Path, raster: RasterMap) -> None:
    from lodbench.citymodel.convert import convert_city
    from lodbench.citymodel.options import ReadOptions
    from lodbench.citymodel.polygons import finish_model
    from lodbench.citymodel.surface.grid import SurfaceGrid, require_size
    from lodbench.citymodel.surface.orthophoto import are_green
    from lodbench.citymodel.surface.reader import surface_city

    heights, picture = raster.heights, raster.picture

    def read(rows: tuple[int, int], columns: tuple[int, int]) -> NDArray[np.float32]:
        return np.asarray(heights.values[slice(*rows), slice(*columns)], np.float32)

    def is_green(rows: tuple[int, int], columns: tuple[int, int]) -> NDArray[np.bool_]:
        x = heights.west + (np.arange(*columns) + 0.5) * heights.cell[0]
        y = heights.north - (np.arange(*rows) + 0.5) * heights.cell[1]
        column = np.floor((x - picture.west) / picture.cell[0]).astype(np.int64)
        row = np.floor((picture.north - y) / picture.cell[1]).astype(np.int64)
        sides = picture.values.shape[:2]
        colours = picture.values[np.clip(row, 0, sides[0] - 1)[:, None], np.clip(column, 0, sides[1] - 1)]
        inside = ((row >= 0) & (row < sides[0]))[:, None] & (column >= 0) & (column < sides[1])
        return np.asarray(are_green(colours[..., ::-1]) & inside)

    shape = heights.values.shape
    grid = SurfaceGrid(
        raster.name, None, heights.west, heights.north, heights.cell, 1.0, (shape[0], shape[1]), read
    )
    try:
        require_size(grid)
        raw = surface_city(grid, raster.name, ReadOptions(), is_green)
    except CityModelError:
        return  # a surface without buildings is a map all the same
    raw.building_ids = tuple(f"{raster.name}_{name}" for name in raw.building_ids)
    convert_city(finish_model(raw), target)


def _write_textured(folder: Path, raster: RasterMap, stride: int) -> None:
    """Writes a surface under its orthophoto as ``NAME.obj``, ``.mtl`` and ``.png``; holes have no faces."""
    heights, picture = raster.heights, raster.picture
    z = np.asarray(heights.values[::stride, ::stride], np.float64)
    height, width = z.shape
    rows, columns = (np.arange(0, side, stride) + 0.5 for side in heights.values.shape)
    x, y = np.meshgrid(heights.west + columns * heights.cell[0], heights.north - rows * heights.cell[1])
    lines, samples = picture.values.shape[:2]
    u = (x - picture.west) / (picture.cell[0] * samples)
    v = 1.0 - (picture.north - y) / (picture.cell[1] * lines)
    number = np.arange(1, height * width + 1).reshape(height, width)
    known: NDArray[np.bool_] = np.asarray(np.isfinite(z))
    squares = known[:-1, :-1] & known[:-1, 1:] & known[1:, :-1] & known[1:, 1:]
    # Counter-clockwise from above: rows run south.
    quads = np.stack([number[1:, :-1], number[1:, 1:], number[:-1, 1:], number[:-1, :-1]], axis=2)[squares]
    places = np.stack([x, y, np.nan_to_num(z)], axis=2).reshape(-1, 3).tolist()
    text = [f"mtllib {raster.name}.mtl", f"usemtl {raster.name}"]
    # Holes keep their numbers; no face has them.
    text += [f"v {x:.3f} {y:.3f} {z:.3f}" for x, y, z in places]
    text += [f"vt {u:.6f} {v:.6f}" for u, v in np.stack([u, v], axis=2).reshape(-1, 2).tolist()]
    text += [f"f {a}/{a} {b}/{b} {c}/{c} {d}/{d}" for a, b, c, d in quads.tolist()]
    contents = {
        "obj": lines_to_text(text).encode(),
        "mtl": f"newmtl {raster.name}\nmap_Kd {raster.name}.png\n".encode(),
        "png": encoded(np.ascontiguousarray(picture.values), ".png"),
    }
    for suffix, data in contents.items():
        write_bytes(folder / f"{raster.name}.{suffix}", data, False)


def kept_pictures(
    name: str, sources: Sequence[Path], made_with: Any, pictures: Callable[[], Iterable[tuple[str, Any]]]
) -> Path:
    """Returns a folder of the cache with photos of samples, (H, W, 3 or more) RGB, as PNG by their names."""

    def write(folder: Path) -> None:
        for stem, colours in pictures():
            target = folder / f"{stem}.png"
            make_folder(target.parent)
            write_bytes(target, encoded(np.ascontiguousarray(colours[..., 2::-1]), ".png"), False)

    return kept_folder(name, sources, made_with, write)


def pinhole(
    where: str, matrix: NDArray[Any], size: Sequence[int], half_px: float, lens: tuple[float, ...] = ()
) -> Camera:
    """Returns the camera of a 3 x 3 matrix.

    Args:
        where: File and array, for messages.
        matrix: Intrinsics.
        size: Width and height, pixels.
        half_px: Added to the principal point: 0.5 where pixels are counted from their centres.
        lens: Of OpenCV's full model, or none.

    Raises:
        DatasetError: It is no pinhole.
    """
    (fx, skew, cx), (_, fy, cy), last = matrix.astype(float).tolist()
    try:
        if skew or last != [0.0, 0.0, 1.0]:
            raise LodbenchError("no pinhole without skew")
        kind = ("FULL_OPENCV",) if any(lens) else ()
        return Camera(size[0], size[1], fx, fy, cx + half_px, cy + half_px, lens if any(lens) else (), *kind)
    except LodbenchError as error:
        raise DatasetError(f"{where}: {error.message.rstrip('.')}.") from error
