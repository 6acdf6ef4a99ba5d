"""Where numba keeps compiled functions: apart for every state of the code they come from.

numba looks only at the date of the file that a function stands in. When a function it calls, or a constant
it uses, changes in another file (an update, a ``git pull``), it would go on using the old code, or fail to
read what it kept.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import sys
from pathlib import Path

_NAME = re.compile(r"kernels-[0-9a-f]{16}")
_IMPORTS = re.compile(r"^from ([\w.]+) import ", re.MULTILINE)


def keep_kernels_apart(package: Path, parts: tuple[str, ...] = ("",)) -> Path | None:
    """Points numba to a folder of its own for the present code of a package; removes those of older code.

    The folder lies in the package's ``__pycache__``. Where that cannot be written, or where the user has set
    ``NUMBA_CACHE_DIR``, nothing is done and None returned: numba then finds a place by itself.

    Args:
        package: Folder of the package.
        parts: Folders in it that hold functions compiled by numba, to look at no more than these.
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
        folder.mkdir(parents=True, exist_ok=True)
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    numba = sys.modules.get("numba")
    if numba is not None:
        numba.config.reload_config()
    return folder


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
