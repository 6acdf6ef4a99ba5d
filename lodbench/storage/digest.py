"""Digests: short names for content, so that a changed input gets another name; arrays on disk with theirs.

Files that are read again later must hold what they held: digests are remembered, and compared at reading. A
run is named by the digests of its masks and photos, which it reads query by query, hours later perhaps. So
the bytes that are decoded are those that are hashed: a file that was replaced, and put back before the end,
cannot leave an answer behind. Arrays are mapped, never copied or unpickled.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import xxhash
from numpy.typing import DTypeLike, NDArray

from lodbench.errors import InputChanged
from lodbench.storage.disk import disk


def digest_of(value: Any, length: int = 12) -> str:
    """Returns the first ``length`` hexadecimal digits of the SHA-256 of a JSON value's canonical form."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:length]


def file_digest(path: Path) -> str:
    """Returns the SHA-256 of a file's content, hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def digest_of_code(files: Iterable[Path], libraries: Iterable[str]) -> str:
    """Returns a digest of code and of the versions of libraries that it calls; some may not be there."""
    return digest_of([[file_digest(file) for file in files], [*versions_of(libraries).values()]])


def versions_of(libraries: Iterable[str]) -> dict[str, str]:
    """Returns the versions of libraries by their names; "" of one that is not there."""
    return {name: _version(name) for name in libraries}


def package_files(module: str) -> Iterator[Path]:
    """Yields the Python files of a package, or those beside a module."""
    spec = find_spec(module)
    if spec is not None and spec.submodule_search_locations:
        for folder in sorted(spec.submodule_search_locations):
            yield from sorted(Path(folder).rglob("*.py"))
    elif spec is not None and spec.origin is not None:
        yield from sorted(Path(spec.origin).parent.glob("*.py"))


def _version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return ""


# What files held when `content_digest` first read them: here, and as another process reported it.
_scope: ContextVar[dict[Path, str] | None] = ContextVar("_scope", default=None)
_reported: dict[Path, str] = {}


@contextmanager
def remembered_contents() -> Iterator[None]:
    """Within this, what `content_digest` finds in a file is what `read_content` must find there."""
    before = _scope.set({})
    try:
        yield
    finally:
        _scope.reset(before)


def known_contents() -> dict[Path, str]:
    """Returns what is remembered here, for workers; nothing outside of ``remembered_contents``."""
    return dict(_scope.get() or {})


def remember_contents(known: Mapping[Path, str]) -> None:
    """Lets a worker's process compare what it reads with what another process found, until changed."""
    _reported.clear()
    _reported.update(known)


def content_digest(path: Path | None) -> str | None:
    """Returns a file's SHA-256; one that cannot be read fails in its own query, not here."""
    if path is None:
        return None
    scope = _scope.get()
    remembered = {} if scope is None else scope
    if path not in remembered:
        try:
            remembered[path] = file_digest(path)
        except OSError:
            return "unreadable"
    return remembered[path]


def read_content(path: Path, digest: str | None = None) -> bytes:
    """Returns a file's content.

    Args:
        path: The file.
        digest: SHA-256 that is wanted; None for the one that is remembered, if one is.

    Raises:
        OSError: It cannot be read.
        InputChanged: It is not what is remembered of it.
    """
    content = path.read_bytes()
    scope = _scope.get()
    expected = digest or (_reported if scope is None else scope).get(path)
    if expected is not None and hashlib.sha256(content).hexdigest() != expected:
        raise InputChanged(
            f"{path} changed while it was in use; what was answered before is kept.",
            "Put it back, or give the same command again to answer what is there now.",
        )
    return content


def random_stream(seed: int, *names: str | int) -> np.random.Generator:
    """Returns the generator of a seed and a path of names: (dataset, query, stage, step).

    The same path gives the same numbers on every machine and in every order of work; different
    paths give independent numbers (Philox keyed by a 128-bit hash).
    """
    path = "\x1f".join([str(seed), *(f"{type(name).__name__}:{name}" for name in names)])
    key = int.from_bytes(
        hashlib.blake2b(path.encode(errors="surrogatepass"), digest_size=16).digest(), "little"
    )
    return np.random.Generator(np.random.Philox(key=key))


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


# Folders whose code no answer depends on: what is left counts, and so does a folder that is yet to come.
_IDLE = frozenset(("bench", "cli", "evaluation", "reporting", "training"))


# Those of `baselines/`, which need not lie where the package does.
_BASELINES = "lodbench.baselines"


# What computes an answer. Those of extras need not be there.
LIBRARIES = (
    "numpy", "numba", "opencv-python-headless", "scipy",
    "torch", "transformers", "kornia", "romatch", "poselib", "pycolmap", "pyrender", "open3d",
)  # fmt: skip


@cache
def own_digest() -> str:
    """Returns a digest of lodbench's own code and of the libraries that compute, as installed here."""
    package = Path(__file__).parents[1]
    files = [
        file for file in sorted(package.rglob("*.py")) if file.relative_to(package).parts[0] not in _IDLE
    ]
    return digest_of_code(dict.fromkeys((*files, *package_files(_BASELINES))), LIBRARIES)
