"""The town as CityGML 2.0 files in a German national grid; byte for byte from the seed.

Two files, as real cities deliver them: one with LoD1 and LoD2, and one, ten times as large, with LoD3. The
ground beside them is a CityGML relief (a TIN), and an ESRI ASCII grid, which footprint readers take. What
CityGML files look like is in ``templates``.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from lodbench.citymodel.model import SurfaceKind
from lodbench.synthesis.town.shapes import Points
from lodbench.synthesis.town.terrain import Terrain
from lodbench.synthesis.town.town import TOWN_VERSION, Town

if TYPE_CHECKING:
    from jinja2 import Template

CRS_NAME = "urn:ogc:def:crs,crs::EPSG::25832,crs::EPSG::7837"
# Where the made-up town lies in UTM zone 32: easting, northing and height of its local origin, metres.
ORIGIN_M = np.array([567_000.0, 5_539_000.0, 0.0])

# Codes of the German surveying authorities' LoD2 profile for bldg:function.
_FUNCTIONS = {
    "residential": "31001_1000",
    "garage": "31001_2463",
    "commercial": "31001_2000",
    "industrial": "31001_2100",
    "public": "31001_3000",
    "church": "31001_3041",
}
_BOUNDARIES = {
    SurfaceKind.GROUND: "GroundSurface",
    SurfaceKind.WALL: "WallSurface",
    SurfaceKind.ROOF: "RoofSurface",
    SurfaceKind.FLOOR: "OuterCeilingSurface",
}

# The ground's files cover the square of this half side around the town's middle.
REACH_M = 640.0
GRID_CELL_M = 4.0
TIN_STEP_M = 20.0


def citygml_text(town: Town, *, is_fine: bool = False) -> str:
    """Returns the file with LoD1 and LoD2, or the fine one with LoD3, coordinates in `CRS_NAME`."""
    # One envelope for both files, so that readers give them one frame.
    points = np.concatenate([solid.points for b in town.buildings for solid in (b.lod1, b.lod2, b.lod3)])
    buildings = town.standing if is_fine else town.mapped
    template = _template("town.gml.jinja")
    return template.render(name=title(town), points=points, buildings=buildings, is_fine=is_fine)


def title(town: Town) -> str:
    """Returns what a town's files call it."""
    return f"lodbench demo town, version {TOWN_VERSION}, look {town.look.name}, seed {town.seed}"


def ascii_grid_text(terrain: Terrain) -> str:
    """Returns ground heights at the middles of cells, north to south, metres with two decimals."""
    count = round(2 * REACH_M / GRID_CELL_M)
    heights = _grid(terrain, np.linspace(-REACH_M, REACH_M, 2 * count + 1)[1::2])[..., 2]
    west, south, _ = ORIGIN_M - REACH_M
    header = [f"ncols {count}", f"nrows {count}", f"xllcorner {west:.1f}", f"yllcorner {south:.1f}"]
    header += [f"cellsize {GRID_CELL_M:.1f}", "NODATA_value -9999"]
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
    return _template("relief.gml.jinja").render(name=name, points=grid.reshape(-1, 3), rings=rings)


def _grid(terrain: Terrain, axis: Points) -> Points:
    """Returns points of the ground, (N, N, 3), rows from south to north."""
    places = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return terrain.on_ground(places).reshape(len(axis), len(axis), 3)


@cache
def _template(name: str) -> Template:
    """Returns a file of ``templates``, to be filled in."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("lodbench.synthesis.town"),
        autoescape=False,  # noqa: S701 - names and numbers of our own; escaping each takes longer than all else
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=StrictUndefined,
    )
    environment.globals |= {"coordinates": _coordinates, "crs_name": CRS_NAME}
    environment.globals |= {"functions": _FUNCTIONS, "boundaries": _BOUNDARIES}
    return environment.get_template(name)


def _coordinates(points: Points) -> str:
    """Returns points, (N, 3) local metres, as absolute coordinates.

    Whole millimetres, or tenths where the points need them.
    """
    fine = np.round(points, 4)
    decimals = 3 if (fine == np.round(points, 3)).all() else 4
    return " ".join(f"{value:.{decimals}f}" for value in (fine + ORIGIN_M).ravel().tolist())
