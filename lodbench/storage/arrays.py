"""Arrays on disk that are mapped, never copied or unpickled, and compared with their digests when opened."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xxhash
from numpy.typing import DTypeLike, NDArray

from lodbench.storage.disk import disk

# XXH3 runs at the speed of memory. It tells damage; against somebody who means harm no digest that lies
# beside its data helps, whatever its kind.
_BLOCK_BYTES = 1 << 20


def write_arrays(folder: Path, arrays: Mapping[str, NDArray[Any]]) -> dict[str, str]:
    """Writes arrays as ``NAME.npy`` into a folder that nobody reads yet; returns the digest of each file.

    Raises:
        OSError: The disk is full.
    """
    return {name: _write(folder / f"{name}.npy", array) for name, array in arrays.items()}


def write_blocks(path: Path, blocks: Iterable[NDArray[Any]], dtype: DTypeLike, shape: tuple[int, ...]) -> str:
    """Writes an array of which a block is in memory at a time; returns the digest of the file.

    Args:
        path: The ``.npy`` file, which nobody reads yet.
        blocks: Its rows, in order; all together ``shape[0]``.
        dtype: Of the array.
        shape: Likewise.

    Raises:
        OSError: The disk is full.
    """
    header = io.BytesIO()
    plain: dict[str, Any] = {"descr": np.lib.format.dtype_to_descr(np.dtype(dtype)), "fortran_order": False}
    np.lib.format.write_array_header_1_0(header, plain | {"shape": shape})
    state = xxhash.xxh3_128(header.getvalue())
    with path.open("wb", buffering=0) as stream:
        disk().write(stream, header.getvalue(), path)
        for block in blocks:
            content = np.ascontiguousarray(block, dtype)
            if content.size:
                state.update(content.data)
                disk().write(stream, content.data, path)
    return state.hexdigest()


def map_array(path: Path, digest: str) -> NDArray[Any]:
    """Returns an array that is mapped from its file, read only.

    Raises:
        OSError: The file is missing.
        ValueError: It is not the file that was written, or no array.
    """
    if file_check(path) != digest:
        raise ValueError(f"{path.name} is not the file that was written")
    try:
        array: NDArray[Any] = np.load(path, mmap_mode="r", allow_pickle=False)
    except EOFError as error:
        raise ValueError(str(error)) from error
    return array


def text_check(text: str) -> str:
    """Returns what tells that a text is damaged: 32 hexadecimal digits."""
    return xxhash.xxh3_128(text.encode()).hexdigest()


def _write(path: Path, array: NDArray[Any]) -> str:
    plain = np.ascontiguousarray(array)
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, np.lib.format.header_data_from_array_1_0(plain))
    state = xxhash.xxh3_128(header.getvalue())
    content = plain.tobytes() if plain.size == 0 else plain.data
    state.update(content)
    with path.open("wb", buffering=0) as stream:
        disk().write(stream, header.getvalue(), path)
        disk().write(stream, content, path)
    return state.hexdigest()


def file_check(path: Path) -> str:
    """Returns what tells that a file is damaged: 32 hexadecimal digits.

    Raises:
        OSError: It cannot be read.
    """
    # Read, not mapped: pages looked at through a map count as the process's memory.
    state, block = xxhash.xxh3_128(), bytearray(_BLOCK_BYTES)
    with path.open("rb", buffering=0) as stream:
        while count := stream.readinto(block):
            state.update(memoryview(block)[:count])
    return state.hexdigest()
