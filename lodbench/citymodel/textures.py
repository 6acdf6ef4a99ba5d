"""Pictures on the surfaces of cities: which lies on which polygon and where, for all formats.

A reader says of a polygon which picture it has and where its corners lie on it: ``SurfaceTextures`` numbers
the pictures, looks for them in a ``TextureFolder``, which nothing leads out of, and notes what is not kept. A
writer has files, names and places from ``WrittenPictures``. What is rendered: ``textured_map``.
"""

from __future__ import annotations

import io
import re
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple, TypeVar
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from lodbench import storage
from lodbench.citymodel.model import FIRST_COLOUR, NO_PICTURE, CityModel, Colour, Pictures, Polygons
from lodbench.errors import DatasetError

Floats = NDArray[np.float64]

_WRAPS = ("", "none", "wrap", "mirror", "clamp", "border")


class Image(NamedTuple):
    """A picture by its name in a city file, and how it goes on beyond its edges (``Pictures.wraps``)."""

    name: str
    wrap: str = ""


class SurfaceTextures:
    """The pictures and colours of the polygons of a city file, as its reader says them polygon by polygon.

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
        self._numbers: dict[Image, int] = {}
        self._colours: dict[Colour, int] = {}
        # Number and places of each polygon that has a picture; number and None of each that has a colour.
        self._laid: dict[int, tuple[int, Floats | None]] = {}

    def lay(
        self,
        polygon: int,
        lengths: Sequence[int],
        rings: Sequence[tuple[Image | None, Floats] | None],
        *,
        has_closing_points: bool = False,
        is_flipped: bool = False,
    ) -> bool:
        """Lays the picture of its outline on a polygon; returns whether it lies there.

        Holes of which nothing is said, or something that does not fit, lie nowhere on it (NaN).

        Args:
            polygon: Its number, as for ``finish``.
            lengths: How many corners each ring has.
            rings: Of each ring the picture, None for one that the file lacks, and (n, 2) places of its
                corners on it; None for a ring of which nothing is said.
            has_closing_points: Whether rings end with their first corner again, which places may leave out.
            is_flipped: Whether the reader turned the rings round.
        """
        image = rings[0][0] if rings[0] is not None else None
        number = NO_PICTURE if image is None else self._number(image)
        if number == NO_PICTURE:
            self.notes["surface whose picture is not there"] += 1
            return False
        places = [np.full((length, 2), np.nan) for length in lengths]
        for own, ring in zip(places, rings, strict=False):
            if ring is not None and ring[0] == image:
                stated = ring[1]
                if has_closing_points and len(stated) == len(own) - 1:
                    stated = np.concatenate([stated, stated[:1]])
                if len(stated) == len(own) and np.isfinite(stated).all():
                    own[:] = stated[::-1] if is_flipped else stated
        if not np.isfinite(places[0]).all():
            self.notes["surface whose places on its picture do not fit its corners"] += 1
            return False
        self._laid[polygon] = number, np.concatenate(places)
        return True

    def paint(self, polygon: int, colour: Colour) -> None:
        """Gives a polygon without a picture a colour of its own."""
        self._laid[polygon] = self._colours.setdefault(colour, FIRST_COLOUR - len(self._colours)), None

    def _number(self, image: Image) -> int:
        """Returns the number of a picture, ``NO_PICTURE`` where there is none to be had."""
        name, wrap = image
        if wrap not in _WRAPS:
            self.notes[f"wrapMode {wrap[:40]!r} of a picture"] += 1
            wrap = ""
        image = Image(name, wrap)
        if image not in self._numbers:
            number = self._numbers[image] = self._look(name)
            self._wraps += [wrap] * (number != NO_PICTURE)
        return self._numbers[image]

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

    def finish(
        self, polygons: NDArray[np.int64], firsts: NDArray[np.int64]
    ) -> tuple[Pictures, NDArray[np.int32], Floats]:
        """Returns all pictures, that of each polygon and the place of each point on it, as in ``Polygons``.

        Args:
            polygons: (N,) number of each polygon that is there.
            firsts: (N + 1,) first point of each.
        """
        picture, uv = _blank(len(polygons), int(firsts[-1]))
        for n, polygon in enumerate(polygons.tolist() if self._laid else ()):
            if polygon in self._laid:
                picture[n], places = self._laid[polygon]
                if places is not None:
                    uv[firsts[n] : firsts[n + 1]] = places
        notes = counted_lines(self.notes)
        return Pictures(tuple(self._files), notes, tuple(self._colours), tuple(self._wraps)), picture, uv


def counted_lines(notes: Counter[str]) -> tuple[str, ...]:
    """Returns what was left out, a line each."""
    return tuple(f"{count} x {text}" if count > 1 else text for text, count in sorted(notes.items()))


def _blank(num_polygons: int, num_points: int) -> tuple[NDArray[np.int32], Floats]:
    """Returns the numbers and places of polygons without a picture."""
    return np.full(num_polygons, NO_PICTURE, np.int32), np.full((num_points, 2), np.nan)


def merge_textures(
    parts: Sequence[tuple[Pictures | None, NDArray[np.int32] | None, Floats | None, int, int]],
) -> tuple[Pictures | None, NDArray[np.int32] | None, Floats | None]:
    """Returns the pictures of several tiles as one, with the numbers of polygons and places of points.

    Args:
        parts: Of each tile its pictures, as in ``RawCity``, and how many polygons and points it has.
    """
    if all(pictures is None for pictures, *_ in parts):
        return None, None, None
    numbers, places = [], []
    files: list[Path] = []
    notes: list[str] = []
    colours: list[Colour] = []
    wraps: list[str] = []
    for pictures, picture, uv, num_polygons, num_points in parts:
        if picture is None or uv is None:
            picture, uv = _blank(num_polygons, num_points)
        shift = np.where(picture >= 0, len(files), np.where(picture <= FIRST_COLOUR, -len(colours), 0))
        numbers.append((picture + shift).astype(np.int32))
        places.append(uv)
        if pictures is not None:
            files += pictures.files
            notes += pictures.notes
            colours += pictures.colours
            wraps += pictures.wraps
    merged = Pictures(tuple(files), tuple(notes), tuple(colours), tuple(wraps))
    return merged, np.concatenate(numbers), np.concatenate(places)


_SUFFIXES = {"JPEG": ".jpg", "PNG": ".png"}
_NOT_IN_NAMES = re.compile(r"[^A-Za-z0-9_-]+")
_MAX_STEM = 40
_LOST_LOOKS = "pictures of surfaces (--textures keeps them) or materials (which it does not)"


@dataclass(frozen=True, slots=True)
class WrittenPictures:
    """The pictures of a city that lie beside a file of it, as the file says which lies on what."""

    # Link from the file, and wrap as in ``Pictures.wraps``, of each picture that is there, by number
    images: dict[int, Image] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # what is not kept of pictures and colours, a line each

    def on_ring(self, polygons: Polygons, polygon: int, points: slice) -> tuple[int, Floats] | None:
        """Returns the number of the picture on a ring and (n, 2) places of its corners, None without one.

        Args:
            polygons: Of the city.
            polygon: That of the ring.
            points: The ring's points among those of the city.
        """
        if polygons.picture is None or polygons.uv is None:
            return None
        number, places = int(polygons.picture[polygon]), polygons.uv[points]
        return (number, places) if number in self.images and np.isfinite(places).all() else None


def write_pictures(model: CityModel, target: Path) -> WrittenPictures:
    """Writes the pictures that a city's polygons use into a folder beside a file, before that is written.

    JPEG and PNG are copied byte by byte, other formats saved as PNG, which every target knows. Names are a
    number and what is harmless of the name they had.

    Args:
        model: The city.
        target: The file; the folder is called after it, ``NAME_pictures``.

    Raises:
        OSError: The folder cannot be written.
    """
    if model.pictures is None:
        return WrittenPictures(notes=(_LOST_LOOKS,) if model.has_textures else ())
    picture = np.zeros(0, np.int32) if model.polygons.picture is None else model.polygons.picture
    images: dict[int, Image] = {}
    written: dict[Path, str] = {}
    lost: list[str] = []
    folder = target.with_name(f"{target.name.partition('.')[0]}_pictures")
    for number in np.unique(picture[picture >= 0]).tolist():
        path = model.pictures.files[number]
        if path not in written:
            try:
                content, suffix = _portable(path)
            except DatasetError as error:
                lost.append(f"picture that is not taken: {error.message}")
                continue
            stem = _NOT_IN_NAMES.sub("_", path.stem)[:_MAX_STEM].strip("_")
            name = "_".join(filter(None, (f"{len(written) + 1:04d}", stem))) + suffix
            storage.make_folder(folder)
            if (folder / name).exists() and (folder / name).read_bytes() != content:
                # Of another file of this stem, as town.gml has beside town.city.json.
                name = f"{Path(name).stem}_{sha256(content).hexdigest()[:8]}{suffix}"
            storage.write_bytes(folder / name, content)
            # As a link, in which % begins a code.
            written[path] = f"{folder.name}/{name}".replace("%", "%25")
        images[number] = Image(written[path], model.pictures.wraps[number])
    coloured = Counter({"surface with a material: its colour": int((picture <= FIRST_COLOUR).sum())})
    return WrittenPictures(images, (*model.pictures.notes, *counted_lines(+coloured), *lost))


def _portable(path: Path) -> tuple[bytes, str]:
    """Returns a picture as JPEG or PNG, and the ending that it gets."""
    folder = TextureFolder(path.parent, path.parent)
    content = folder.read(path.name)
    suffix = _SUFFIXES.get(_look_at(content, path.name, lambda image: str(image.format)))
    return (png_of(folder.picture(path.name)), ".png") if suffix is None else (content, suffix)


def png_of(picture: NDArray[np.uint8]) -> bytes:
    """Returns (H, W, 3) RGB pixels as a PNG."""
    from PIL import Image as PillowImage

    content = io.BytesIO()
    PillowImage.fromarray(picture).save(content, "PNG")
    return content.getvalue()


T = TypeVar("T")

_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP")
# One picture, its file and its pixels; and the pixels of all pictures of a map, which are held at once.
_MAX_FILE_BYTES, _MAX_PIXELS, _MAX_ALL_PIXELS = 1 << 29, 1 << 27, 1 << 30


class TextureFolder:
    """The files below a folder, by the names that a city file gives them.

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


GREY: Colour = (170, 170, 170)  # of what has neither picture nor colour


class TexturedPart(NamedTuple):
    """Triangles of a map under one picture, or in colours."""

    corners: Floats  # (T, 3, 3) metres
    uv: Floats = np.zeros(2)  # (T, 3, 2) places of the corners on the picture
    picture: NDArray[np.uint8] | None = None  # (H, W, 3) RGB
    colours: NDArray[np.uint8] = np.array(GREY, np.uint8)  # RGB without a picture, (T, 3, 3) or one for all


def read_pictures(paths: Sequence[Path], source: str) -> tuple[NDArray[np.uint8], ...]:
    """Returns pictures, (H, W, 3) RGB, of a city.

    Raises:
        DatasetError: One cannot be read, or they have more pixels than can be held at once.
    """
    folders = [(path.name, TextureFolder(path.parent, path.parent)) for path in paths]
    require_room(
        sum(int(np.prod(folder.size(name))) for name, folder in folders),
        f"The pictures of {source} have",
        "Take tiles of it, or save the pictures smaller; CityJSON and CityGML copy them as they are.",
    )
    return tuple(folder.picture(name) for name, folder in folders)


def require_room(num_pixels: int, what: str, hint: str) -> None:
    """Raises DatasetError if all pictures of a map have more pixels than can be held at once.

    Args:
        num_pixels: Of all.
        what: Which have them, the beginning of a sentence: "The pictures of FILE have".
        hint: What to do.
    """
    if num_pixels > _MAX_ALL_PIXELS:
        held = f"{num_pixels / 1e9:.1f} gigapixels; {_MAX_ALL_PIXELS / 1e9:.1f} are held at once."
        raise DatasetError(f"{what} {held}", hint)
