"""Keeps compiled kernels and mypy's cache between clean checkouts: `python -m tests.kept restore` and `keep`.

They lie in `lodbench-tests` of the user's cache, each in a folder named by a digest of all it was made from,
and are taken by the same digest alone. Nothing needs them: what is not there, or cannot be copied, is made
anew.
"""

import hashlib
import os
import platform
import shutil
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

from lodbench.kernels import compiled

ROOT = Path(__file__).resolve().parents[1]
HOME = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lodbench-tests"
# Of each kind: as many are kept, the newest.
MOST = 3


def places() -> dict[Path, Path]:
    """Returns where each lies in the cache, by where it is used."""
    package = ROOT / "lodbench" / "kernels"
    code = compiled.code_digest(package)
    pinned = [(ROOT / name).read_bytes() for name in ("constraints.txt", "pyproject.toml")]
    return {
        package / "__pycache__" / f"kernels-{code}": HOME / f"kernels-{_digest(code, 'numba', 'llvmlite')}",
        ROOT / ".mypy_cache": HOME / f"mypy-{_digest(*pinned, 'mypy', 'numpy')}",
    }


def _digest(*parts: bytes | str) -> str:
    """Returns a digest of contents and packages' versions, Python and machine."""
    told = [part if isinstance(part, bytes) else f"{part} {_version(part)}".encode() for part in parts]
    told.append(f"{sys.version} {platform.platform()}".encode())
    return hashlib.sha256(b"\0".join(hashlib.sha256(each).digest() for each in told)).hexdigest()[:16]


def _version(name: str) -> str:
    return version(name) if name in ("numba", "llvmlite", "mypy", "numpy") else ""


def copied(source: Path, target: Path) -> bool:
    """Copies a folder that is this user's own to a place where none is, whole or not at all."""
    if target.exists() or not source.is_dir() or source.stat().st_uid != os.getuid():
        return False
    target.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".copy-") as scratch:
        shutil.copytree(source, Path(scratch) / "whole")
        (Path(scratch) / "whole").rename(target)
    return True


def restore() -> None:
    """Brings what is kept of this state of the checkout."""
    for used, kept in places().items():
        copied(kept, used)


def keep() -> None:
    """Keeps what this checkout has made, instead of what was kept of it before; removes the oldest."""
    for used, kept in places().items():
        if used.is_dir():
            shutil.rmtree(kept, ignore_errors=True)
            copied(used, kept)
        of_kind = sorted(HOME.glob(f"{kept.name.split('-')[0]}-*"), key=lambda each: each.stat().st_mtime)
        for old in of_kind[:-MOST]:
            shutil.rmtree(old, ignore_errors=True)


if __name__ == "__main__":
    try:
        {"restore": restore, "keep": keep}[sys.argv[1]]()
    except OSError as fault:
        sys.stderr.write(f"Nothing is kept: {fault}\n")
