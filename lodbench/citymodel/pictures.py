"""Pictures of a city's surfaces: which one lies on which polygon, and where on it."""

from __future__ import annotations

import io
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.model import FIRST_COLOUR, NO_PICTURE, Colour, Pictures
from lodbench.errors import DatasetError

WRAPS = ("", "none", "wrap", "mirror", "clamp", "border")


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


def counted_lines(notes: Counter[str]) -> tuple[str, ...]:
    """Returns what was left out, a line each."""
    return tuple(f"{count} x {text}" if count > 1 else text for text, count in sorted(notes.items()))


T = TypeVar("T")

_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP")
# One picture, its file and its pixels; and the pixels of all pictures of a map, which are held at once.
_MAX_FILE_BYTES, _MAX_PIXELS = 1 << 29, 1 << 27
MAX_ALL_PIXELS = 1 << 30


class TextureFolder:
    """The files below a folder, by the names that a mesh file gives them.

    Args:
        root: Nothing outside of it is opened, whatever a name or a link says.
        base: Where names start from.
    """

    def __init__(self, root: Path, base: Path) -> None:
        self._root, self._base = root.resolve(), base

    def path(self, name: str) -> Path | None:
        """Returns the file of a name, or None where there is none.

        Raises:
            DatasetError: The name leads out of the folder, or to a network.
        """
        plain = unquote(name).replace("\\", "/").strip()
        path = self._base / plain
        try:
            is_inside = path.resolve().is_relative_to(self._root)
            is_file = is_inside and path.is_file()
        except (OSError, ValueError):  # a name too long, or with a NUL
            return None
        if "://" in plain or not is_inside:
            raise DatasetError(
                f"{name[:120]!r} leads out of the folder {self._root}.",
                "Put all files of a textured map into one folder, and name them as they lie there.",
            )
        return path if is_file else None

    def below(self, name: str) -> TextureFolder:
        """Returns the same folder, for names that start from one within it."""
        return TextureFolder(self._root, self._base / name)

    def read(self, name: str) -> bytes:
        """Returns a file's content.

        Raises:
            DatasetError: There is no such file, it lies outside, or it is too large.
        """
        path = self.path(name)
        if path is None:
            raise DatasetError(f"{name[:120]!r} is not there.", f"Put it into {self._base}.")
        if path.stat().st_size > _MAX_FILE_BYTES:
            raise DatasetError(f"{path} is larger than {_MAX_FILE_BYTES >> 20} MiB.", "Cut it into tiles.")
        return path.read_bytes()

    def picture(self, name: str) -> NDArray[np.uint8]:
        """Returns a picture's (H, W, 3) RGB pixels.

        Raises:
            DatasetError: As for ``read``, it is not a picture, or has too many pixels.
        """
        return self._opened(name, lambda image: pixels_of(image, name))

    def size(self, name: str) -> tuple[int, int]:
        """Returns width and height of a picture, which is not decoded.

        Raises:
            DatasetError: As for ``read``, or it is not a picture.
        """
        return self._opened(name, lambda image: (int(image.size[0]), int(image.size[1])))

    def kind(self, name: str) -> str:
        """Returns the format of a picture, ``PNG`` or ``JPEG`` for example, whatever its ending says.

        Raises:
            DatasetError: As for ``read``, or it is not a picture.
        """
        return self._opened(name, lambda image: str(image.format))

    def check_picture(self, name: str) -> None:
        """Makes sure by its header that ``picture`` can take a file.

        Raises:
            DatasetError: As for ``picture``.
        """
        check_picture(self.read(name), name)

    def _opened(self, name: str, look: Callable[[Any], T]) -> T:
        """Returns what a look at a picture, not decoded yet, finds."""
        return _look_at(self.read(name), name, look)


def check_picture(content: bytes, name: str) -> None:
    """Makes sure by its header that a picture can be taken.

    Raises:
        DatasetError: It is not a picture, or has too many pixels.
    """
    _look_at(content, name, lambda image: require_size(image, name))


def _look_at(content: bytes, name: str, look: Callable[[Any], T]) -> T:
    """Returns what a look at a picture, not decoded yet, finds."""
    from PIL import Image, UnidentifiedImageError

    try:
        # Its own limit is reported in other words, and far lower.
        with warnings.catch_warnings(action="ignore", category=Image.DecompressionBombWarning):
            with Image.open(io.BytesIO(content), formats=_FORMATS) as image:
                return look(image)
    except DatasetError:
        raise
    except Exception as error:  # Pillow lets the errors of every decoder through
        # Of what it does not know it names the object in memory.
        why = "" if isinstance(error, UnidentifiedImageError) else f" ({error})"
        raise DatasetError(
            f"{name[:120]!r} cannot be read as a picture{why}.", f"One of {', '.join(_FORMATS)}."
        ) from None


def require_size(image: Any, name: str) -> None:
    """Makes sure that a Pillow image is not too large to be held.

    Raises:
        DatasetError: It has too many pixels.
    """
    width, height = image.size
    if width * height > _MAX_PIXELS:
        raise DatasetError(
            f"{name[:120]!r} has {width} x {height} pixels, more than {_MAX_PIXELS >> 20} million.",
            "Cut the map into tiles, or save its pictures smaller.",
        )


def pixels_of(image: Any, name: str) -> NDArray[np.uint8]:
    """Returns the (H, W, 3) RGB pixels of a Pillow image, which is decoded only now.

    Of 16 bits the upper 8 are kept.

    Raises:
        DatasetError: It has too many pixels, or numbers of 32 bits, of which none is known to be white.
    """
    require_size(image, name)
    # Pillow would cut off at 255 what has more than 8 bits. Older ones call grey PNGs of 16 bits "I".
    if image.mode.startswith("I;16") or (image.mode == "I" and image.format == "PNG"):
        grey = (np.asarray(image) >> 8).astype(np.uint8)
        return np.repeat(grey[..., None], 3, axis=-1)
    if image.mode in ("I", "F"):
        raise DatasetError(f"{name[:120]!r} has pixels of 32 bits.", "Save it with 8 bits a colour.")
    return np.asarray(image.convert("RGB"), dtype=np.uint8)
