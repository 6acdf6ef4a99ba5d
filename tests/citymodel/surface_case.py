"""Surface models of houses on a slope, written as GeoTIFF, and OpenStreetMap extracts, for the tests."""

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

WEST, NORTH, CELL_M = 600000.0, 5600000.0, 0.5


def ground_m(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns a slope, metres, at places in metres from the north-western corner to the east and south."""
    return 100.0 + 0.03 * x + 0.02 * y


def heights_of(
    houses: list[tuple[float, float, float, float, float]], size_m: float = 100.0, pitch: float = 0.0
) -> NDArray[np.float64]:
    """Returns a surface model of a square.

    Args:
        houses: West, north, east, south edges in metres from the north-western corner, and the height of the
            eaves above the lowest ground below.
        size_m: Side of the square.
        pitch: Slope of the roofs, whose ridges run east.
    """
    middles = np.arange(0.0, size_m, CELL_M) + 0.5 * CELL_M
    x, y = np.meshgrid(middles, middles)
    heights = ground_m(x, y)
    for west, north, east, south, height in houses:
        inside = (x > west) & (x < east) & (y > north) & (y < south)
        base = heights[inside].min()
        rise = pitch * (0.5 * (south - north) - np.abs(y - 0.5 * (north + south)))
        heights[inside] = base + height + rise[inside]
    return heights


def write_raster(path: Path, heights: NDArray[Any], **changed: Any) -> Path:
    """Writes heights as GeoTIFF with cells of ``CELL_M``, and whatever of its profile is changed.

    ``scale``, ``offset`` and ``unit`` are those of the band.
    """
    import rasterio
    from rasterio.transform import from_origin

    band = {name: changed.pop(name) for name in ("scale", "offset", "unit") if name in changed}
    profile = {
        "driver": "GTiff", "height": heights.shape[0], "width": heights.shape[1], "count": 1,
        "dtype": "float32", "crs": "EPSG:25832", "nodata": -9999.0,
        "transform": from_origin(WEST, NORTH, CELL_M, CELL_M),
    } | changed  # fmt: skip
    with rasterio.open(path, "w", **profile) as raster:
        raster.write(heights.astype(profile["dtype"]), 1)
        if "scale" in band:
            raster.scales = (band["scale"],)
        if "offset" in band:
            raster.offsets = (band["offset"],)
        if "unit" in band:
            raster.units = (band["unit"],)
    return path


def rectangle(west: float, north: float, east: float, south: float, height: float = 0.0) -> Any:
    """Returns the footprint of a house of ``heights_of`` as a shapely polygon in EPSG:25832."""
    import shapely

    return shapely.box(WEST + west, NORTH - south, WEST + east, NORTH - north)


def write_footprints(path: Path, shapes: list[Any], crs: str = "EPSG:25832", **columns: Any) -> Path:
    """Writes polygons with columns as a vector file by its ending."""
    import pyogrio
    import shapely
    from pyproj import Transformer

    transformer = Transformer.from_crs("EPSG:25832", crs, always_xy=True)
    moved = shapely.transform(np.array(shapes), lambda p: np.stack(transformer.transform(*p.T), axis=1))
    names = columns or {"id": [f"h{n}" for n in range(len(shapes))]}
    pyogrio.raw.write(
        str(path),
        shapely.to_wkb(moved),
        [
            np.array(values) if isinstance(values[0], float) else np.array(values, object)
            for values in names.values()
        ],
        fields=list(names),
        geometry_type="Polygon",
        crs=crs,
    )
    return path


Ways = list[tuple[list[tuple[float, float]], dict[str, str]]]


def osm_text(ways: Ways) -> str:
    """Returns an OpenStreetMap extract as XML: closed ways of (longitude, latitude) with tags."""
    nodes, lines = [], []
    for number, (ring, tags) in enumerate(ways, start=1):
        first = 100 * number
        nodes += [f'<node id="{first + k}" lat="{lat}" lon="{lon}"/>' for k, (lon, lat) in enumerate(ring)]
        places = [*range(first, first + len(ring)), first]
        quoted = {key: value.replace('"', "&quot;") for key, value in tags.items()}
        lines.append(
            f'<way id="{number}">{"".join(f"<nd ref={chr(34)}{k}{chr(34)}/>" for k in places)}'
            + "".join(f'<tag k="{key}" v="{value}"/>' for key, value in quoted.items())
            + "</way>"
        )
    return f'<?xml version="1.0"?>\n<osm version="0.6">{"".join(nodes + lines)}</osm>'


def osm_pbf(ways: Ways) -> bytes:
    """Returns the same as PBF: a header and a block of nodes and ways (OpenStreetMap wiki, PBF Format)."""
    strings = [b""]
    nodes, drawn = b"", b""
    for number, (ring, tags) in enumerate(ways, start=1):
        first = 100 * number
        for k, (lon, lat) in enumerate(ring):
            place = [(first + k), round(lat * 1e7), round(lon * 1e7)]
            node = b"".join(_field(n, 0, _varint(_zigzag(v))) for n, v in zip((1, 8, 9), place, strict=True))
            nodes += _bytes(1, node)
        keys = b"".join(_varint(_at(strings, key)) for key in tags)
        values = b"".join(_varint(_at(strings, value)) for value in tags.values())
        places = [*range(first, first + len(ring)), first]
        steps = b"".join(_varint(_zigzag(b - a)) for a, b in zip([0, *places], places, strict=False))
        way = _field(1, 0, _varint(number)) + _bytes(2, keys) + _bytes(3, values) + _bytes(8, steps)
        drawn += _bytes(3, way)
    table = _bytes(1, b"".join(_bytes(1, text) for text in strings))
    block = table + _bytes(2, nodes) + _bytes(2, drawn)
    head = _bytes(4, b"OsmSchema-V0.6")
    return _blob(b"OSMHeader", head) + _blob(b"OSMData", block)


def _at(strings: list[bytes], text: str) -> int:
    strings.append(text.encode())
    return len(strings) - 1


def _varint(value: int) -> bytes:
    out = b""
    while value > 127:
        out += bytes([value & 127 | 128])
        value >>= 7
    return out + bytes([value])


def _zigzag(value: int) -> int:
    return 2 * value if value >= 0 else -2 * value - 1


def _field(number: int, kind: int, content: bytes) -> bytes:
    return _varint(number << 3 | kind) + content


def _bytes(number: int, content: bytes) -> bytes:
    return _field(number, 2, _varint(len(content)) + content)


def _blob(kind: bytes, content: bytes) -> bytes:
    blob = _field(2, 0, _varint(len(content))) + _bytes(3, zlib.compress(content))
    head = _bytes(1, kind) + _field(3, 0, _varint(len(blob)))
    return struct.pack(">I", len(head)) + head + blob
