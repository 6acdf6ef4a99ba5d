"""`lodbench city info|check|convert FILE`: look into a city model, and write it in another format."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodbench.citymodel.layers import LAYERS
from lodbench.citymodel.options import ReadOptions
from lodbench.cli.flags import hints_in_flags
from lodbench.cli.sources import load_profile
from lodbench.errors import CityModelError
from lodbench.execution import ProgressCallback

if TYPE_CHECKING:
    from lodbench.citymodel import CityModel

_EXAMPLES = """\
FILE is CityGML, CityJSON, footprints with heights (.gpkg, .shp, .geojson, .fgb, .parquet) or a mesh
(.obj, .ply, .stl, .glb); a .gz or .zip of these, or a folder of tiles.

examples:
  lodbench city info 53394525_bldg_6697_op.gml
  lodbench city check LoD2_32_280_5657_1_NW.gml --geojson findings.geojson
  lodbench city info zurich.xml --crs EPSG:21781             the file says "CH1903", which is degrees
  lodbench city info Massachusetts-25-000.zip --source open_city_model --option ground_m=12
  lodbench city check houses.shp --option height_column=HOEHE --option ground_m=430
  lodbench city convert tile.city.json town.glb --lod 2.2
  lodbench city convert lod2.gml blocks.obj --lod 1 --roof-height median
  lodbench city convert tiles/ centre.city.jsonl --to-crs EPSG:25832 --bbox 691000 5335000 692000 5336000
  lodbench city convert lod2.gml churches.json --where function=31001_3041

options, as --option KEY=VALUE (their meaning: lodbench.citymodel.ReadOptions):
  axis_order=east_first|north_first  is_strict=false  origin=[E,N,UP]  up_axis=y|z  layer=NAME
  height_column=NAME  storeys_column=NAME  storey_height_m=3  default_height_m=9
  ground_column=NAME  ground_m=0  terrain=FILE  base=as_given|ground|sunk  sunk_m=3
"""


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code: 1 if `check` finds an error."""
    asked = _parser().parse_args(argv)
    with hints_in_flags():
        profile = load_profile(asked.source, asked.option, asked.crs)
        if asked.layers:
            profile = replace(profile, options=replace(profile.options, layers=asked.layers))
        if asked.action == "info":
            return _info(asked, profile.options)
        if asked.action == "check":
            return _check(asked, profile.options)
        return _convert(asked, profile.options, asked.lod or profile.lod)


def _parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        "lodbench city", description="Look into a city model.", epilog=_EXAMPLES, formatter_class=raw
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="info|check|convert")
    for name, help_ in (
        ("info", "format, place, levels of detail, counts, areas, findings"),
        ("check", "every defect with its building, and where the area went; exit code 1 if data was lost"),
        (
            "convert",
            "write it as CityJSON (.json, .jsonl), CityGML (.gml), .glb, .ply, .obj or for lodbench (.scene)",
        ),
    ):
        action = actions.add_parser(
            name, help=help_, description=help_, epilog=_EXAMPLES, formatter_class=raw
        )
        action.add_argument("file", type=Path, metavar="FILE", help="city model: file, archive or folder")
        if name == "check":
            action.add_argument(
                "--geojson",
                type=Path,
                metavar="OUT",
                help="write the findings as points, for QGIS",
            )
        if name == "convert":
            action.add_argument("out", type=Path, metavar="OUT", help="its ending names the format")
            action.add_argument(
                "--lod",
                help="the one level to write, or finest: each building's own (meshes: lowest; CityJSON: all)",
            )
            action.add_argument(
                "--citygml", choices=("2.0", "3.0"), default="2.0", help="version of a .gml (2.0)"
            )
            action.add_argument("--to-crs", metavar="CRS", help="project to another system in metres")
            action.add_argument(
                "--id", action="append", default=[], help="only the building of this id; may be repeated"
            )
            action.add_argument(
                "--bbox",
                nargs=4,
                type=float,
                metavar=("W", "S", "E", "N"),
                help="only buildings whose middle lies inside, in the system written",
            )
            action.add_argument(
                "--where",
                action="append",
                default=[],
                metavar="ATTRIBUTE=VALUE",
                help="only buildings with this attribute, or with a part that has it; may be repeated",
            )
            action.add_argument(
                "--roof-height", metavar="RULE", help="derive an absent LoD1: median, max, p70 or eave"
            )
        action.add_argument("--crs", help="CRS of the coordinates, where the file says none or a wrong one")
        action.add_argument(
            "--source", default="folder", metavar="PROFILE", help="publisher, as in run source=PROFILE"
        )
        action.add_argument(
            "--option", action="append", default=[], metavar="KEY=VALUE", help="see below; may be repeated"
        )
        action.add_argument(
            "--layers",
            type=lambda text: tuple(text.split(",")),
            default=(),
            metavar="NAME,...",
            help=f"also: {', '.join(LAYERS)}",
        )
        action.add_argument("--json", action="store_true", help="for machines")
    return parser


def _info(asked: argparse.Namespace, options: ReadOptions) -> int:
    from lodbench.citymodel import city_info
    from lodbench.cli.city_text import format_info

    info = city_info(_read(asked.file, replace(options, is_strict=False)))
    _write(asked, info, lambda: format_info(str(asked.file), info))
    return 0


def _check(asked: argparse.Namespace, options: ReadOptions) -> int:
    from lodbench.citymodel.check import check_city, findings_geojson, format_report
    from lodbench.storage import write_bytes

    start = time.perf_counter()
    model = _read(asked.file, replace(options, is_strict=False, has_details=True))
    read_seconds = time.perf_counter() - start
    report = check_city(model)
    if asked.geojson is not None:
        write_bytes(asked.geojson, json.dumps(findings_geojson(report)).encode())
    values = report.to_json() | {"read_seconds": round(read_seconds, 3)}
    took = f"read in {read_seconds:.2f} s, checked in {report.seconds:.2f} s"
    _write(asked, values, lambda: f"{format_report(report)}\n{took}")
    return 1 if report.has_errors else 0


def _convert(asked: argparse.Namespace, options: ReadOptions, lod: str | None) -> int:
    from lodbench.citymodel.convert import check_target, convert_city, keeps_details
    from lodbench.citymodel.subset import choose_buildings, reproject
    from lodbench.cli.city_text import conversion_summary, format_conversion

    check_target(asked.out)
    if asked.out.resolve() == asked.file.resolve():
        raise CityModelError(f"{asked.out} is the city itself.", "Choose another name to write to.")
    where = [pair.partition("=")[::2] for pair in asked.where]
    has_details = keeps_details(asked.out) or bool(where)
    model = _read(asked.file, replace(options, has_details=has_details))
    if asked.to_crs is not None:
        model = reproject(model, asked.to_crs)
    bbox = None if asked.bbox is None else tuple(asked.bbox)
    model = choose_buildings(model, ids=asked.id, bbox=bbox, where=where)
    done = convert_city(model, asked.out, lod=lod, roof_height=asked.roof_height, citygml=asked.citygml)
    summary = conversion_summary(str(asked.out), done)
    _write(asked, summary, lambda: format_conversion(summary))
    return 0


def _write(asked: argparse.Namespace, values: dict[str, Any], as_text: Callable[[], str]) -> None:
    text = json.dumps(values, indent=2, ensure_ascii=False) if asked.json else as_text()
    sys.stdout.write(text + "\n")


def _read(file: Path, options: ReadOptions) -> CityModel:
    from lodbench.citymodel import read_city_model

    with ProgressCallback(f"reading {file.name}", "MB", 1_000_000) as progress:
        return read_city_model(file, options=options, progress=progress)
