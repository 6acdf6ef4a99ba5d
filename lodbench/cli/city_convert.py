"""`lodbench city convert`: a city model, or a part of it, in another format."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodbench.citymodel.options import LAYERS, ReadOptions
from lodbench.cli.options import DATE_HELP, READ_SETTINGS, SourceProfile, load_profile
from lodbench.errors import CityModelError, ConfigError, require_choice
from lodbench.execution import ProgressCallback
from lodbench.params import flag, part, word

if TYPE_CHECKING:
    from lodbench.citymodel import CityModel
    from lodbench.citymodel.convert import Conversion

_PACKED = (".gz", ".zip")


@dataclass(frozen=True, kw_only=True)
class TileOptions:
    """How files are read, and how the answer is given."""

    crs: str | None = flag(
        None, "reference system of the coordinates, if the file names none or a wrong one", sets=("crs",)
    )
    date: str | None = flag(None, DATE_HELP, metavar="YYYY-MM-DD", sets=("date",))
    source: str = flag("folder", "publisher's profile, as in run source=PROFILE", metavar="PROFILE")
    option: tuple[str, ...] = flag((), "see below; may be repeated", metavar="KEY=VALUE", sets=READ_SETTINGS)
    layers: tuple[str, ...] = flag(
        (),
        f"objects besides buildings: {', '.join(LAYERS)}",
        metavar="NAME,...",
        type=lambda text: text.split(","),
        action="store",
    )
    json: bool = flag(False, "print JSON, for scripts")

    def profile(self) -> SourceProfile:
        """Returns how to read.

        Raises:
            ConfigError: The profile or an option is unknown.
        """
        profile = load_profile(self.source, self.option, self.crs, self.date)
        if self.layers:
            profile = replace(profile, options=replace(profile.options, layers=self.layers))
        return profile

    def write(self, values: dict[str, Any], as_text: Callable[[], str]) -> None:
        """Prints an answer."""
        text = json.dumps(values, indent=2, ensure_ascii=False) if self.json else as_text()
        sys.stdout.write(text + "\n")


@dataclass(frozen=True, kw_only=True)
class ConvertOptions:
    """What `city convert` is given."""

    files: tuple[Path, ...] = word(
        "city models, read as one; without -o the last name is OUT", metavar="FILE"
    )
    out: Path | None = flag(
        None, "file to write; its ending chooses the format", "-o", "--out", metavar="OUT"
    )
    tiles: float | None = flag(None, "write tiles of M metres, and an index of them", metavar="M")
    executor: str | None = flag(
        None, "what reads the tiles of a .scene (default: process)", choices=("serial", "process", "dask")
    )
    textures: bool = flag(False, "keep the textures of surfaces (.gml, .json, .jsonl, .glb, .obj)")
    workers: int | None = flag(None, "how many processes (default: one per core)")
    address: str | None = flag(None, "of Dask's scheduler")
    lod: str | None = flag(
        None,
        "level to write; finest: each building's best (default: all for CityJSON, the lowest for meshes)",
        sets=("lod",),
    )
    citygml: str | None = flag(None, "version of a .gml (default: 2.0)", choices=("2.0", "3.0"))
    to_crs: str | None = flag(None, "project to another reference system in metres", metavar="CRS")
    id: tuple[str, ...] = flag((), "only the building of this id; may be repeated")
    bbox: tuple[float, float, float, float] | None = flag(
        None,
        "only buildings whose middle lies inside, in the reference system written",
        metavar=("W", "S", "E", "N"),
    )
    where: tuple[str, ...] = flag(
        (),
        "only buildings with this attribute, or with a part that has it; may be repeated",
        metavar="ATTRIBUTE=VALUE",
    )
    roof_height: str | None = flag(
        None,
        "derive LoD1 where there is none: median, max, p70 or eave",
        metavar="RULE",
        sets=("roof_height",),
    )
    tiles_read: TileOptions = part(TileOptions)

    def is_whole(self, files: Sequence[Path]) -> bool:
        """Tells whether one file or folder is converted as it is: nothing chosen, cut or projected."""
        is_part = self.id or self.where or self.bbox or self.to_crs or self.tiles
        return len(files) == 1 and not is_part


def converted(
    wanted: ConvertOptions, options: ReadOptions, lod: str | None
) -> tuple[Path, list[tuple[Path, Conversion]] | None]:
    """Returns the target, and each file written with what it holds; None in place of a scene of many tiles.

    Args:
        wanted: What the command is given.
        options: How to read.
        lod: Level to write; None for all or the lowest, by the format.

    Raises:
        LodbenchError: A file cannot be read or written, or an option has no meaning for it.
    """
    from lodbench.citymodel.convert import (
        convert_city,
        convert_textured,
        convert_tiles,
        has_room_for_pictures,
        keeps_details,
    )
    from lodbench.citymodel.source import open_sources

    files, out = from_and_to(wanted)
    _require_heard(wanted, out, lod)
    if wanted.textures and not has_room_for_pictures(out):
        raise CityModelError(f"{out} has no room for pictures.", "Name it .glb, .obj, .json, .jsonl or .gml.")
    is_tiles = out.suffix == ".scene" and wanted.is_whole(files)
    if is_tiles and len(open_sources(files[0], options.layers)) > 1:
        _compile(wanted, files[0], out, options, lod)
        return out, None
    has_details = keeps_details(out) or bool(wanted.where) or wanted.textures
    options = replace(options, has_details=has_details, has_textures=wanted.textures)
    model = _chosen(wanted, read_city(files, options))
    is_mesh = wanted.textures and model.pictures is None
    if is_mesh and (keeps_details(out) or not wanted.is_whole(files) or files[0].suffix in _PACKED):
        raise CityModelError(
            f"Of {files[0].name} no pictures can be kept so.",
            "Those of a mesh are kept in .glb and .obj, of a whole file or folder. Or leave out --textures.",
        )

    def write(part: CityModel, target: Path) -> Conversion:
        if wanted.textures and not keeps_details(target):
            return convert_textured(part, target, files[0] if is_mesh else None, options)
        version = wanted.citygml or "2.0"
        how: dict[str, Any] = {"lod": lod, "roof_height": wanted.roof_height, "citygml": version}
        return convert_city(part, target, options=options, **how)

    if wanted.tiles is None:
        return out, [(out, write(model, out))]
    return out, [(each.target, each) for each in convert_tiles(model, out, wanted.tiles, write)]


def _require_heard(wanted: ConvertOptions, out: Path, lod: str | None) -> None:
    """Raises ConfigError if an option means nothing to what is written."""
    from lodbench.citymodel.derive import ROOF_HEIGHTS

    suffix = out.suffix.lower()
    is_gml = suffix in (".gml", ".xml", ".citygml")
    is_parallel = wanted.executor is not None or wanted.workers is not None or wanted.address is not None
    is_level_1 = lod is not None and lod.lower().removeprefix("lod") == "1"
    unheard = [
        ("--citygml", "without a .gml", wanted.citygml is not None and not is_gml),
        ("--executor, --workers or --address", "without a .scene", is_parallel and suffix != ".scene"),
        ("--roof-height", "without --lod 1", wanted.roof_height is not None and not is_level_1),
        ("--lod", "with --textures", wanted.lod and wanted.textures and suffix in (".glb", ".obj")),
    ]
    for option, how, is_unheard in unheard:
        if is_unheard:
            raise ConfigError(f"{option} is not used {how}.", f"Leave {option} out.")
    if wanted.roof_height is not None:
        require_choice("--roof-height", wanted.roof_height, ROOF_HEIGHTS)
    for pair in wanted.where:
        if "=" not in pair:
            raise ConfigError(f"--where {pair} names no value.", "It reads: --where ATTRIBUTE=VALUE")
    west, south, east, north = wanted.bbox or (0.0, 0.0, 1.0, 1.0)
    if not (west < east and south < north):
        raise ConfigError("--bbox holds nothing: its west is not below its east, or its south its north.")


def _chosen(wanted: ConvertOptions, model: CityModel) -> CityModel:
    """Returns the buildings requested, in the reference system requested."""
    from lodbench.citymodel.derive import choose_buildings, reproject, require_same_heights

    if wanted.to_crs is not None:
        require_same_heights(model, wanted.to_crs)
        model = reproject(model, wanted.to_crs)
    where = [pair.partition("=")[::2] for pair in wanted.where]
    return choose_buildings(model, ids=wanted.id, bbox=wanted.bbox, where=where)


def _compile(wanted: ConvertOptions, tiles: Path, out: Path, options: ReadOptions, lod: str | None) -> None:
    """Makes a scene of many tiles; goes on where it was stopped."""
    from lodbench.execution.executor import ExecutorParams
    from lodbench.harness.city import compile_tiles

    executor = ExecutorParams(wanted.executor or "process", wanted.workers, None, wanted.address)
    with ProgressCallback(f"compiling {tiles.name}", "tiles") as progress:
        compile_tiles(
            tiles, out, lod=lod, roof_height=wanted.roof_height, options=options, executor=executor,
            progress=progress,
        )  # fmt: skip


def read_city(files: Sequence[Path], options: ReadOptions) -> CityModel:
    """Returns a city of several files, with progress."""
    from lodbench.citymodel import read_city_model

    with ProgressCallback(f"reading {files[0].name}", "MB", 1_000_000) as progress:
        return read_city_model(files, options=options, progress=progress)


def from_and_to(wanted: ConvertOptions) -> tuple[list[Path], Path]:
    """Returns the files to convert and the one to write, whose folder is there then.

    Raises:
        CityModelError: There is nothing to convert, or the target is no format or may be one of the cities.
    """
    from lodbench.citymodel.convert import check_target

    files, out = wanted.files, wanted.out
    if out is None:
        files, out = files[:-1], files[-1]
    if not files:
        raise CityModelError(
            f"There is nothing to convert {out} from.", "lodbench city convert FILE... -o OUT"
        )
    is_made = wanted.tiles is not None and not out.parent.exists()  # the folder, with the first tile
    check_target(out.parent.with_name(out.name) if is_made else out)
    require_other(out, files)
    if wanted.out is None and _may_be_a_tile(out, files):
        raise CityModelError(
            f"{out} is there already, and may be one of the tiles: nothing is written over it.",
            f"Name a new file, -o OUT, or say that it is meant: -o {out}.",
        )
    return _once(files), out


def _once(files: Sequence[Path]) -> list[Path]:
    """Returns files less those named twice, or lying in a folder named too; standard error says which."""
    read: dict[Path, Path] = {}
    for file in files:
        place = file.resolve()
        folder = next((each for each in files if each != file and each.resolve() in place.parents), None)
        if place in read or folder is not None:
            how = f"lies in {folder}" if folder is not None else "is named twice"
            sys.stderr.write(f"lodbench: {file} {how}: it is read once.\n")
        else:
            read[place] = file
    return list(read.values())


def _may_be_a_tile(out: Path, files: Sequence[Path]) -> bool:
    """Tells whether the last word is a city of which no -o says that it is written: ``*.gml`` ends so."""
    from lodbench.citymodel.source import is_city_file

    first = files[0]
    is_neighbour = out.suffix == first.suffix and out.resolve().parent == first.resolve().parent
    return is_city_file(out) and (len(files) > 1 or is_neighbour)


def require_other(out: Path, files: Sequence[Path]) -> None:
    """Raises CityModelError if a file to write is one of those to read, or would be from then on."""
    place = out.resolve()
    for file in files:
        if place == file.resolve():
            raise CityModelError(f"{out} is the city itself.", "Choose another name to write to.")
        if file.is_dir() and place.is_relative_to(file.resolve()):
            raise CityModelError(
                f"{out} lies in the folder that is read, and would be one of its tiles.",
                f"Write it outside of {file}.",
            )
