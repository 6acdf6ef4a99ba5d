"""`lodbench city info|check|convert|make`: look into a city model, write it otherwise, or make one."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodbench.citymodel.options import ReadOptions
from lodbench.cli.city_files import from_and_to, require_other
from lodbench.cli.city_parser import city_parser
from lodbench.cli.source_profiles import load_profile
from lodbench.errors import CityModelError, ConfigError, require_choice
from lodbench.execution import ProgressCallback

if TYPE_CHECKING:
    from lodbench.citymodel import CityModel
    from lodbench.citymodel.convert import Conversion


_PACKED = (".gz", ".zip")


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code: 1 if `check` finds an error."""
    asked = city_parser().parse_args(argv)
    if asked.action == "info" and (asked.file / "scene.json").is_file():
        return _scene_info(asked)
    profile = load_profile(asked.source, asked.option, asked.crs, asked.date)
    if asked.layers:
        profile = replace(profile, options=replace(profile.options, layers=asked.layers))
    if asked.action == "info":
        return _info(asked, profile.options)
    if asked.action == "check":
        return _check(asked, profile.options)
    if asked.action == "make":
        return _make(asked, profile.options)
    return _convert(asked, profile.options, asked.lod or profile.lod)


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
    from lodbench.citymodel.checks.report import check_city, findings_geojson, format_report
    from lodbench.citymodel.source import OWN_GEOJSON, file_source, own_geojson
    from lodbench.storage import write_bytes

    if asked.geojson is not None:
        is_ours = own_geojson(file_source(asked.geojson)) == OWN_GEOJSON["lodbench"]
        if not is_ours and (asked.geojson.exists() or asked.geojson.suffix.lower() != ".geojson"):
            require_other(asked.geojson, [asked.file])
        if asked.geojson.is_dir() or not asked.geojson.parent.is_dir():
            raise CityModelError(
                f"{asked.geojson} is not a file in a folder that is there.", "--geojson FILE"
            )
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
    from lodbench.citymodel.convert import (
        convert_city,
        convert_textured,
        convert_tiles,
        has_room_for_pictures,
        keeps_details,
    )
    from lodbench.citymodel.source import open_sources
    from lodbench.cli.city_text import conversion_summary, format_conversion

    files, out = from_and_to(asked)
    _require_heard(asked, out, lod)
    if asked.textures and not has_room_for_pictures(out):
        raise CityModelError(f"{out} has no room for pictures.", "Name it .glb, .obj, .json, .jsonl or .gml.")
    is_tiles = out.suffix == ".scene" and _is_whole(asked, files)
    if is_tiles and len(open_sources(files[0], options.layers)) > 1:
        return _compile(asked, files[0], out, options, lod)
    has_details = keeps_details(out) or bool(asked.where) or asked.textures
    options = replace(options, has_details=has_details, has_textures=asked.textures)
    model = _chosen(asked, _read(files, options))
    is_mesh = asked.textures and model.pictures is None
    if is_mesh and (keeps_details(out) or not _is_whole(asked, files) or files[0].suffix in _PACKED):
        raise CityModelError(
            f"Of {files[0].name} no pictures can be kept so.",
            "Those of a mesh are kept in .glb and .obj, of a whole file or folder. Or leave out --textures.",
        )

    def write(part: CityModel, target: Path) -> Conversion:
        if asked.textures and not keeps_details(target):
            return convert_textured(part, target, files[0] if is_mesh else None, options)
        version = asked.citygml or "2.0"
        how = {"lod": lod, "roof_height": asked.roof_height, "citygml": version}
        return convert_city(part, target, options=options, **how)

    if asked.tiles is None:
        summaries = [conversion_summary(str(out), write(model, out))]
    else:
        done = convert_tiles(model, out, asked.tiles, write)
        summaries = [conversion_summary(str(each.target), each) for each in done]
    values = summaries[0] if asked.tiles is None else {"tiles": summaries}
    _write(asked, values, lambda: "\n".join(map(format_conversion, summaries)))
    return 0


def _make(asked: argparse.Namespace, options: ReadOptions) -> int:
    """Writes footprints as buildings, and the page that says where their heights come from."""
    from lodbench.citymodel.convert import check_target
    from lodbench.cli.city_text import format_made
    from lodbench.harness.city_make import make_city

    check_target(asked.out)
    given = [path for path in (asked.footprints, asked.dsm, asked.dtm) if path is not None]
    require_other(asked.out, given)
    surface, terrain = (None if path is None else str(path) for path in (asked.dsm, asked.dtm))
    options = replace(options, surface=surface or options.surface, terrain=terrain or options.terrain)
    with ProgressCallback(f"reading {asked.footprints.name}", "MB", 1_000_000) as progress:
        made = make_city(asked.footprints, asked.out, options, progress)
    _write(asked, made, lambda: format_made(made))
    return 0


def _is_whole(asked: argparse.Namespace, files: Sequence[Path]) -> bool:
    """Tells whether one file or folder is converted as it is: nothing chosen, cut, joined or projected."""
    is_part = asked.id or asked.where or asked.bbox or asked.to_crs or asked.tiles
    return len(files) == 1 and not is_part


def _require_heard(asked: argparse.Namespace, out: Path, lod: str | None) -> None:
    """Raises ConfigError if an option means nothing to what is written."""
    from lodbench.citymodel.derive import ROOF_HEIGHTS

    suffix = out.suffix.lower()
    is_gml = suffix in (".gml", ".xml", ".citygml")
    is_parallel = asked.executor is not None or asked.workers is not None or asked.address is not None
    is_level_1 = lod is not None and lod.lower().removeprefix("lod") == "1"
    unheard = [
        ("--citygml", "without a .gml", asked.citygml is not None and not is_gml),
        ("--executor, --workers or --address", "without a .scene", is_parallel and suffix != ".scene"),
        ("--roof-height", "without --lod 1", asked.roof_height is not None and not is_level_1),
        ("--lod", "with --textures", asked.lod and asked.textures and suffix in (".glb", ".obj")),
    ]
    for option, how, is_unheard in unheard:
        if is_unheard:
            raise ConfigError(f"{option} is not used {how}.", f"Leave {option} out.")
    if asked.roof_height is not None:
        require_choice("--roof-height", asked.roof_height, ROOF_HEIGHTS)
    for pair in asked.where:
        if "=" not in pair:
            raise ConfigError(f"--where {pair} names no value.", "It reads: --where ATTRIBUTE=VALUE")
    west, south, east, north = asked.bbox or (0.0, 0.0, 1.0, 1.0)
    if not (west < east and south < north):
        raise ConfigError("--bbox holds nothing: its west is not below its east, or its south its north.")


def _chosen(asked: argparse.Namespace, model: CityModel) -> CityModel:
    """Returns the buildings asked for, in the reference system asked for."""
    from lodbench.citymodel.subset import choose_buildings, reproject, require_same_heights

    if asked.to_crs is not None:
        require_same_heights(model, asked.to_crs)
        model = reproject(model, asked.to_crs)
    bbox = None if asked.bbox is None else tuple(asked.bbox)
    where = [pair.partition("=")[::2] for pair in asked.where]
    return choose_buildings(model, ids=asked.id, bbox=bbox, where=where)


def _compile(asked: argparse.Namespace, tiles: Path, out: Path, options: ReadOptions, lod: str | None) -> int:
    """Makes a scene of many tiles; goes on where it was stopped."""
    from lodbench.citymodel.scene_file import scene_info
    from lodbench.cli.city_text import format_scene
    from lodbench.execution.executor import ExecutorParams
    from lodbench.harness.tiled_city import compile_tiles

    executor = ExecutorParams(asked.executor or "process", asked.workers, None, asked.address)
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
