"""`lodbench dataset ACTION ...`: what there is, whether it is sound, and where priors come from."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from lodbench.cli.commands import load_command
from lodbench.errors import ConfigError, nearest_names

_AT = "lodbench.cli"
# Action -> (as of ``COMMANDS``; the words begin with the action; one line of help).
ACTIONS = {
    "list": (f"{_AT}.dataset_list", "what is there, what is missing, where to get it"),
    "check": (f"{_AT}.dataset_check", "is it sound: files, counts, poses, priors, photos, city model"),
    "download": (
        f"{_AT}.dataset_list:main_download",
        "fetch what has a stable address; say how to get the rest",
    ),
    "card": (f"{_AT}.dataset_card", "its card: licence, provenance, truth, splits, known issues"),
    "prior": (
        f"{_AT}.dataset_check:main_prior",
        "write a dataset's priors to a file: drawn, or the photos' own",
    ),
    "init": (f"{_AT}.dataset_own", "a dataset from your photos and a city model"),
    "import": (f"{_AT}.dataset_own", "a dataset from another program's poses"),
    "make-demo": (
        f"{_AT}.dataset_list:main_demo",
        "write the demo town, its queries and masks to a folder",
    ),
}


def usage() -> str:
    """Returns the help of `lodbench dataset --help`."""
    width = max(map(len, ACTIONS))
    head = "usage: lodbench dataset ACTION [...]        lodbench dataset ACTION --help"
    lines = [f"  {name.ljust(width)}  {help_}" for name, (_, help_) in ACTIONS.items()]
    return "\n".join([head, "", *lines, ""])


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code.

    Raises:
        ConfigError: There is no such action.
    """
    if not argv or argv[0] in ("-h", "--help"):
        sys.stdout.write(usage())
        return 0 if argv else 2
    if argv[0] not in ACTIONS:
        raise ConfigError(f"There is no `lodbench dataset {argv[0]}`.", nearest_names(argv[0], ACTIONS))
    return load_command(ACTIONS[argv[0]][0])(argv)
