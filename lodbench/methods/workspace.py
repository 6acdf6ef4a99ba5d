"""Where a method keeps what it prepares once for a dataset: a folder named by content, filled in parts."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from pathlib import Path

from lodbench.errors import LodbenchError
from lodbench.storage import digest_of, write_text
from lodbench.storage.arrays import file_check
from lodbench.storage.disk import disk, make_folder
from lodbench.storage.paths import cache_limit_bytes, cache_root, mark_used, path_name, prune_cache

_LOGGER = logging.getLogger(__name__)
_FOLDER = "prepared"


class Workspace:
    """A folder that a method's ``prepare`` fills, and finds filled the next time.

    Its name stands for all that its content depends on: the method, its parameters, code and weights, the
    map and the references. So a part that is there is the right one, and is never made again, unless it
    is no longer what was written, which is told. Every part is there whole or not at all: after a kill the
    finished ones stay.

    Args:
        folder: The folder; made if it is not there.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        make_folder(folder)

    def part(self, name: str, make: Callable[[Path], None]) -> Path:
        """Returns a part's file, made first if it is not there.

        Args:
            name: The file's name, without folders.
            make: Writes the part to the path it is given, which ends as the name does; a file, or a folder.

        Raises:
            LodbenchError: The name is no plain name, or ``make`` wrote nothing there.
            Exception: What ``make`` raised; the part is not there then.
        """
        path = self.folder / path_name("part's", name)
        is_damaged = path.exists()
        if is_damaged:
            if _stored_check(path) == _check(path):
                return path
            _LOGGER.warning("%s, which a method prepared, is damaged: it is made anew.", path)
        self._make(path, make, is_damaged)
        return path

    def _make(self, path: Path, make: Callable[[Path], None], is_damaged: bool) -> None:
        unfinished = path.with_name(f".{os.getpid()}.{path.name}")
        try:
            make(unfinished)
            if not unfinished.exists():
                raise LodbenchError(
                    f"Nothing was written for the part {path.name}.", "Write to the path given."
                )
            # First: who finds the part finds what it must be.
            write_text(_check_file(path), _check(unfinished), survives_power_cut=False)
            if is_damaged:
                disk().remove(path)
            try:
                disk().rename(unfinished, path)
            except OSError:
                # Another process may have made a folder of the same content meanwhile.
                if not path.exists():
                    raise
        finally:
            disk().remove(unfinished)


def _check_file(path: Path) -> Path:
    return path.with_name(f".{path.name}.xxh3")


def _stored_check(path: Path) -> str | None:
    try:
        return _check_file(path).read_text(encoding="utf-8")
    except (OSError, ValueError):
        return None


def _check(path: Path) -> str:
    """Returns what tells that a file, or any file of a folder, is damaged."""
    if path.is_file():
        return file_check(path)
    files = sorted(file for file in path.rglob("*") if file.is_file())
    return digest_of([[file.relative_to(path).as_posix(), file_check(file)] for file in files], length=32)


def open_workspace(method: str, digest: str) -> Workspace:
    """Returns the workspace of a method for a content, in the cache; the longest unused make room for it."""
    root = cache_root() / _FOLDER
    workspace = Workspace(root / f"{path_name('method', method)}-{digest}")
    mark_used(workspace.folder)
    prune_cache(root, cache_limit_bytes(), keep=workspace.folder)
    return workspace
