"""The command line: `lodbench COMMAND ...`. Nothing heavy is imported before a command is chosen."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import import_module

# Command -> (module with `main(argv) -> int`, one line of help).
COMMANDS = {
    "run": ("lodbench.cli.run", "find the poses of a dataset with one method; print recalls"),
    "basin": ("lodbench.cli.basin", "recall over the error of the prior; the cost around the truth"),
    "localize": ("lodbench.cli.localize", "find where photos were taken: table, overlays, map, how sure"),
    "track": ("lodbench.cli.track", "find where each frame of a video, or of photos in turn, was taken"),
    "georeference": (
        "lodbench.cli.georeference",
        "place a COLMAP model in a city by its buildings: no ground control points",
    ),
    "compare": ("lodbench.cli.compare", "put finished runs side by side, and test whether they differ"),
    "evaluate": ("lodbench.cli.evaluate", "score poses made elsewhere: lines, c2w, COLMAP, TUM"),
    "verify": ("lodbench.cli.verify", "score a run again from its stored poses; fail if its numbers differ"),
    "status": ("lodbench.cli.status", "how far runs are"),
    "report": ("lodbench.cli.report", "write one HTML page of a run: tables, figures, pictures, every query"),
    "export": (
        "lodbench.cli.export",
        "write a run's poses as COLMAP, kapture, TUM, nerfstudio, GeoJSON, ...",
    ),
    "leaderboard": ("lodbench.cli.leaderboard", "add a verified run; build tables and pages"),
    "render": (
        "lodbench.cli.render",
        "draw a city from given poses: silhouette, depth, label, colour, overlay",
    ),
    "generate-training-data": (
        "lodbench.cli.generate_training_data",
        "picture a city from many places, with masks and poses, to train on",
    ),
    "train": ("lodbench.cli.train", "train a segmentation network on such pictures"),
    "mask": (
        "lodbench.cli.mask",
        "correct a photo's building mask on a page; polygons for LabelMe, COCO, QGIS",
    ),
    "city": ("lodbench.cli.city", "look into a city model: info, check; write it in another format: convert"),
    "dataset": (
        "lodbench.cli.dataset",
        "list, check, download, describe datasets; make one of your own: init, import; priors; make-demo",
    ),
    "bench": (
        "lodbench.cli.bench",
        "measure speed and accuracy beside other programs: silhouettes, accuracy, city",
    ),
    "check-method": ("lodbench.cli.check_method", "does a method, yours perhaps, keep to the protocol?"),
    "check-plugin": (
        "lodbench.cli.check_plugin",
        "does any other plug-in? See docs/plugins.md",
    ),
    "doctor": ("lodbench.cli.doctor", "say what works on this machine, and what to install for the rest"),
    "completion": ("lodbench.cli.completion", "print what makes bash or zsh complete these words"),
}

_USAGE = """\
lodbench: where was the camera? City models, silhouettes, and a benchmark for aerial localisation.

Usage: lodbench COMMAND [...]        lodbench COMMAND --help

{commands}

Start here:
  lodbench run method=region dataset=demo
  lodbench localize PHOTO ... --city FILE # where were they taken?
  lodbench run dataset=folder dataset.root=DIR city=FILE
  lodbench city info FILE                 # is it read as it should be?
"""


def usage() -> str:
    """Returns the help of `lodbench --help`."""
    width = max(map(len, COMMANDS))
    return _USAGE.format(
        commands="\n".join(f"  {name.ljust(width)}  {help_}" for name, (_, help_) in COMMANDS.items())
    )


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
