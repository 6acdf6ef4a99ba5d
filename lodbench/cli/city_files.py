"""What `lodbench city convert` reads and where it writes, by the words on the command line."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from lodbench.errors import CityModelError


def from_and_to(asked: argparse.Namespace) -> tuple[list[Path], Path]:
    """Returns the files to convert and the one to write, whose folder is there then.

    Raises:
        CityModelError: There is nothing to convert, or the target is no format or may be one of the cities.
    """
    from lodbench.citymodel.convert import check_target

    files, out = (asked.files, asked.out) if asked.out is not None else (asked.files[:-1], asked.files[-1])
    if not files:
        raise CityModelError(
            f"There is nothing to convert {out} from.", "lodbench city convert FILE... -o OUT"
        )
    is_made = asked.tiles is not None and not out.parent.exists()  # the folder, with the first tile
    check_target(out.parent.with_name(out.name) if is_made else out)
    require_other(out, files)
    if asked.out is None and _may_be_a_tile(out, files):
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
