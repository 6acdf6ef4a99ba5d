"""The command line: `lodbench COMMAND ...`. Nothing heavy is imported before a command is chosen."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import import_module

# Command -> (module with `main(argv) -> int`, one line of help).
COMMANDS = {
    "localize": (
        "lodbench.cli.localize",
        "localise your photos: pose, overlay, map, reliability",
    ),
    "locate": (
        "lodbench.cli.locate",
        "map coordinates of pixels, or mask regions, of a localised photo",
    ),
    "track": ("lodbench.cli.track", "localise each frame of a video or of a folder of frames"),
    "georeference": (
        "lodbench.cli.georeference",
        "georeference a COLMAP model by its buildings, without ground control points",
    ),
    "mask": ("lodbench.cli.mask", "make or correct a photo's building mask by hand; LabelMe, COCO, QGIS"),
    "trace": ("lodbench.cli.trace", "trace a map of roofs in the photos of a COLMAP model; make a benchmark"),
    "run": ("lodbench.cli.run", "localise the photos of a dataset with one method, and score the poses"),
    "basin": ("lodbench.cli.basin", "measure recall over the error of the prior"),
    "evaluate": ("lodbench.cli.evaluate", "score poses made by another program: COLMAP, TUM, ..."),
    "compare": ("lodbench.cli.compare", "put runs into one table, and test whether they differ"),
    "report": ("lodbench.cli.report", "write an HTML page of a run: tables, figures, every photo"),
    "export": (
        "lodbench.cli.export",
        "write a run's poses for other programs: COLMAP, Metashape, GeoJSON, ...",
    ),
    "status": ("lodbench.cli.status", "show the progress of runs"),
    "verify": ("lodbench.cli.verify", "recompute a run's numbers from its stored poses; fail if they differ"),
    "leaderboard": ("lodbench.cli.leaderboard", "add a verified run; build tables and pages"),
    "bench": ("lodbench.cli.bench", "measure speed and accuracy, beside other programs"),
    "city": ("lodbench.cli.city", "inspect, check or convert a city model"),
    "dataset": (
        "lodbench.cli.dataset",
        "list, check, download or import datasets; make one of your photos (init)",
    ),
    "render": (
        "lodbench.cli.render",
        "draw a city from given poses: silhouette, depth, label, colour, overlay",
    ),
    "generate-training-data": (
        "lodbench.cli.generate_training_data",
        "render images, masks and poses of a city",
    ),
    "train": ("lodbench.cli.train", "train a segmentation network, or a method, on such images"),
    "doctor": (
        "lodbench.cli.doctor",
        "check this installation, and say what to install for optional features",
    ),
    "check-method": ("lodbench.cli.check_method", "check that a method conforms to the protocol"),
    "check-plugin": (
        "lodbench.cli.check_plugin",
        "check any other plug-in likewise: see docs/plugins.md",
    ),
    "completion": ("lodbench.cli.completion", "print a script that completes commands in bash or zsh"),
}

# The first command of each group -> what stands above the group in the help.
_HEADINGS = {
    "localize": "Your photos",
    "run": "Methods and their results",
    "city": "City models and datasets",
    "generate-training-data": "Training",
    "doctor": "This machine, and plug-ins",
}

_USAGE = """\
lodbench localises aerial photos in a 3D city model, and benchmarks methods that do so.

Usage: lodbench COMMAND [...]
       lodbench COMMAND --help

Start here:
  lodbench run method=region dataset=demo          # try it: 40 photos of a built-in town
  lodbench city info FILE                          # is your city model read correctly?
  lodbench localize PHOTO ... --city FILE          # where were your photos taken?
  lodbench run dataset=folder dataset.root=DIR city=FILE   # a method over a dataset of your own
{commands}
"""


def usage() -> str:
    """Returns the help of `lodbench --help`."""
    width = max(map(len, COMMANDS))
    lines: list[str] = []
    for name, (_, help_) in COMMANDS.items():
        if name in _HEADINGS:
            lines += ["", f"{_HEADINGS[name]}:"]
        lines.append(f"  {name.ljust(width)}  {help_}")
    return _USAGE.format(commands="\n".join(lines))


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns its exit code: 0 done, 2 a fault the message explains, 130 stopped."""
    words = list(sys.argv[1:] if argv is None else argv)
    if not words or words[0] in ("-h", "--help", "help"):
        sys.stdout.write(usage())
        return 0
    # Of any command too: Hydra would answer with a version of its own.
    if words[0] == "-V" or "--version" in words:
        from lodbench import __version__

        sys.stdout.write(f"lodbench {__version__}\n")
        return 0
    import logging

    from lodbench.cli.console import PlainFormatter, SaidOnce, report_fault
    from lodbench.errors import LodbenchError

    if logging.lastResort is not None:
        logging.lastResort.setFormatter(PlainFormatter())
        logging.lastResort.filters[:] = [SaidOnce()]
    try:
        return _run(words)
    except LodbenchError as error:
        from lodbench.cli.flags import in_syntax_of

        error.hint = in_syntax_of(words, error.hint)
        report_fault(error)
        return 2
    except BrokenPipeError:
        # The reader of a pipe has left (`| head`): leave quietly, and keep Python from flushing again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        from lodbench.storage.atomic import final_name

        reason = f"{final_name(error.filename) or 'A file'}: {error.strerror or error}."
        report_fault(LodbenchError(reason, "Check the path, its permissions and the free space."))
        return 2
    except KeyboardInterrupt:
        again = f" The same command again {_GOES_ON[words[0]]}." if words[0] in _GOES_ON else ""
        sys.stderr.write(f"\nlodbench: stopped.{again}\n")
        return 130


# What a command does that is given again after it was stopped.
_GOES_ON = dict.fromkeys(("run", "basin", "generate-training-data"), "goes on from here") | {
    "train": "goes on after the last epoch that was validated, if there is one, else from the start"
}


def _run(words: list[str]) -> int:
    """Runs the command that the first word names; returns its exit code.

    Raises:
        LodbenchError: There is no such command, or it is its own.
    """
    import contextlib

    from lodbench.cli.console import PlainStream
    from lodbench.errors import LodbenchError, nearest_names

    if words[0] == "__complete":
        from lodbench.cli.completion import answer

        return answer(words[1:])
    if words[0] not in COMMANDS:
        raise LodbenchError(f"There is no command {words[0]!r}.", nearest_names(words[0], COMMANDS))
    # Names and texts of cities, photos and runs come from strangers.
    streams = PlainStream(sys.stdout), PlainStream(sys.stderr)
    with contextlib.redirect_stdout(streams[0]), contextlib.redirect_stderr(streams[1]):
        code: int = import_module(COMMANDS[words[0]][0]).main(words[1:])
    sys.stdout.flush()
    return code
