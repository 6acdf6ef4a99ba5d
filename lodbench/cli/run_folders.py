"""Run folders as patterns such as ``runs/demo/*/*`` name them: others among them are passed over."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from lodbench.cli.verify import CONFIG_FILE
from lodbench.errors import ConfigError


def run_folders(named: Sequence[Path], out: Path | None = None) -> list[Path]:
    """Returns the folders of finished runs among several, in order; says which others are passed over.

    One alone, what is not there, and all where none holds a run are returned as they are: whoever reads them
    says what is wrong.

    Args:
        named: Folders and files.
        out: ``--out`` of a command that writes one file per run; None where it is not given, or is of all.

    Raises:
        ConfigError: There is one ``--out`` for several runs.
    """
    others = [path for path in named if path.exists() and not (path / CONFIG_FILE).is_file()]
    runs = [path for path in named if path not in others]
    if not runs:
        return list(named)
    for path in others:
        sys.stderr.write(f"lodbench: skipped, not a finished run: {path}\n")
    if out is not None and len(runs) > 1:
        raise ConfigError(f"--out {out} is one place, and there are {len(runs)} runs.", "Leave --out out.")
    return runs
