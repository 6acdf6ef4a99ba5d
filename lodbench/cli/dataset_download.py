"""`lodbench dataset download NAME`: fetch what has a stable address; say how to get the rest."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from lodbench.cli.parser import Parser
from lodbench.datasets.download import fetch
from lodbench.datasets.published.catalogue import spec_of
from lodbench.datasets.published.layout import survey
from lodbench.execution import ProgressCallback
from lodbench.storage.paths import data_root


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code: 1 if nothing of the dataset can be fetched.

    Raises:
        LodbenchError: The dataset is unknown, or a file cannot be fetched.
    """
    parser = Parser(
        "lodbench dataset download",
        description="Fetch the files of a published dataset that have a stable address.",
    )
    parser.add_argument("dataset", metavar="NAME", help="as `lodbench dataset list` has it")
    parser.add_argument("--root", metavar="DIR", help="where to; else LODBENCH_DATA")
    options = parser.parse_args(argv[1:])
    spec = spec_of(options.dataset)
    root = data_root() if options.root is None else Path(options.root).expanduser()
    lines = []
    for download in spec.downloads:
        with ProgressCallback(f"fetching {Path(download.path).name}", "MB", 1_000_000) as progress:
            path, is_new = fetch(download, root, progress)
        lines.append(f"{path}: {'fetched' if is_new else 'there already'}, SHA-256 as published")
    if not spec.downloads:
        lines.append(f"{spec.title} cannot be downloaded automatically: nothing was fetched.")
    missing = survey(spec, str(root), None).missing()
    lines += [f"missing: {line}" for line in missing]
    if missing:
        lines += [f"by hand: {host.what}: {host.url}\n         {host.how}" for host in spec.hosts]
    sys.stdout.write("\n".join(lines) + "\n")
    return 0 if spec.downloads else 1
