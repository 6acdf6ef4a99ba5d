"""Orthophotos, as pictures of a rectangle of a city's plane: GeoTIFF and JPEG 2000, through rasterio."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.citymodel.vector.gdal import opened_raster
from lodbench.errors import CityModelError, ConfigError

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
            seen = {
                "crs": _own_crs(raster, self.crs),
                "src_crs": _own_crs(raster, self.crs) if raster.crs is None else raster.crs,
                "transform": from_bounds(*low, *high, width, height),
                "width": width,
                "height": height,
                "resampling": Resampling.nearest if is_palette else Resampling.average,
                "add_alpha": not raster.nodatavals[0] and not _has_alpha(raster),
            }
            with WarpedVRT(raster, **seen) as warped:
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
    """Refuses imagery that lies elsewhere.

    Raises:
        CityModelError: It does.
    """
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
