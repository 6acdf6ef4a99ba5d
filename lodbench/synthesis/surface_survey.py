"""The surface model and the orthophoto of a textured mesh, as an aerial survey delivers them: from above."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.textured_map import TexturedMesh
from lodbench.kernels import draw_from_above
from lodbench.storage import random_stream

Floats = NDArray[np.float64]
NO_DATA = -9999.0


def seen_from_above(
    corners: Floats, west: float, north: float, cell_m: float, shape: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Returns (rows, columns) the highest point over the middle of each cell, NaN for none, and its triangle.

    Args:
        corners: (T, 3, 3) metres.
        west: Edge of the first cell, metres.
        north: Likewise.
        cell_m: Width of a cell.
        shape: Rows and columns.
    """
    heights, triangle = np.full(shape, np.nan, np.float32), np.full(shape, -1, np.int32)
    scale = np.array([1.0 / cell_m, -1.0 / cell_m, 1.0])
    draw_from_above((corners - (west, north, 0.0)) * scale, heights, triangle)
    return heights, triangle


def orthophoto(
    mesh: TexturedMesh, west: float, north: float, cell_m: float, triangle: NDArray[np.int32]
) -> NDArray[np.uint8]:
    """Returns (rows, columns, 3) RGB of what is viewed from above; black where nothing is.

    Args:
        mesh: In the frame of the cells.
        west: As for ``seen_from_above``.
        north: Likewise.
        cell_m: Likewise.
        triangle: As that returns it.
    """
    rows, columns = np.nonzero(triangle >= 0)
    own = triangle[rows, columns]
    corners = mesh.corners[own, :, :2]
    places = np.column_stack([west + (columns + 0.5) * cell_m, north - (rows + 0.5) * cell_m])
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = _cross(b - a, c - a)
    weights = (
        np.stack([_cross(b - places, c - places), _cross(c - places, a - places)], axis=1) / area[:, None]
    )
    weights = np.column_stack([weights, 1.0 - weights.sum(axis=1)])
    colours = np.einsum("nk,nkc->nc", weights, mesh.colours[own].astype(np.float64))
    uv = np.einsum("nk,nkc->nc", weights, mesh.uv[own])
    for number, picture in enumerate(mesh.pictures):
        chosen = np.flatnonzero(mesh.picture[own] == number)
        height, width = picture.shape[:2]
        x = np.floor(uv[chosen, 0] * width).astype(np.int64) % width
        y = np.floor((1.0 - uv[chosen, 1]) * height).astype(np.int64) % height
        colours[chosen] = picture[y, x]
    picture = np.zeros((*triangle.shape, 3), np.uint8)
    picture[rows, columns] = np.clip(np.rint(colours), 0, 255)
    return picture


def _cross(first: Floats, second: Floats) -> Floats:
    return np.asarray(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])


def write_surface_model(
    folder: Path,
    mesh: TexturedMesh,
    origin: Floats,
    crs: str,
    *,
    cell_m: float = 0.5,
    noise_m: float = 0.0,
    side_m: float | None = None,
    seed: int = 0,
) -> tuple[Path, Path]:
    """Writes ``dsm.tif`` and ``dop.tif`` (cells of half the width) of a mesh; returns both.

    Args:
        folder: Where; it is there.
        mesh: In a local frame, metres.
        origin: (3,) of that frame in ``crs``.
        crs: Reference system, in metres.
        cell_m: Width of the surface model's cells.
        noise_m: Standard deviation of its heights.
        side_m: Of the square round the mesh's middle that is written; None for all of it.
        seed: Of the noise.
    """
    points = mesh.corners.reshape(-1, 3)
    low, high = points.min(axis=0), points.max(axis=0)
    if side_m is not None:
        middle = 0.5 * (low + high)
        low, high = middle - 0.5 * side_m, middle + 0.5 * side_m
    west, north = (float(value) for value in (np.floor(low[0]), np.ceil(high[1])))
    rows, columns = (int(side) for side in np.ceil((high - low)[[1, 0]] / cell_m))
    shape = (rows, columns)
    heights, _ = seen_from_above(mesh.corners, west, north, cell_m, shape)
    heights += random_stream(seed, "surface model").normal(scale=noise_m, size=shape) if noise_m else 0.0
    fine = (2 * shape[0], 2 * shape[1])
    _, triangle = seen_from_above(mesh.corners, west, north, 0.5 * cell_m, fine)
    colours = np.moveaxis(orthophoto(mesh, west, north, 0.5 * cell_m, triangle), 2, 0)
    heights = np.where(np.isnan(heights), NO_DATA, heights + origin[2]).astype(np.float32)
    place = west + float(origin[0]), north + float(origin[1])
    return (
        write_raster(folder / "dsm.tif", heights[None], place, cell_m, crs, nodata=NO_DATA),
        write_raster(folder / "dop.tif", colours, place, 0.5 * cell_m, crs),
    )


def write_raster(
    path: Path, bands: NDArray[Any], place: tuple[float, float], cell_m: float, crs: str, **more: Any
) -> Path:
    """Writes bands (B, rows, columns) as GeoTIFF."""
    import rasterio
    from rasterio.transform import from_origin

    profile = {
        "driver": "GTiff", "count": len(bands), "height": bands.shape[1], "width": bands.shape[2],
        "dtype": bands.dtype, "crs": crs, "transform": from_origin(*place, cell_m, cell_m),
        "tiled": True, "compress": "deflate", **more,
    }  # fmt: skip
    with rasterio.open(path, "w", **profile) as raster:
        raster.write(bands)
    return path
