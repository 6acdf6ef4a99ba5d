"""Packages of others, as pip leaves them on the path of imports."""

from collections.abc import Mapping
from pathlib import Path


def write_package(
    site: Path, name: str, points: Mapping[str, Mapping[str, str]], files: Mapping[str, str] | None = None
) -> Path:
    """Writes a package's files and metadata.

    Args:
        site: The folder on the path of imports.
        name: Name of the package.
        points: Entry points by group without its ``lodbench.``.
        files: Further files by their path below ``site``.

    Returns:
        The folder of its metadata.
    """
    for path, text in (files or {}).items():
        (site / path).parent.mkdir(parents=True, exist_ok=True)
        (site / path).write_text(text)
    info = site / f"{name.replace('-', '_')}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    lines = []
    for group, names in points.items():
        lines += [f"[lodbench.{group}]", *(f"{point} = {value}" for point, value in names.items())]
    (info / "entry_points.txt").write_text("\n".join([*lines, ""]))
    return info
