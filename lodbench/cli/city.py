"""`lodbench city info|check|convert|make`: look into a city model, write it otherwise, or make one."""

from __future__ import annotations

import json
import textwrap
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodbench.citymodel.codes import finding_catalogue
from lodbench.citymodel.formats import formats_in_words
from lodbench.citymodel.model import lod_in_words
from lodbench.citymodel.options import ReadOptions
from lodbench.cli.city_convert import ConvertOptions, TileOptions, converted, read_city, require_other
from lodbench.cli.parser import Parser
from lodbench.errors import CityModelError, ConfigError
from lodbench.execution import ProgressCallback
from lodbench.params import add_options, flag, options_of, part, word
from lodbench.reporting.aligned_text import count_of, format_columns

if TYPE_CHECKING:
    from lodbench.citymodel.convert import Conversion


_EXAMPLES = """\
examples:
  lodbench city info 53394525_bldg_6697_op.gml
  lodbench city check LoD2_32_280_5657_1_NW.gml --geojson findings.geojson
  lodbench city info zurich.xml --crs EPSG:21781             the file says "CH1903", which is degrees
  lodbench city info Massachusetts-25-000.zip --source open_city_model --option ground_m=12
  lodbench city check houses.shp --option height_column=HOEHE --option ground_m=430
  lodbench city make --footprints berlin.osm.pbf --dsm dsm/ --dtm dtm.tif berlin.city.json
  lodbench city make --footprints houses.gpkg --dtm dtm.tif --photos flight --poses localized town.city.json
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
_MEANINGS = {str(code): code for code in finding_catalogue()}


@dataclass(frozen=True, kw_only=True)
class InfoOptions:
    """What `city info` is given."""

    file: Path = word("file, archive or folder of tiles; or a scene", metavar="FILE")
    tiles_read: TileOptions = part(TileOptions)


@dataclass(frozen=True, kw_only=True)
class CheckOptions:
    """What `city check` is given."""

    file: Path = word("file, archive or folder of tiles", metavar="FILE")
    geojson: Path | None = flag(None, "write the findings as points, for QGIS", metavar="OUT")
    tiles_read: TileOptions = part(TileOptions)


@dataclass(frozen=True, kw_only=True)
class MakeOptions:
    """What `city make` is given."""

    out: Path = word("city to write: .city.json, .gml ...; the page beside it is OUT.html", metavar="OUT")
    footprints: Path = flag(
        ..., "footprints: .osm.pbf, .osm, .gpkg, .geojson, .shp, .fgb, .parquet", metavar="FILE"
    )
    dsm: Path | None = flag(None, "surface model: .tif, .asc, .laz, or a folder of tiles", metavar="FILE")
    dtm: Path | None = flag(None, "terrain model (default: estimated from the surface model)", metavar="FILE")
    photos: Path | None = flag(
        None,
        "photos that measure roofs: a dataset with true poses, or with --poses a folder of photos",
        metavar="DIR",
    )
    poses: Path | None = flag(
        None,
        "what localize wrote of these photos, a COLMAP model, or another file of poses with cameras",
        metavar="FILE",
    )
    tiles_read: TileOptions = part(TileOptions)


_ACTIONS: dict[str, tuple[type, str]] = {
    "info": (
        InfoOptions,
        "show format, reference system, place, levels of detail, numbers of buildings, areas, findings",
    ),
    "check": (
        CheckOptions,
        "list every defect with its building, and how much area was lost; exit code 1 if data was lost",
    ),
    "make": (
        MakeOptions,
        "write footprints as buildings, as high as a surface model, photos or attributes say, and a page",
    ),
    "convert": (
        ConvertOptions,
        "write it, or a part, as CityJSON (.json, .jsonl), CityGML (.gml), .glb, .ply, .obj or .scene",
    ),
}


OPTIONS = {f"city {name}": kind for name, (kind, *_) in _ACTIONS.items()}


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code: 1 if `check` finds an error."""
    about_all = "Inspect, check, convert or make a city model."
    files = (
        f"FILE is {formats_in_words()}; a .zip of all but the last, a .gz of what is no footprint or "
        "surface model, or a folder of tiles."
    )
    examples = f"{textwrap.fill(files, 110)}\n\n{_EXAMPLES}"
    parser = Parser("lodbench city", description=about_all, epilog=examples)
    actions = parser.add_subparsers(dest="action", required=True, metavar="|".join(_ACTIONS))
    for name, (kind, about) in _ACTIONS.items():
        add_options(actions.add_parser(name, help=about, description=about, epilog=examples), kind)
    given = parser.parse_args(argv)
    wanted: Any = options_of(given, _ACTIONS[given.action][0])
    if given.action == "info" and (wanted.file / "scene.json").is_file():
        return _scene_info(wanted)
    profile = wanted.tiles_read.profile()
    if given.action == "convert":
        return _convert(wanted, profile.options, wanted.lod or profile.lod)
    run: dict[str, Callable[[Any, ReadOptions], int]] = {"info": _info, "check": _check, "make": _make}
    return run[given.action](wanted, profile.options)


def _scene_info(wanted: InfoOptions) -> int:
    """Tells of a scene, with as little loaded as that takes: a second is long."""
    from lodbench.citymodel.scene_file import scene_info

    reported = scene_info(wanted.file)
    wanted.tiles_read.write(reported, lambda: format_scene(str(wanted.file), reported))
    return 0


def _info(wanted: InfoOptions, options: ReadOptions) -> int:
    from lodbench.citymodel import city_info

    info = city_info(read_city([wanted.file], replace(options, is_strict=False)))
    wanted.tiles_read.write(info, lambda: format_info(str(wanted.file), info))
    return 0


def _check(wanted: CheckOptions, options: ReadOptions) -> int:
    from lodbench.citymodel.checks.report import check_city, findings_geojson, format_report
    from lodbench.citymodel.source import OWN_GEOJSON, file_source, own_geojson
    from lodbench.storage import write_bytes

    if wanted.geojson is not None:
        is_ours = own_geojson(file_source(wanted.geojson)) == OWN_GEOJSON["lodbench"]
        if not is_ours and (wanted.geojson.exists() or wanted.geojson.suffix.lower() != ".geojson"):
            require_other(wanted.geojson, [wanted.file])
        if wanted.geojson.is_dir() or not wanted.geojson.parent.is_dir():
            raise CityModelError(
                f"{wanted.geojson} is not a file in a folder that is there.", "--geojson FILE"
            )
    start = time.perf_counter()
    model = read_city([wanted.file], replace(options, is_strict=False, has_details=True))
    read_seconds = time.perf_counter() - start
    report = check_city(model)
    if wanted.geojson is not None:
        write_bytes(wanted.geojson, json.dumps(findings_geojson(report)).encode())
    values = report.to_json() | {"read_seconds": round(read_seconds, 3)}
    took = f"read in {read_seconds:.2f} s, checked in {report.seconds:.2f} s"
    wanted.tiles_read.write(values, lambda: f"{format_report(report)}\n{took}")
    return 1 if report.has_errors else 0


def _convert(wanted: ConvertOptions, options: ReadOptions, lod: str | None) -> int:
    out, done = converted(wanted, options, lod)
    if done is None:
        from lodbench.citymodel.scene_file import scene_info

        reported = scene_info(out)
        wanted.tiles_read.write({"written": str(out), **reported}, lambda: format_scene(str(out), reported))
        return 0
    summaries = [conversion_summary(str(target), each) for target, each in done]
    values = summaries[0] if wanted.tiles is None else {"tiles": summaries}
    wanted.tiles_read.write(values, lambda: "\n".join(map(format_conversion, summaries)))
    return 0


def _make(wanted: MakeOptions, options: ReadOptions) -> int:
    """Writes footprints as buildings, and the page that says where their heights come from."""
    from lodbench.citymodel.convert import check_target
    from lodbench.harness.city_make import make_city

    check_target(wanted.out)
    given = [path for path in (wanted.footprints, wanted.dsm, wanted.dtm) if path is not None]
    require_other(wanted.out, given)
    if wanted.poses is not None and wanted.photos is None:
        raise ConfigError("--poses are those of photos.", "Name their folder: --photos DIR")
    surface, terrain = (None if path is None else str(path) for path in (wanted.dsm, wanted.dtm))
    options = replace(options, surface=surface or options.surface, terrain=terrain or options.terrain)
    with ProgressCallback(f"reading {wanted.footprints.name}", "MB", 1_000_000) as progress:
        made = make_city(wanted.footprints, wanted.out, options, progress, wanted.photos, wanted.poses)
    wanted.tiles_read.write(made, lambda: format_made(made))
    return 0


def format_info(name: str, info: dict[str, Any]) -> str:
    """Returns the data of ``city_info`` as lines of text."""
    x, y, z = info["extent_m"]
    place = info["center_lat_lon"]
    noun = "building part" if info["parts"] == 1 else "building parts"
    parts = f", and {info['parts']:,} {noun}" if info["parts"] else ""
    lines = [
        name,
        f"format     {info['format']} {info['version'] or ''}".rstrip(),
        f"CRS        {crs_in_words(info['crs'])}",
        *([] if place is None else [f"centre     latitude {place[0]:.5f}, longitude {place[1]:.5f}"]),
        f"extent     {x:,.1f} m x {y:,.1f} m, {z:,.1f} m high",
        f"buildings  {info['buildings']:,}{parts}",
        *_roof_lines(info["pitched_roofs"]),
        *(
            f"{'and' if n == 0 else '':10} {count:,} {name}"
            for n, (name, count) in enumerate(info["objects"].items())
        ),
        "",
        *_level_lines(info["lods"]),
        "",
        *_finding_lines(info["findings"], info["finding_objects"]),
    ]
    return "\n".join(lines)


def _roof_lines(pitched: int) -> list[str]:
    """Returns how many buildings have pitched roofs by an attribute of the file."""
    count = count_of(format(pitched, ","), "buildings")
    return [f"roofs      {count} pitched (from the file)"] if pitched else []


def format_scene(name: str, info: dict[str, Any]) -> str:
    """Returns the data of ``scene_info`` as lines of text."""
    extent = info["extent_m"]
    lines = [
        name,
        f"format     scene, {lod_in_words(info['lod']) if info['lod'] else 'one level'}",
        f"CRS        {crs_in_words(info['crs'])}",
        *([] if extent is None else ["extent     {:,.1f} m x {:,.1f} m, {:,.1f} m high".format(*extent)]),
        f"buildings  {info['buildings']:,}",
        *_roof_lines(info["pitched_roofs"]),
        *(f"{key:10} {info[key]:,}" for key in ("tiles", "triangles") if info[key] is not None),
        "",
        *_finding_lines(info["findings"], info["finding_objects"]),
    ]
    return "\n".join(lines)


def crs_in_words(crs: str | None) -> str:
    """Returns a reference system with its name: ``EPSG:28992 (Amersfoort / RD New)``."""
    if crs is None:
        return "none: local coordinates, taken as metres"
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        return f"{crs} ({CRS.from_user_input(crs).name})"
    except CRSError:
        return crs


def conversion_summary(target: str, done: Conversion) -> dict[str, Any]:
    """Returns what was written as plain values.

    Args:
        target: Where it was written.
        done: What ``convert_city`` returned.
    """
    model, mesh = done.model, done.mesh
    findings = {"findings": done.findings.counts(), "finding_objects": done.findings.objects()}
    summary: dict[str, Any] = {
        "written": target,
        "buildings": len(model.building_ids),
        "parts": model.num_parts,
        "crs": model.crs,
        "left_out": list(done.left_out),
    }
    if mesh is None:
        return summary | {"lods": list(model.lods), "polygons": len(model.polygons)} | findings
    return summary | {
        "lod": mesh.scene.lod,
        "origin": mesh.scene.origin.tolist(),
        "triangles": len(mesh.scene.triangles),
        "area_m2": round(mesh.area_m2, 3),
        "meshed_m2": round(mesh.meshed_m2, 3),
        "lost_m2": round(mesh.lost_m2, 3),
        "excess_m2": round(mesh.excess_m2, 3),
        **findings,
    }


def format_made(made: dict[str, Any]) -> str:
    """Returns what `city make` wrote as lines of text."""
    lines = [f"{made['written']}: LoD 1, {count_of(format(made['buildings'], ','), 'buildings')}"]
    lines += [f"CRS {crs_in_words(made['crs'])}"]
    lines += [f"  {count:>8,}  height from {source}" for source, count in made["heights_from"].items()]
    lines += [f"  {count:>8,}  ground from {source}" for source, count in made["grounds_from"].items()]
    lines += [f"  {count:>8,}  left out: {why}" for why, count in made["left_out"].items()]
    lines += [f"which from where: {made['page']}"]
    return "\n".join([*lines, *_finding_lines(made["findings"], made["finding_objects"])])


def format_conversion(summary: dict[str, Any]) -> str:
    """Returns what was written as lines of text."""
    buildings = count_of(format(summary["buildings"], ","), "buildings")
    if "lods" in summary:
        lods = ", ".join(filter(None, summary["lods"])) or "unnamed"
        parts = f", {count_of(format(summary['parts'], ','), 'parts')}" if summary["parts"] else ""
        what = f"LoD {lods}, {buildings}{parts}, {summary['polygons']:,} polygons"
        lines = [f"{summary['written']}: {what}", f"CRS {crs_in_words(summary['crs'])}"]
    else:
        lod = f"{lod_in_words(summary['lod'])}, " if summary["lod"] else ""
        what = f"{lod}{buildings}, {summary['triangles']:,} triangles"
        origin = " ".join(f"{value:.3f}" for value in summary["origin"])
        areas = "{area_m2:,.2f} m2 in, {meshed_m2:,.2f} m2 meshed".format(**summary)
        areas += ", {lost_m2:,.2f} m2 lost, {excess_m2:,.2f} m2 too much".format(**summary)
        lines = [
            f"{summary['written']}: {what}",
            areas,
            f"origin {origin}, CRS {crs_in_words(summary['crs'])}",
        ]
    lines += [f"left out: {line}" for line in summary["left_out"]]
    return "\n".join([*lines, *_finding_lines(summary["findings"], summary["finding_objects"])])


def _level_lines(lods: dict[str, dict[str, float]]) -> list[str]:
    rows = [["LoD", "polygons", "triangles", "area m2", "meshed m2", "lost m2"]]
    for name, row in lods.items():
        areas = [f"{row.get(key, 0.0):,.2f}" for key in ("area_m2", "meshed_m2", "lost_m2")]
        rows.append([name or "none", f"{row['polygons']:,}", f"{row['triangles']:,}", *areas])
    return format_columns(rows).splitlines()


def _finding_lines(findings: dict[str, int], objects: dict[str, int]) -> list[str]:
    """Returns a line per kind of finding: how often, in how many buildings, and what it means."""
    if not findings:
        return ["findings   none"]
    width = max(map(len, findings))
    kinds = "1 kind" if len(findings) == 1 else f"{len(findings)} kinds"
    rows = [f"findings   {kinds} (which and where: lodbench city check FILE)"]
    rows.append(f"  {'':{width}}  {'count':>8}  {'buildings':>9}")
    for name, count in findings.items():
        places = f"{objects[name]:,}" if objects.get(name) else "-"
        rows.append(f"  {name.ljust(width)}  {count:>8,}  {places:>9}  {_MEANINGS[name].meaning}")
    return rows
