"""The arguments of `lodbench city`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from lodbench.citymodel.layers import LAYERS
from lodbench.cli.parser import Parser
from lodbench.cli.source_profiles import DATE_HELP

_EXAMPLES = """\
FILE is CityGML, CityJSON, footprints with heights (.gpkg, .shp, .geojson, .fgb, .parquet, .pbf, .osm), a
mesh (.obj, .ply, .stl, .glb) or a surface model (.tif, .asc, .laz); a .zip of all but the last, a .gz of all
but footprints and surface models, or a folder of tiles.

examples:
  lodbench city info 53394525_bldg_6697_op.gml
  lodbench city check LoD2_32_280_5657_1_NW.gml --geojson findings.geojson
  lodbench city info zurich.xml --crs EPSG:21781             the file says "CH1903", which is degrees
  lodbench city info Massachusetts-25-000.zip --source open_city_model --option ground_m=12
  lodbench city check houses.shp --option height_column=HOEHE --option ground_m=430
  lodbench city make --footprints berlin.osm.pbf --dsm dsm/ --dtm dtm.tif berlin.city.json
  lodbench city convert tile.city.json town.glb --lod 2.2
  lodbench city convert lod2.gml blocks.obj --lod 1 --roof-height median
  lodbench city convert tiles/ centre.city.jsonl --to-crs EPSG:25832 --bbox 691000 5335000 692000 5336000
  lodbench city convert lod2.gml churches.json --where function=31001_3041
  lodbench city convert a.gml b.gml -o both.gml --citygml 3.0
  lodbench city convert textured.gml town.city.json --textures        CityJSON and CityGML keep pictures too
  lodbench city convert big.gml tiles/town.city.json --tiles 500      tiles/town_691000_5335000.city.json ...
  lodbench city convert tiles/ town.scene --lod 2 --workers 4         goes on where it was stopped

how to read a file, each as --option KEY=VALUE (explained under lodbench.citymodel.ReadOptions):
  axis_order=east_first|north_first  is_strict=false  origin=[E,N,UP]  up_axis=y|z  layer=NAME
  height_column=NAME  storeys_column=NAME  storey_height_m=3  default_height_m=9
  ground_column=NAME  ground_m=0  terrain=FILE  surface=FILE  base=as_given|ground|sunk  sunk_m=3
  date=YYYY-MM-DD
"""


_ACTIONS = {
    "info": "show format, reference system, place, levels of detail, numbers of buildings, areas, findings",
    "check": "list every defect with its building, and how much area was lost; exit code 1 if data was lost",
    "make": "write footprints as LoD1 buildings, as high as a surface model or attributes say, with a page",
    "convert": "write it, or a part, as CityJSON (.json, .jsonl), CityGML (.gml), .glb, .ply, .obj or .scene",
}


def city_parser() -> argparse.ArgumentParser:
    """Returns the parser of `lodbench city`."""
    about_all = "Inspect, check, convert or make a city model."
    parser = Parser("lodbench city", description=about_all, epilog=_EXAMPLES)
    actions = parser.add_subparsers(dest="action", required=True, metavar="|".join(_ACTIONS))
    for name, about in _ACTIONS.items():
        action = actions.add_parser(name, help=about, description=about, epilog=_EXAMPLES)
        if name == "convert":
            _add_convert(action.add_argument)
        elif name == "make":
            _add_make(action.add_argument)
        else:
            what = "file, archive or folder of tiles" + ("; or a scene" if name == "info" else "")
            action.add_argument("file", type=Path, metavar="FILE", help=what)
        if name == "check":
            points = "write the findings as points, for QGIS"
            action.add_argument("--geojson", type=Path, metavar="OUT", help=points)
        _add_reading(action.add_argument)
        action.add_argument("--json", action="store_true", help="print JSON, for scripts")
    return parser


def _add_convert(add: Any) -> None:
    """Adds what is written, and how."""
    files = "city models, read as one; without -o the last name is OUT"
    add("files", nargs="+", type=Path, metavar="FILE", help=files)
    add("-o", "--out", type=Path, metavar="OUT", help="file to write; its ending chooses the format")
    add("--tiles", type=float, metavar="M", help="write tiles of M metres, and an index of them")
    where = "what reads the tiles of a .scene (default: process)"
    add("--executor", choices=("serial", "process", "dask"), help=where)
    pictures = "keep the textures of surfaces (.gml, .json, .jsonl, .glb, .obj)"
    add("--textures", action="store_true", help=pictures)
    add("--workers", type=int, help="how many processes (default: one per core)")
    add("--address", help="of Dask's scheduler")
    one = "level to write; finest: each building's best (default: all for CityJSON, the lowest for meshes)"
    add("--lod", help=one)
    add("--citygml", choices=("2.0", "3.0"), help="version of a .gml (default: 2.0)")
    add("--to-crs", metavar="CRS", help="project to another reference system in metres")
    add("--id", action="append", default=[], help="only the building of this id; may be repeated")
    inside = "only buildings whose middle lies inside, in the reference system written"
    add("--bbox", nargs=4, type=float, metavar=("W", "S", "E", "N"), help=inside)
    having = "only buildings with this attribute, or with a part that has it; may be repeated"
    add("--where", action="append", default=[], metavar="ATTRIBUTE=VALUE", help=having)
    add("--roof-height", metavar="RULE", help="derive LoD1 where there is none: median, max, p70 or eave")


def _add_make(add: Any) -> None:
    """Adds what a city is made from."""
    add(
        "out",
        type=Path,
        metavar="OUT",
        help="city to write: .city.json, .gml ...; the page beside it is OUT.html",
    )
    plans = "footprints: .osm.pbf, .osm, .gpkg, .geojson, .shp, .fgb, .parquet"
    add("--footprints", type=Path, required=True, metavar="FILE", help=plans)
    heights = "surface model: .tif, .asc, .laz, or a folder of tiles"
    add("--dsm", type=Path, metavar="FILE", help=heights)
    add("--dtm", type=Path, metavar="FILE", help="terrain model (default: estimated from the surface model)")


def _add_reading(add: Any) -> None:
    """Adds how the files are read."""
    add("--crs", help="reference system of the coordinates, if the file names none or a wrong one")
    add("--date", metavar="YYYY-MM-DD", help=DATE_HELP)
    add("--source", default="folder", metavar="PROFILE", help="publisher's profile, as in run source=PROFILE")
    add("--option", action="append", default=[], metavar="KEY=VALUE", help="see below; may be repeated")
    also = f"objects besides buildings: {', '.join(LAYERS)}"
    add("--layers", type=lambda text: tuple(text.split(",")), default=(), metavar="NAME,...", help=also)
