"""Where numba keeps compiled functions: apart for every state of the code they come from.

numba looks only at the date of the file that a function stands in. When a function it calls, or a constant
it uses, changes in another file (an update, a ``git pull``), it would go on using the old code, or fail to
read what it kept.

What numba keeps is unpickled and run, and a damaged file fails for ever. So the folder is this user's alone,
and the digests of its files, noted when a process ends, are compared when one starts.
"""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import hashlib
import json
import logging
import os
import re
import shutil
import sys
from pathlib import Path

_NAME = re.compile(r"kernels-[0-9a-f]{16}")
_LOGGER = logging.getLogger(__name__)
_DIGESTS = "digests.json"
_IMPORTS = re.compile(r"^from ([\w.]+) import ", re.MULTILINE)


def keep_kernels_apart(package: Path, parts: tuple[str, ...] = ("",)) -> Path | None:
    """Points numba to a folder of its own for the present code of a package; removes those of older code.

    The folder lies in the package's ``__pycache__``. Where that cannot be written or belongs to another user,
    or where the user has set ``NUMBA_CACHE_DIR``, nothing is done and None returned: numba then finds a place
    by itself. Damaged files, and those that a killed process left, are removed: numba compiles them again.
    """
    configured = os.environ.get("NUMBA_CACHE_DIR")
    if configured and not _NAME.fullmatch(Path(configured).name):
        return None
    home = package / "__pycache__"
    if not os.access(home if home.is_dir() else package, os.W_OK):
        os.environ.pop("NUMBA_CACHE_DIR", None)
        return None
    folder = home / f"kernels-{_digest(package, parts)}"
    if not folder.is_dir():
        for other in home.glob("kernels-*"):
            shutil.rmtree(other, ignore_errors=True)
    try:
        is_usable = _is_private(folder)
    except OSError:  # a full disk, or a file of that name
        is_usable = False
    if not is_usable:
        os.environ.pop("NUMBA_CACHE_DIR", None)
        return None
    _remove_damaged(folder)
    atexit.register(_note_digests, folder)
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    numba = sys.modules.get("numba")
    if numba is not None:
        numba.config.reload_config()
    return folder


def _is_private(folder: Path) -> bool:
    """Makes the folder where it is missing; returns whether nobody else can have put code into it."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    found = folder.stat()
    if found.st_uid != os.geteuid():
        return False
    if found.st_mode & 0o022:
        _LOGGER.warning("Others could write to %s: what numba kept there is compiled again.", folder)
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    return True


def _remove_damaged(folder: Path) -> None:
    """Removes files that are not as noted, and those not noted that no other process may have written."""
    # Shared while the process lives, taken alone to see whether others do.
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        is_alone = True
    except OSError:
        is_alone = False
    with contextlib.suppress(OSError):
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    noted = _noted(folder)
    for path in _kept(folder):
        known = noted.get(path.relative_to(folder).as_posix())
        with contextlib.suppress(OSError):
            stamp = _stamp(path)
            if known is not None and stamp == known[:2] and _file_digest(path) == known[2]:
                continue
            is_damaged = known is not None and (is_alone or stamp == known[:2])
            if is_damaged:
                _LOGGER.warning("%s is damaged: it is compiled again.", path)
            if is_damaged or is_alone:
                path.unlink()


def _note_digests(folder: Path) -> None:
    """Notes the digest of every file that was written since the last note."""
    noted, now = _noted(folder), {}
    for path in _kept(folder):
        name = path.relative_to(folder).as_posix()
        with contextlib.suppress(OSError):
            stamp, known = _stamp(path), noted.get(name)
            digest = known[2] if known is not None and known[:2] == stamp else _file_digest(path)
            now[name] = [*stamp, digest]
    if now != noted:
        with contextlib.suppress(OSError):
            partial = folder / f".{_DIGESTS}.{os.getpid()}"
            partial.write_text(json.dumps(now), encoding="utf-8")
            partial.replace(folder / _DIGESTS)


def _kept(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*.nb[ic]") if path.is_file())


def _noted(folder: Path) -> dict[str, list[int | str]]:
    try:
        noted = json.loads((folder / _DIGESTS).read_text(encoding="utf-8"))
        return {str(name): [int(entry[0]), int(entry[1]), str(entry[2])] for name, entry in noted.items()}
    except (OSError, ValueError, TypeError, LookupError, AttributeError, RecursionError):
        return {}


def _stamp(path: Path) -> list[int | str]:
    found = path.stat()
    return [found.st_mtime_ns, found.st_size]


def _file_digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _digest(package: Path, parts: tuple[str, ...]) -> str:
    """Returns a digest of all code that numba compiles, and of the files it takes constants from."""
    digest = hashlib.sha256()
    files: set[Path] = set()
    for path in {path for part in parts for path in (package / part).rglob("*.py")}:
        code = path.read_text(encoding="utf-8")
        if "numba" in code:
            files |= {path, *_imported(package, code)}
    for path in sorted(files):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _imported(package: Path, code: str) -> list[Path]:
    """Returns the package's files that some code imports from."""
    names = [name.split(".") for name in _IMPORTS.findall(code)]
    paths = [package.joinpath(*rest).with_suffix(".py") for first, *rest in names if first == package.name]
    return [path for path in paths if path.is_file()]
