"""How functions are compiled, and where numba keeps them: apart for every state of the code they come from.

numba looks only at the file that a function stands in. When a function it calls, or a constant it uses,
changes in another file (an update, a ``git pull``), it would go on using the old code. All that kernels are
compiled from stands in this package: its digest names the folder, and is the stamp that numba compares.

What numba keeps is unpickled and run, and a damaged file fails for ever. So the folder is this user's alone,
and the digests of its files, noted when a process ends, are compared when one starts.

A wheel may bring functions compiled for common processors (``recipes/wheel.sh``). They are used where none is
kept, if they are of the same code and versions, for a level that this processor has, and as digested.
"""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import hashlib
import json
import logging
import os
import shutil
from collections.abc import Callable
from functools import cache
from multiprocessing import parent_process
from pathlib import Path
from time import monotonic
from typing import Any

from llvmlite.binding import get_host_cpu_features
from numba import njit
from numba.core import config, event
from numba.core.caching import CacheImpl, FunctionCache, IndexDataCacheFile, _CacheLocator

_LOGGER = logging.getLogger(__name__)
_DIGESTS = "digests.json"
_HERE = Path(__file__).parent
# Levels of the x86-64 ABI that a wheel may bring functions for, the best first, and what LLVM calls what sets
# each apart from those below it.
_V3 = frozenset("avx avx2 bmi bmi2 f16c fma lzcnt movbe popcnt ssse3 sse4.1 sse4.2 xsave".split())
LEVELS = {
    "x86-64-v4": _V3 | frozenset("avx512f avx512bw avx512cd avx512dq avx512vl".split()),
    "x86-64-v3": _V3,
}


class KernelLocator(_CacheLocator):
    """Where numba keeps a function of a package, its stamp being the digest of the package's code.

    In a folder of its own where that can be used (``own_folder``), otherwise where numba would by itself:
    ``NUMBA_CACHE_DIR``, or the user's cache.
    """

    package = _HERE

    def __init__(self, line: int, folder: str) -> None:
        self._line, self._folder = line, folder

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> KernelLocator | None:
        """Returns the place of a function of the package, None for another's."""
        if Path(py_file).parent != cls.package:
            return None
        folder = None if _configured() else own_folder(cls.package)
        line = py_func.__code__.co_firstlineno
        if folder is not None:
            return cls(line, str(folder))
        others: list[Any] = [
            each for each in CacheImpl._locator_classes if not issubclass(each, KernelLocator)
        ]
        for other in others:
            found = other.from_function(py_func, py_file)
            if found is not None:
                return cls(line, found.get_cache_path())
        return None

    def get_cache_path(self) -> str:
        """Returns the folder."""
        return self._folder

    def get_source_stamp(self) -> str:
        """Returns the digest of the package's code."""
        return code_digest(self.package)

    def get_disambiguator(self) -> str:
        """Returns the function's line, as numba's own locators do."""
        return str(self._line)


class KernelCache(FunctionCache):
    """Keeps what is compiled of a function; what is not kept is taken from what the wheel brought."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Returns the function compiled for a signature, or None."""
        kept = super().load_overload(sig, target_context)
        if kept is not None or config.CPU_NAME is not None:  # type: ignore[attr-defined]
            return kept
        sig, (triple, *_), code = self._index_key(sig, target_context.codegen())
        locator = self._impl.locator
        for level in usable_levels(locator.package):
            folder = locator.package / "compiled" / level
            index = IndexDataCacheFile(str(folder), self._impl.filename_base, locator.get_source_stamp())
            if not _is_as_brought(folder / f"{self._impl.filename_base}.nbi"):
                continue
            name = index._load_index().get((sig, (triple, level, ""), code))
            if name is not None and _is_as_brought(folder / name):
                return self._impl.rebuild(target_context, index._load_data(name))
        return None


@cache
def usable_levels(package: Path) -> list[str]:
    """Returns the levels that this processor has of those that a package brings functions for."""
    if not (package / "compiled").is_dir():
        return []
    has = {name for name, is_there in get_host_cpu_features().items() if is_there}
    levels = [level for level, needs in LEVELS.items() if needs <= has]
    return [level for level in levels if (package / "compiled" / level).is_dir()]


@cache
def _brought(folder: Path) -> dict[str, str]:
    """Returns the SHA-256 of each file that the wheel brought in a folder, by name."""
    with contextlib.suppress(OSError, ValueError):
        lines = (folder / "digests.txt").read_text(encoding="utf-8").splitlines()
        return {name: digest for digest, name in (line.split() for line in lines)}
    return {}


def _is_as_brought(path: Path) -> bool:
    with contextlib.suppress(OSError):
        return _brought(path.parent).get(path.name) == _file_digest(path)
    return False


def use_own_folder(locator: type[KernelLocator] = KernelLocator) -> None:
    """Has numba ask a locator before its own; what is compiled of other packages is not concerned."""
    if locator not in CacheImpl._locator_classes:
        CacheImpl._locator_classes.insert(0, locator)


def _configured() -> Path | None:
    """Returns the folder that the user has set for all that numba compiles."""
    folder: str = config.CACHE_DIR  # type: ignore[attr-defined]
    return Path(folder) if folder else None


@cache
def own_folder(package: Path) -> Path | None:
    """Returns the folder for a package's compiled functions of the present code; removes those of older code.

    It lies in the package's ``__pycache__``. Where that cannot be written or belongs to another user, None is
    returned. Damaged files, and those that a killed process left, are removed: numba compiles them again.
    """
    home = package / "__pycache__"
    if not os.access(home if home.is_dir() else package, os.W_OK):
        return None
    folder = home / f"kernels-{code_digest(package)}"
    if not folder.is_dir():
        for other in home.glob("kernels-*"):
            shutil.rmtree(other, ignore_errors=True)
    try:
        if not _is_private(folder):
            return None
    except OSError:  # a full disk, or a file of that name
        return None
    _remove_damaged(folder)
    atexit.register(_note_digests, folder)
    return folder


@cache
def code_digest(package: Path) -> str:
    """Returns a digest of all code of a package."""
    digest = hashlib.sha256()
    for path in sorted(package.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


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


# How often it is said how far compiling is.
_EVERY_S = 5.0

use_own_folder()


def _cached(**options: Any) -> Callable[[Any], Any]:
    """Returns the decorator of functions that are compiled on use and kept."""
    compiled = njit(**options)

    def decorate(function: Any) -> Any:
        dispatcher = compiled(function)
        dispatcher._cache = KernelCache(function)
        return dispatcher

    return decorate


# Division by zero gives infinity, as in numpy; ``checked`` raises, as Python does. Nothing but Python calls
# these: what numba adds for callers in C is left out.
_ANY: dict[str, Any] = {"nogil": True, "no_cfunc_wrapper": True}
kernel: Any = _cached(error_model="numpy", **_ANY)
checked: Any = _cached(**_ANY)
inlined: Any = _cached(error_model="numpy", inline="always", **_ANY)

# Without reference counts: passing a scene's arrays along, numba would count a reference to each of them,
# which takes as long as what is done with them, and longest to compile. No function compiled so may make an
# array, or return one.
_UNCOUNTED: dict[str, Any] = {**_ANY, "error_model": "numpy", "_nrt": False}
uncounted: Any = _cached(**_UNCOUNTED)
# A part of uncounted kernels, which Python cannot call: it is compiled with each that calls it.
part: Any = njit(no_cpython_wrapper=True, **_UNCOUNTED)
# A part that is called for every pixel.
per_pixel: Any = njit(forceinline=True, no_cpython_wrapper=True, **_UNCOUNTED)


class _Report(event.Listener):
    """Says that kernels are compiled, once, and every few seconds how far it is."""

    def __init__(self) -> None:
        self.depth, self.count, self.said_s = 0, 0, 0.0

    def on_start(self, happening: event.Event) -> None:
        """Counts a kernel, and not the parts and library functions that are compiled within."""
        self.depth += 1
        function = happening.data["dispatcher"].py_func
        if self.depth > 1 or not function.__module__.startswith(__package__):
            return
        self.count += 1
        name = f"{function.__module__.rpartition('.')[2]}.{function.__name__}"
        if self.count == 1:
            _LOGGER.warning("First use: compiling kernels (%s, ...), once: up to half a minute.", name)
        elif monotonic() - self.said_s > _EVERY_S:
            _LOGGER.warning("%d kernels compiled, now %s.", self.count - 1, name)
        else:
            return
        self.said_s = monotonic()

    def on_end(self, _: event.Event) -> None:
        """Notes that a function is compiled."""
        self.depth -= 1


# Where many processes work, the first one says it for all.
if parent_process() is None:
    event.register("numba:compile", _Report())
