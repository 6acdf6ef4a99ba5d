"""Whether a worker of another machine has the code that the command has."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from lodbench.errors import LodbenchError
from lodbench.storage.digest import digest_of_code, package_files

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


def require_code_version(code: str) -> None:
    """Makes sure that a worker's code and libraries are those of the command.

    Args:
        code: The command's ``own_digest``; "" where its workers have no others.

    Raises:
        LodbenchError: They are not.
    """
    if code and code != own_digest():
        raise LodbenchError(
            "its code of lodbench, or a version of its libraries, is not the command's.",
            "Install the same on all machines: `lodbench doctor` lists versions.",
        )
