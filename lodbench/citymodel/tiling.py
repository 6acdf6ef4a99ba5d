"""A city cut into square tiles, and the index that says which file holds what."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lodbench.citymodel.crs import require_crs
from lodbench.citymodel.model import CityModel
from lodbench.citymodel.source import TILE_INDEX, file_source, own_geojson
from lodbench.citymodel.subset import footprint_boxes, keep_buildings
from lodbench.errors import CityModelError
from lodbench.storage.json_text import parse_json


@dataclass(frozen=True, slots=True)
class Tile:
    """A square of a city.

    Attributes:
        west, south: Its corner in the city's reference system, metres.
        size_m: Its side.
        model: The buildings whose middle lies in it.
    """

    west: float
    south: float
    size_m: float
    model: CityModel

    @property
    def name(self) -> str:
        """Returns its corner in whole metres: ``691000_5335000``."""
        return f"{self.west:.0f}_{self.south:.0f}"


def cut_into_tiles(model: CityModel, size_m: float) -> list[Tile]:
    """Returns the tiles of a city, from south to north and west to east; empty ones are left out.

    A building is in the tile where the middle of its bounding box lies, whole; one without a surface is in
    the first tile.

    Args:
        model: The city.
        size_m: Side of a tile, metres, a whole number.

    Raises:
        CityModelError: The side is no length.
    """
    if not (size_m >= 1 and size_m == int(size_m)):
        raise CityModelError(f"A tile of {size_m} m is none.", "Whole metres, 500 for example.")
    low, high = footprint_boxes(model)
    middle = 0.5 * (low + high) + model.origin[:2]
    has_place = np.isfinite(middle).all(axis=1)
    corner = np.zeros((len(middle), 2))
    corner[has_place] = np.floor(middle[has_place] / size_m) * size_m
    corners, tile_of = np.unique(corner[has_place][:, ::-1], axis=0, return_inverse=True)
    number = np.zeros(len(middle), np.int64)
    number[has_place] = tile_of.reshape(-1)
    return [
        Tile(west, south, size_m, keep_buildings(model, number == n))
        for n, (south, west) in enumerate(corners.tolist())
    ]


def require_no_others(index: Path, files: Collection[str]) -> None:
    """Makes sure that an index replaces none but one of the same tiles.

    Args:
        index: Where it will be written, beside the tiles.
        files: Their names.

    Raises:
        CityModelError: Something else is there, or tiles of an earlier cut, which would be read with these.
    """
    if not index.exists():
        return
    if not index.is_file() or own_geojson(file_source(index)) != TILE_INDEX["lodbench"]:
        raise CityModelError(
            f"{index} is there already, and is no index of tiles.", "Name the tiles otherwise: -o OUT."
        )
    try:
        former = [
            Path(each["properties"]["file"]).name for each in parse_json(index.read_bytes())["features"]
        ]
    except (ValueError, TypeError, LookupError):
        return  # cut off: it names nothing
    others = [name for name in former if name not in files and (index.parent / name).exists()]
    if others:
        raise CityModelError(
            f"{len(others)} tiles of an earlier cut lie beside {index}, {others[0]} for example.",
            "Remove them, which would be read with the new ones, or name the tiles otherwise: -o OUT.",
        )


def tile_index(tiles: list[tuple[Tile, str]], crs: str | None) -> dict[str, Any]:
    """Returns an index of tiles and their files as GeoJSON, longitude and latitude where the system is known.

    Args:
        tiles: Each with the name of its file.
        crs: Reference system of the city, or None: then the squares stand in its own metres.
    """
    features = []
    for tile, file in tiles:
        w, s, e, n = tile.west, tile.south, tile.west + tile.size_m, tile.south + tile.size_m
        ring = np.array([(w, s), (e, s), (e, n), (w, n), (w, s)])
        if crs is not None:
            from pyproj import Transformer

            to_degrees = Transformer.from_crs(require_crs(crs).horizontal, "EPSG:4326", always_xy=True)
            ring = np.round(np.stack(to_degrees.transform(ring[:, 0], ring[:, 1]), axis=1), 8)
        model = tile.model
        features.append(
            {
                "type": "Feature",
                "geometry": {"type": "Polygon", "coordinates": [ring.tolist()]},
                "properties": {
                    "file": file,
                    "buildings": len(model.building_ids),
                    "polygons": len(model.polygons),
                    "bbox": [w, s, e, n],
                    "crs": crs,
                },
            }
        )
    return {**TILE_INDEX, "features": features}
