"""The ground as files: an ESRI ASCII grid, which footprint readers take, and a CityGML relief (a TIN)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from lodbench.synthesis.town.citygml_writer import CRS_NAME, ORIGIN_M, coordinates, document_start, envelope
from lodbench.synthesis.town.terrain import Terrain

Points = NDArray[np.float64]

# Both cover the square of this half side around the town's middle.
REACH_M = 640.0
GRID_CELL_M = 4.0
TIN_STEP_M = 20.0

_NAMESPACES = {
    "xmlns": "http://www.opengis.net/citygml/2.0",
    "xmlns:dem": "http://www.opengis.net/citygml/relief/2.0",
    "xmlns:gml": "http://www.opengis.net/gml",
}


def ascii_grid_text(terrain: Terrain) -> str:
    """Returns ground heights at the middles of cells, north to south, metres with two decimals."""
    count = round(2 * REACH_M / GRID_CELL_M)
    heights = _heights(terrain, np.linspace(-REACH_M, REACH_M, 2 * count + 1)[1::2])
    header = [
        f"ncols {count}",
        f"nrows {count}",
        f"xllcorner {ORIGIN_M[0] - REACH_M:.1f}",
        f"yllcorner {ORIGIN_M[1] - REACH_M:.1f}",
        f"cellsize {GRID_CELL_M:.1f}",
        "NODATA_value -9999",
    ]
    rows = [" ".join(f"{height:.2f}" for height in row) for row in heights[::-1].tolist()]
    return "\n".join([*header, *rows]) + "\n"


def relief_text(terrain: Terrain, name: str) -> str:
    """Returns a CityGML file with one relief feature: a triangulated irregular network in `CRS_NAME`."""
    axis = np.arange(-REACH_M, REACH_M + 0.5 * TIN_STEP_M, TIN_STEP_M, dtype=np.float64)
    heights = _heights(terrain, axis)
    x, y = np.meshgrid(axis, axis)
    grid = np.stack([x, y, heights], axis=2)
    lines = [
        *document_start(_NAMESPACES, name, "The ground of a made-up town."),
        *envelope(grid.reshape(-1, 3)),
    ]
    lines += _relief_feature(grid)
    lines.append("</CityModel>\n")
    return "\n".join(lines)


def _relief_feature(grid: Points) -> Iterator[str]:
    lod = "<dem:lod>2</dem:lod>"
    yield f'<cityObjectMember><dem:ReliefFeature gml:id="DEMO_relief">{lod}<dem:reliefComponent>'
    yield f'<dem:TINRelief gml:id="DEMO_tin">{lod}<dem:tin>'
    yield f'<gml:TriangulatedSurface gml:id="DEMO_tin_surface" srsName="{CRS_NAME}"><gml:trianglePatches>'
    south_west, south_east = grid[:-1, :-1].reshape(-1, 3), grid[:-1, 1:].reshape(-1, 3)
    north_west, north_east = grid[1:, :-1].reshape(-1, 3), grid[1:, 1:].reshape(-1, 3)
    for corners in ((south_west, south_east, north_east), (south_west, north_east, north_west)):
        for ring in np.stack([*corners, corners[0]], axis=1):
            yield (
                '<gml:Triangle><gml:exterior><gml:LinearRing><gml:posList srsDimension="3">'
                f"{coordinates(ring)}</gml:posList></gml:LinearRing></gml:exterior></gml:Triangle>"
            )
    yield "</gml:trianglePatches></gml:TriangulatedSurface></dem:tin></dem:TINRelief>"
    yield "</dem:reliefComponent></dem:ReliefFeature></cityObjectMember>"


def _heights(terrain: Terrain, axis: Points) -> Points:
    """Returns heights, (N, N), rows from south to north."""
    x, y = np.meshgrid(axis, axis)
    heights = terrain.height(np.stack([x.ravel(), y.ravel()], axis=1))
    return np.asarray(heights.reshape(x.shape))
