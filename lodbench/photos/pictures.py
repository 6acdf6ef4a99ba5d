"""Pixels from files: read through numpy, since OpenCV's own file call cannot open every path."""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import DatasetError
from lodbench.storage.digest import read_content

# Tags of TIFF.
_WIDTH, _HEIGHT, _ORIENTATION = 0x0100, 0x0101, 0x0112
_SHORT = 3
# How a TIFF begins: the order of its bytes, and whether it is a BigTIFF.
_TIFFS = {b"II*\0": ("<", False), b"MM\0*": (">", False), b"II+\0": ("<", True), b"MM\0+": (">", True)}
_JPEG = b"\xff\xd8\xff"
_PNG, _PNG_PIXELS = b"\x89PNG\r\n\x1a\n", (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")
# OpenCV's level before each silence that lasts: it is the process's, and the last thread to end restores the
# first one.
_LOCK, _levels = Lock(), list[int]()
# No degrees, in Celsius or Kelvin: programs write -9999 and the like where a thermal photo has no number.
_ABSOLUTE_ZERO_C = -273.15
# Beyond this many times the range of all but the outermost percents, a pixel is dead or has no number.
_OUTER_PERCENT, _STRAY_RANGES = 1.0, 2.0
# Pixels that tell the range of the rest, at least.
_SAMPLED = 1 << 20


def read_picture(path: Path, *, as_stored: bool = False) -> NDArray[Any] | None:
    """Returns a picture's pixels, unturned: intrinsics belong to the pixels as they are stored.

    Args:
        path: The file.
        as_stored: With its own channels and depth; else as (H, W, 3) BGR of 8 bits, to which 16 are brought
            over the range in use.

    Returns:
        (H, W) or (H, W, C); None if the file cannot be read or decoded, or has too many pixels.

    Raises:
        InputChanged: It is not what it was when the work began.
    """
    try:
        content = read_content(path)
    except OSError:
        return None
    return None if has_too_many_pixels(content) else decoded(content, as_stored=as_stored)


def decoded(content: bytes, *, as_stored: bool) -> NDArray[Any] | None:
    """Returns the pixels of a picture's file, as `read_picture` does; None if it cannot be decoded."""
    content = _unturned(_plain_png(content))
    picture = _jpeg_pixels(content) if content.startswith(_JPEG) else _opencv_pixels(content, as_stored)
    if picture is None or as_stored:
        return picture
    if picture.ndim == 3 and picture.shape[2] != 3:
        return None
    in_use = in_8_bits(picture)
    return in_use if in_use.ndim == 3 else np.repeat(in_use[..., None], 3, axis=2)


def _opencv_pixels(content: bytes, as_stored: bool) -> NDArray[Any] | None:
    import cv2

    if not content:
        return None
    in_colour = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    flags = cv2.IMREAD_UNCHANGED if as_stored else in_colour
    coded = np.frombuffer(content, dtype=np.uint8)
    try:
        with opencv_silenced():
            picture = cv2.imdecode(coded, flags)
            # One channel of floating-point numbers, as of radiometric thermal photos, is not read in colour.
            if picture is None and not as_stored:
                picture = cv2.imdecode(coded, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    return None if picture is None else np.asarray(picture)


def _jpeg_pixels(content: bytes) -> NDArray[np.uint8] | None:
    """Returns (H, W) or (H, W, 3) BGR of a JPEG, the same as OpenCV's; None if it is cut off or destroyed.

    Pillow calls the same decoder, but keeps what that says of damage from the terminal; OpenCV does not.
    """
    import cv2
    from PIL import Image

    try:
        with (
            warnings.catch_warnings(action="ignore"),
            Image.open(io.BytesIO(content), "r", ("JPEG",)) as image,
        ):
            pixels = np.asarray(image)
    except Exception:  # Pillow lets the errors of its decoders through
        return None
    if pixels.ndim == 3 and pixels.shape[2] == 4:  # inks, stored inverted; in whole numbers, as OpenCV does
        light = 255 - pixels.astype(np.int32)
        key = light[..., 3:]
        pixels = (key - ((255 - light[..., :3]) * key >> 8)).astype(np.uint8)
    grey_or_colour = pixels.copy() if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    return np.asarray(grey_or_colour, dtype=np.uint8)


@contextmanager
def opencv_silenced() -> Iterator[None]:
    """Keeps OpenCV from writing to the terminal what it makes of a file, which our own line says."""
    from cv2.utils import logging

    with _LOCK:
        _levels.append(logging.setLogLevel(logging.LOG_LEVEL_SILENT))
    try:
        yield
    finally:
        with _LOCK:
            logging.setLogLevel(_levels.pop())


def _plain_png(content: bytes) -> bytes:
    """Returns a PNG with nothing but its pixels, nothing of one that is damaged, and other files as they are.

    What libpng has to say of colour profiles and the like it writes to the terminal itself.
    """
    if not content.startswith(_PNG):
        return content
    kept, at = [_PNG], len(_PNG)
    while at < len(content):
        length, kind = struct.unpack_from(">I4s", content[at : at + 8].ljust(8, b"\0"))
        chunk = content[at : at + 12 + length]
        at += len(chunk)
        if kind not in _PNG_PIXELS:
            continue
        if chunk[-4:] != zlib.crc32(chunk[4:-4]).to_bytes(4, "big"):
            return b""
        kept.append(chunk)
        if kind == b"IEND":
            return b"".join(kept)
    return b""


def _unturned(content: bytes) -> bytes:
    """Returns a TIFF whose tag says that it is not turned: OpenCV turns TIFFs whatever its flags say."""
    order, is_big = _TIFFS.get(content[:4], ("", False))
    # Where the first offset is, and the formats of counts and entries, which are longer in a BigTIFF.
    begin, number, form = (8, "Q", "HHQH6x") if is_big else (4, "H", "HHIH2x")
    size = struct.calcsize(f"<{form}")
    try:
        (first,) = struct.unpack_from(f"{order}{'Q' if is_big else 'I'}", content, begin) if order else (0,)
        (count,) = struct.unpack_from(f"{order}{number}", content, first) if order else (0,)
        first += struct.calcsize(f"<{number}")
        for at in range(first, min(first + size * count, len(content)), size):
            if struct.unpack_from(f"{order}H", content, at)[0] == _ORIENTATION:
                upright = struct.pack(f"{order}{form}", _ORIENTATION, _SHORT, 1, 1)
                return content[:at] + upright + content[at + size :]
    except (struct.error, OverflowError):  # cut off, as the decoder will say
        pass
    return content


def in_8_bits(picture: NDArray[Any]) -> NDArray[np.uint8]:
    """Returns a picture of 8 bits as it is, any other over the range that it uses.

    A thermal or raw-like picture uses a small part of 16 bits: its own range is what is there to see. What is
    not finite, of floating-point numbers, or colder than anything, is black; single pixels far out of the
    range of the rest, dead or without a number, are black or white, and leave the range as it is.
    """
    if picture.dtype == np.uint8:
        return picture
    is_float = picture.dtype.kind == "f"
    used = picture[np.isfinite(picture) & (picture > _ABSOLUTE_ZERO_C)] if is_float else picture
    low, high = _range_in_use(used.ravel()) if used.size else (0.0, 0.0)
    # Degrees differ by less than one; whole numbers that do not differ at all are dark.
    span = max(high - low, 1e-6 if is_float else 1.0)
    values = np.nan_to_num(picture.astype(np.float32), nan=low, posinf=low, neginf=low)
    return ((np.clip(values, low, high) - low) * (255.0 / span) + 0.5).astype(np.uint8)


def _range_in_use(values: NDArray[Any]) -> tuple[float, float]:
    """Returns the lowest and the highest of (N,) values, strays left out."""
    low, high = float(values.min()), float(values.max())
    sample = values[:: max(1, values.size // _SAMPLED)]
    inner_low, inner_high = np.percentile(sample, (_OUTER_PERCENT, 100.0 - _OUTER_PERCENT)).astype(float)
    reach = _STRAY_RANGES * (inner_high - inner_low)
    return (max(low, inner_low - reach), min(high, inner_high + reach)) if reach > 0 else (low, high)


def has_too_many_pixels(content: bytes) -> bool:
    """Tells by a picture's header whether decoding it would take more memory than any photo's.

    The limit is Pillow's, 179 megapixels. What Pillow does not know is left to the decoder.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(content)):
            return False
    except Image.DecompressionBombError:
        return True
    except Exception:  # a damaged header makes Pillow raise anything; the decoder says what is wrong
        return False


def picture_size(path: Path) -> tuple[int, int] | None:
    """Returns width and height of a picture as stored, by its header; None if that cannot be read."""
    from PIL import Image

    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            return stored_size(image)
    except Exception:  # a damaged header makes Pillow raise anything; who decodes it says what is wrong
        return None


def stored_size(image: Any) -> tuple[int, int]:
    """Returns width and height of Pillow's image as stored: of a TIFF it tells the size after the turn."""
    tags = getattr(image, "tag_v2", {})
    return int(tags.get(_WIDTH, image.width)), int(tags.get(_HEIGHT, image.height))


def encoded(picture: NDArray[Any], suffix: str, options: Sequence[int] = ()) -> bytes:
    """Returns a picture as the bytes of a file.

    Args:
        picture: (H, W) or (H, W, 3) BGR.
        suffix: ``.png`` or ``.jpg``.
        options: OpenCV's flags and values.

    Raises:
        DatasetError: It cannot be written so.
    """
    import cv2

    is_encoded, content = cv2.imencode(suffix, picture, list(options))
    if not is_encoded:
        raise DatasetError(f"A picture of shape {picture.shape} cannot be written as {suffix[1:]}.")
    return bytes(content.tobytes())


def encoded_mask(mask: NDArray[np.bool_], *, bilevel: bool = False) -> bytes:
    """Returns a (H, W) mask as a PNG that readers see as 0 and 255, of 8 bits or one bit per pixel."""
    import cv2

    return encoded(mask.astype(np.uint8) * 255, ".png", [cv2.IMWRITE_PNG_BILEVEL, 1] if bilevel else [])
