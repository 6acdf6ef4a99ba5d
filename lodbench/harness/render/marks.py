"""What files of `lodbench render` say of themselves, so that only earlier ones are replaced."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.reporting.overlays import png_bytes
from lodbench.storage import write_bytes

# The bytes, and where in the file they are.
Mark = tuple[int, bytes]
# A PNG's signature, and the chunk of its size, which is the first of every PNG.
_AFTER_SIZE = 8 + 25


def picture_mark(kind: str) -> Mark:
    """Returns the mark of a kind's pictures: a text among the PNG's own, as masks made by hand have none."""
    chunk = b"tEXt" + f"Software\0lodbench render kind={kind}".encode()
    whole = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    return _AFTER_SIZE, whole


def write_marked(path: Path, picture: NDArray[np.uint8] | NDArray[np.uint16], kind: str) -> None:
    """Writes a picture, grey or BGR, 8 or 16 bits, as PNG with its kind's mark, atomically."""
    plain, (start, mark) = png_bytes(picture), picture_mark(kind)
    write_bytes(path, plain[:start] + mark + plain[start:])


def may_replace(file: Path, mark: Mark) -> bool:
    """Tells whether a file is absent, or has a mark."""
    if not file.exists():
        return True
    start, said = mark
    with file.open("rb") as stream:
        return stream.read(start + len(said))[start:] == said
