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
from lodbench.storage import make_folder

if TYPE_CHECKING:
    from lodbench.citymodel import CityModel
    from lodbench.citymodel.convert import Conversion

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
  lodbench city convert a.gml b.gml -o both.gml --citygml 3.0
  lodbench city convert big.gml tiles/town.city.json --tiles 500      tiles/town_691000_5335000.city.json ...
  lodbench city convert tiles/ town.scene --lod 2 --workers 4         goes on where it was stopped

options, as --option KEY=VALUE (their meaning: lodbench.citymodel.ReadOptions):
  axis_order=east_first|north_first  is_strict=false  origin=[E,N,UP]  up_axis=y|z  layer=NAME
  height_column=NAME  storeys_column=NAME  storey_height_m=3  default_height_m=9
  ground_column=NAME  ground_m=0  terrain=FILE  base=as_given|ground|sunk  sunk_m=3
"""


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code: 1 if `check` finds an error."""
    asked = _parser().parse_args(argv)
    with hints_in_flags():
        if asked.action == "info" and (asked.file / "scene.json").is_file():
            return _scene_info(asked)
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
        if name == "convert":
            action.add_argument(
                "files",
                nargs="+",
                type=Path,
                metavar="FILE",
                help="city models, read as one; without -o the last one is OUT",
            )
            action.add_argument("-o", "--out", type=Path, metavar="OUT", help="its ending names the format")
        else:
            action.add_argument(
                "file", type=Path, metavar="FILE", help="file, archive, folder of tiles or scene"
            )
        if name == "check":
            action.add_argument(
                "--geojson",
                type=Path,
                metavar="OUT",
                help="write the findings as points, for QGIS",
            )
        if name == "convert":
            action.add_argument(
                "--tiles", type=float, metavar="M", help="write squares of this side, and their index"
            )
            action.add_argument(
                "--executor", choices=("serial", "process", "dask"), default="process",
                help="where the tiles of a .scene are read (process)",
            )  # fmt: skip
            action.add_argument("--workers", type=int, help="how many processes (one per core)")
            action.add_argument("--address", help="of Dask's scheduler")
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


def _scene_info(asked: argparse.Namespace) -> int:
    """Tells of a scene, with as little loaded as that takes: a second is long."""
    from lodbench.citymodel.scene_file import scene_info
    from lodbench.cli.city_text import format_scene

    told = scene_info(asked.file)
    _write(asked, told, lambda: format_scene(str(asked.file), told))
    return 0


def _info(asked: argparse.Namespace, options: ReadOptions) -> int:
    from lodbench.citymodel import city_info
    from lodbench.cli.city_text import format_info

    info = city_info(_read([asked.file], replace(options, is_strict=False)))
    _write(asked, info, lambda: format_info(str(asked.file), info))
    return 0


def _check(asked: argparse.Namespace, options: ReadOptions) -> int:
    from lodbench.citymodel.check import check_city, findings_geojson, format_report
    from lodbench.storage import write_bytes

    start = time.perf_counter()
    model = _read([asked.file], replace(options, is_strict=False, has_details=True))
    read_seconds = time.perf_counter() - start
    report = check_city(model)
    if asked.geojson is not None:
        write_bytes(asked.geojson, json.dumps(findings_geojson(report)).encode())
    values = report.to_json() | {"read_seconds": round(read_seconds, 3)}
    took = f"read in {read_seconds:.2f} s, checked in {report.seconds:.2f} s"
    _write(asked, values, lambda: f"{format_report(report)}\n{took}")
    return 1 if report.has_errors else 0


def _convert(asked: argparse.Namespace, options: ReadOptions, lod: str | None) -> int:
    from lodbench.citymodel.convert import check_target, convert_city, convert_tiles, keeps_details
    from lodbench.citymodel.source import open_sources
    from lodbench.cli.city_text import conversion_summary, format_conversion

    files, out = (asked.files, asked.out) if asked.out is not None else (asked.files[:-1], asked.files[-1])
    if not files:
        raise CityModelError(
            f"There is nothing to convert {out} from.", "lodbench city convert FILE... -o OUT"
        )
    if asked.tiles is not None and out.parent.parent.is_dir():
        make_folder(out.parent)
    check_target(out)
    if any(out.resolve() == file.resolve() for file in files):
        raise CityModelError(f"{out} is the city itself.", "Choose another name to write to.")
    is_whole = not (asked.id or asked.where or asked.bbox or asked.to_crs or asked.tiles)
    if (
        out.suffix == ".scene"
        and len(files) == 1
        and is_whole
        and len(open_sources(files[0], options.layers)) > 1
    ):
        return _compile(asked, files[0], out, options, lod)
    has_details = keeps_details(out) or bool(asked.where)
    model = _chosen(asked, _read(files, replace(options, has_details=has_details)))

    def write(part: CityModel, target: Path) -> Conversion:
        return convert_city(part, target, lod=lod, roof_height=asked.roof_height, citygml=asked.citygml)

    if asked.tiles is None:
        summaries = [conversion_summary(str(out), write(model, out))]
    else:
        done = convert_tiles(model, out, asked.tiles, write)
        summaries = [conversion_summary(str(each.target), each) for each in done]
    values = summaries[0] if asked.tiles is None else {"tiles": summaries}
    _write(asked, values, lambda: "\n".join(map(format_conversion, summaries)))
    return 0


def _chosen(asked: argparse.Namespace, model: CityModel) -> CityModel:
    """Returns the buildings asked for, in the reference system asked for."""
    from lodbench.citymodel.subset import choose_buildings, reproject

    if asked.to_crs is not None:
        model = reproject(model, asked.to_crs)
    bbox = None if asked.bbox is None else tuple(asked.bbox)
    where = [pair.partition("=")[::2] for pair in asked.where]
    return choose_buildings(model, ids=asked.id, bbox=bbox, where=where)


def _compile(asked: argparse.Namespace, tiles: Path, out: Path, options: ReadOptions, lod: str | None) -> int:
    """Makes a scene of many tiles; goes on where it was stopped."""
    from lodbench.citymodel.scene_file import scene_info
    from lodbench.cli.city_text import format_scene
    from lodbench.execution.executor import ExecutorParams
    from lodbench.harness.prepared import compile_tiles

    executor = ExecutorParams(asked.executor, asked.workers, None, asked.address)
    with ProgressCallback(f"compiling {tiles.name}", "tiles") as progress:
        compile_tiles(
            tiles, out, lod=lod, roof_height=asked.roof_height, options=options, executor=executor,
            progress=progress,
        )  # fmt: skip
    told = scene_info(out)
    _write(asked, {"written": str(out), **told}, lambda: format_scene(str(out), told))
    return 0


def _write(asked: argparse.Namespace, values: dict[str, Any], as_text: Callable[[], str]) -> None:
    text = json.dumps(values, indent=2, ensure_ascii=False) if asked.json else as_text()
    sys.stdout.write(text + "\n")


def _read(files: Sequence[Path], options: ReadOptions) -> CityModel:
    from lodbench.citymodel import read_city_model

    with ProgressCallback(f"reading {files[0].name}", "MB", 1_000_000) as progress:
        return read_city_model(files, options=options, progress=progress)
