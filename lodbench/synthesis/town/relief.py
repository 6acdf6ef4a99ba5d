"""The ground as files: an ESRI ASCII grid, which footprint readers take, and a CityGML relief (a TIN)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.synthesis.town.citygml_writer import ORIGIN_M, filled_in
from lodbench.synthesis.town.terrain import Terrain

Points = NDArray[np.float64]

# Both cover the square of this half side around the town's middle.
REACH_M = 640.0
GRID_CELL_M = 4.0
TIN_STEP_M = 20.0


def ascii_grid_text(terrain: Terrain) -> str:
    """Returns ground heights at the middles of cells, north to south, metres with two decimals."""
    count = round(2 * REACH_M / GRID_CELL_M)
    heights = _grid(terrain, np.linspace(-REACH_M, REACH_M, 2 * count + 1)[1::2])[..., 2]
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
    grid = _grid(terrain, np.arange(-REACH_M, REACH_M + 0.5 * TIN_STEP_M, TIN_STEP_M, dtype=np.float64))
    south_west, south_east, north_west, north_east = (
        grid[rows, columns].reshape(-1, 3)
        for rows in (slice(-1), slice(1, None))
        for columns in (slice(-1), slice(1, None))
    )
    halves = ((south_west, south_east, north_east), (south_west, north_east, north_west))
    rings = np.concatenate([np.stack([*corners, corners[0]], axis=1) for corners in halves])
    return filled_in("relief.gml.jinja", name=name, points=grid.reshape(-1, 3), rings=rings)


def _grid(terrain: Terrain, axis: Points) -> Points:
    """Returns points of the ground, (N, N, 3), rows from south to north."""
    places = np.stack(np.meshgrid(axis, axis), axis=-1)
    return np.dstack([places, terrain.height(places.reshape(-1, 2)).reshape(places.shape[:2])])
