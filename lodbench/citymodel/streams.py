"""Streams that guard and count: decompressed data within bounds, bytes told as they are read."""

from __future__ import annotations

import gzip
import io
import zipfile
import zlib
from collections.abc import Callable
from typing import BinaryIO

from lodbench.errors import CityModelError

# City models compress 8 to 30 times. Beyond this ratio a stream is taken for a bomb.
_MAX_RATIO = 250
_RATIO_STARTS_AT_BYTES = 1 << 24


class _StreamOver(io.RawIOBase):
    """A stream to be read that closes the one below it."""

    def __init__(self, stream: BinaryIO) -> None:
        super().__init__()
        self._stream = stream

    def readable(self) -> bool:
        """Tells that the stream can be read."""
        return True

    def close(self) -> None:
        """Closes the stream below."""
        if not self.closed:
            self._stream.close()
        super().close()


class BoundedStream(_StreamOver):
    """A decompressed stream that stops at a bomb and speaks of damage in words.

    Args:
        stream: Decompressed bytes.
        name: For messages.
        packed_bytes: Size of the compressed data, to tell a bomb by its ratio.
    """

    def __init__(self, stream: BinaryIO, name: str, packed_bytes: int) -> None:
        super().__init__(stream)
        self._name = name
        self._limit = max(_RATIO_STARTS_AT_BYTES, packed_bytes * _MAX_RATIO)
        self._done = 0

    def read(self, size: int = -1) -> bytes:
        """Returns up to ``size`` bytes, all that is left where it is negative.

        Raises:
            CityModelError: The data is damaged or cut off, or expands beyond all reason.
        """
        wanted = self._limit + 1 - self._done if size < 0 else size
        try:
            data = self._stream.read(wanted)
        except (EOFError, zlib.error, gzip.BadGzipFile, zipfile.BadZipFile, OSError) as error:
            raise CityModelError(
                f"{self._name} is damaged or cut off ({error}).", "Download the file again."
            ) from None
        except (RuntimeError, NotImplementedError) as error:
            raise CityModelError(
                f"{self._name} cannot be unpacked: {error}.", "Download the file again."
            ) from None
        self._done += len(data)
        if self._done > self._limit:
            raise CityModelError(
                f"{self._name} expands more than {_MAX_RATIO} times, which no city model does.",
                "If you trust it, unpack it yourself and name the result.",
            )
        return data


class CountedStream(_StreamOver):
    """A stream that tells how many bytes have been read from it.

    Args:
        stream: Where the bytes come from.
        report: Called with the number of bytes after each read.
    """

    def __init__(self, stream: BinaryIO, report: Callable[[int], None]) -> None:
        super().__init__(stream)
        self._report = report

    def read(self, size: int = -1) -> bytes:
        """Returns up to ``size`` bytes, all that is left where it is negative."""
        return self._counted(self._stream.read(size))

    def readline(self, size: int | None = -1) -> bytes:
        """Returns the next line, or its first ``size`` bytes."""
        return self._counted(self._stream.readline(-1 if size is None else size))

    def _counted(self, data: bytes) -> bytes:
        self._report(len(data))
        return data
