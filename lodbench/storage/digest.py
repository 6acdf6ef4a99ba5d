"""Digests: short names for content, so that a changed input gets another name."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any


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
