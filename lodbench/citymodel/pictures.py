"""Pictures of a city's surfaces: which one lies on which polygon, and where on it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.texture_pictures import TextureFolder
from lodbench.errors import DatasetError

NO_PICTURE = -1
# From here downward a polygon has no picture but the colour of its material.
FIRST_COLOUR = -2
WRAPS = ("", "none", "wrap", "mirror", "clamp", "border")
Colour = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Pictures:
    """The pictures of a city; polygons name them by number (``Polygons.picture``, ``Polygons.uv``).

    Attributes:
        files: Where each lies.
        wraps: How each goes on beyond its edges, in the word of CityGML, "" where nothing is said.
        notes: What of the source's appearances is not kept, a line each.
        colours: RGB of materials; a polygon without a picture has number ``FIRST_COLOUR - k`` for the k-th.
    """

    files: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()
    colours: tuple[Colour, ...] = ()
    wraps: tuple[str, ...] = ()


def wraps_of(pictures: Pictures | None) -> dict[int, str]:
    """Returns how pictures go on beyond their edges, by number, where the source says it."""
    return {} if pictures is None else {n: wrap for n, wrap in enumerate(pictures.wraps) if wrap}


class PictureTable:
    """Numbers the pictures that a city file names, as they are met.

    Args:
        folder: Where pictures may lie, and where their names start; others are never opened.
        is_packed: Whether the file is a member of an archive, and its pictures too.

    Attributes:
        folder: Where names start from.
        notes: How often something is not kept, by what.
    """

    def __init__(self, folder: TextureFolder, is_packed: bool = False) -> None:
        self.folder = folder
        self.notes: Counter[str] = Counter()
        self._is_packed = is_packed
        self._files: list[Path] = []
        self._wraps: list[str] = []
        self._numbers: dict[tuple[str, str], int] = {}
        self._colours: dict[Colour, int] = {}

    def number(self, name: str, wrap: str = "") -> int:
        """Returns the number of a picture by its name in the file, -1 where there is none to be had.

        Args:
            name: As the file has it.
            wrap: As of ``Pictures.wraps``; words of no standard are noted, and left out.
        """
        if wrap not in WRAPS:
            self.notes[f"wrapMode {wrap[:40]!r} of a picture"] += 1
            wrap = ""
        if (name, wrap) not in self._numbers:
            number = self._numbers[name, wrap] = self._look(name)
            self._wraps += [wrap] * (number != NO_PICTURE)
        return self._numbers[name, wrap]

    def colour(self, colour: Colour) -> int:
        """Returns the number that a polygon has for a colour of its own."""
        return self._colours.setdefault(colour, FIRST_COLOUR - len(self._colours))

    def _look(self, name: str) -> int:
        try:
            path = None if self._is_packed else self.folder.path(name)
            if path is not None:
                self.folder.check_picture(name)
        except DatasetError as error:
            self.notes[f"picture that is not taken: {error.message}"] += 1
            return NO_PICTURE
        if path is None:
            what = "an archive, unpack it" if self._is_packed else "not there"
            self.notes[f"picture that is {'in ' * self._is_packed}{what}: {name[:120]}"] += 1
            return NO_PICTURE
        self._files.append(path)
        return len(self._files) - 1

    def finish(self) -> Pictures:
        """Returns all that were met."""
        notes = counted_lines(self.notes)
        return Pictures(tuple(self._files), notes, tuple(self._colours), tuple(self._wraps))


def merge_pictures(
    parts: Sequence[tuple[Pictures | None, NDArray[np.int32] | None, NDArray[np.float64] | None, int, int]],
) -> tuple[Pictures | None, NDArray[np.int32] | None, NDArray[np.float64] | None]:
    """Returns the pictures of several tiles as one, with the numbers of polygons and places of points.

    Args:
        parts: Of each tile its pictures, as in ``RawCity``, and how many polygons and points it has.
    """
    if all(pictures is None for pictures, *_ in parts):
        return None, None, None
    files: list[Path] = []
    numbers, places = [], []
    notes: list[str] = []
    colours: list[Colour] = []
    wraps: list[str] = []
    for pictures, picture, uv, num_polygons, num_points in parts:
        if picture is None or uv is None:
            picture, uv = blank(num_polygons, num_points)
        shift = np.where(picture >= 0, len(files), np.where(picture <= FIRST_COLOUR, -len(colours), 0))
        numbers.append((picture + shift).astype(np.int32))
        places.append(uv)
        if pictures is not None:
            files += pictures.files
            notes += pictures.notes
            colours += pictures.colours
            wraps += pictures.wraps
    return (
        Pictures(tuple(files), tuple(notes), tuple(colours), tuple(wraps)),
        np.concatenate(numbers),
        np.concatenate(places),
    )


def blank(num_polygons: int, num_points: int) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Returns the numbers and places of polygons without a picture."""
    return np.full(num_polygons, NO_PICTURE, np.int32), np.full((num_points, 2), np.nan)


def counted_lines(notes: Counter[str]) -> tuple[str, ...]:
    """Returns what was left out, a line each."""
    return tuple(f"{count} x {text}" if count > 1 else text for text, count in sorted(notes.items()))


def details_wanted(path: Path, name: str, options: ReadOptions) -> dict[str, Any]:
    """Returns the arguments that readers of details, attributes and pictures, share.

    Args:
        path: The file on disk that holds the city.
        name: Its name for messages, with the member of an archive after an exclamation mark.
        options: How to read it.
    """
    folder = TextureFolder(path.parent, path.parent)
    has_pictures = options.has_textures and options.has_details
    return {
        "is_strict": options.is_strict,
        "has_details": options.has_details,
        "layers": options.layers,
        "day": options.date,
        "pictures": PictureTable(folder, is_packed="!" in name) if has_pictures else None,
    }
