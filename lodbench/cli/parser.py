"""What commands there are, the help above them, and the parser of those with flags.

A fault is one line with a hint, not a wall of usage.
"""

from __future__ import annotations

import argparse
import logging
import re
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TextIO, cast

from lodbench.errors import ConfigError, LodbenchError, nearest_names
from lodbench.reporting.aligned_text import plain_lines, plain_text

if TYPE_CHECKING:
    from lodbench.findings import Check

# Command -> (module with `main(argv) -> int`, or module:function; one line of help).
COMMANDS = {
    "localize": ("lodbench.cli.localize", "localise your photos: pose, overlay, map, reliability"),
    "locate": ("lodbench.cli.locate", "map coordinates of pixels, or mask regions, of a localised photo"),
    "track": (
        "lodbench.cli.track_georeference:main_track",
        "localise each frame of a video or of a folder of frames",
    ),
    "georeference": (
        "lodbench.cli.track_georeference:main_georeference",
        "georeference a COLMAP model by its buildings, without ground control points",
    ),
    "mask": (
        "lodbench.cli.mask_trace:main_mask",
        "make or correct a photo's building mask by hand; LabelMe, COCO, QGIS",
    ),
    "trace": (
        "lodbench.cli.mask_trace:main_trace",
        "trace a map of roofs in the photos of a COLMAP model; make a benchmark",
    ),
    "run": ("lodbench.cli.run", "localise the photos of a dataset with one method, and score the poses"),
    "basin": ("lodbench.cli.run:main_basin", "measure recall over the error of the prior"),
    "evaluate": (
        "lodbench.cli.verify:main_evaluate",
        "score poses made by another program: COLMAP, TUM, ...",
    ),
    "compare": ("lodbench.cli.compare", "put runs into one table, and test whether they differ"),
    "report": (
        "lodbench.cli.stored_runs:main_report",
        "write an HTML page of a run: tables, figures, every photo",
    ),
    "export": (
        "lodbench.cli.stored_runs:main_export",
        "write a run's poses for other programs: COLMAP, Metashape, GeoJSON, ...",
    ),
    "status": ("lodbench.cli.stored_runs:main_status", "show the progress of runs"),
    "verify": ("lodbench.cli.verify", "recompute a run's numbers from its stored poses; fail if they differ"),
    "leaderboard": ("lodbench.cli.compare:main_leaderboard", "add a verified run; build tables and pages"),
    "bench": ("lodbench.cli.bench", "measure speed and accuracy, beside other programs"),
    "city": ("lodbench.cli.city", "inspect, check or convert a city model"),
    "dataset": (
        "lodbench.cli.parser:dataset",
        "list, check, download or import datasets; make one of your photos (init)",
    ),
    "render": (
        "lodbench.cli.training:main_render",
        "draw a city from given poses: silhouette, depth, label, colour, overlay",
    ),
    "generate-training-data": (
        "lodbench.cli.training:main_generate",
        "render images, masks and poses of a city",
    ),
    "train": (
        "lodbench.cli.training:main_train",
        "train a segmentation network, or a method, on such images",
    ),
    "doctor": (
        "lodbench.cli.doctor:main_doctor",
        "check this installation, and say what to install for optional features",
    ),
    "check-method": ("lodbench.cli.doctor:main_method", "check that a method conforms to the protocol"),
    "check-plugin": (
        "lodbench.cli.doctor:main_plugin",
        "check any other plug-in likewise: see docs/plugins.md",
    ),
    "completion": (
        "lodbench.cli.shell:main_completion",
        "print a script that completes commands in bash or zsh",
    ),
}

# Action of `lodbench dataset` -> (as of ``COMMANDS``; the words begin with the action; one line of help).
ACTIONS = {
    "list": ("lodbench.cli.dataset:main_list", "what is there, what is missing, where to get it"),
    "check": (
        "lodbench.cli.dataset:main_check",
        "is it sound: files, counts, poses, priors, photos, city model",
    ),
    "download": (
        "lodbench.cli.dataset:main_download",
        "fetch what has a stable address; say how to get the rest",
    ),
    "card": ("lodbench.cli.dataset:main_card", "its card: licence, provenance, truth, splits, known issues"),
    "prior": (
        "lodbench.cli.dataset:main_prior",
        "write a dataset's priors to a file: drawn, or the photos' own",
    ),
    "init": ("lodbench.cli.dataset_own", "a dataset from your photos and a city model"),
    "import": ("lodbench.cli.dataset_own", "a dataset from another program's poses"),
    "make-demo": ("lodbench.cli.dataset:main_demo", "write the demo town, its queries and masks to a folder"),
}

# The first command of each group -> what stands above the group in the help.
HEADINGS = {
    "localize": "Your photos",
    "run": "Methods and their results",
    "city": "City models and datasets",
    "generate-training-data": "Training",
    "doctor": "This machine, and plug-ins",
}

USAGE = """\
lodbench localises aerial photos in a 3D city model, and benchmarks methods that do so.

Usage: lodbench COMMAND [...]
       lodbench COMMAND --help

Start here:
  lodbench run method=region dataset=demo          # try it: 40 photos of a built-in town
  lodbench city info FILE                          # is your city model read correctly?
  lodbench localize PHOTO ... --city FILE          # where were your photos taken?
  lodbench run dataset=folder dataset.root=DIR city=FILE   # a method over a dataset of your own
{commands}

`lodbench doctor` lists plug-ins, their commands too.
"""
_NEGATIVE = re.compile(r"-(\d+\.?\d*|\.\d+)(e[-+]?\d+)?$", re.IGNORECASE)
# While words are completed: receives the parser instead of its parsing anything.
waiting: list[Callable[[argparse.ArgumentParser], None]] = []


def load_command(place: str) -> Callable[[Sequence[str]], int]:
    """Returns the function of a command, as ``COMMANDS`` places it: from words to an exit code."""
    module, _, name = place.partition(":")
    return cast("Callable[[Sequence[str]], int]", getattr(import_module(module), name or "main"))


def _dataset_usage() -> str:
    """Returns the help of `lodbench dataset --help`."""
    width = max(map(len, ACTIONS))
    head = "usage: lodbench dataset ACTION [...]        lodbench dataset ACTION --help"
    lines = [f"  {name.ljust(width)}  {help_}" for name, (_, help_) in ACTIONS.items()]
    return "\n".join([head, "", *lines, ""])


def dataset(argv: Sequence[str]) -> int:
    """Runs `lodbench dataset ACTION`; returns the exit code.

    Raises:
        ConfigError: There is no such action.
    """
    if not argv or argv[0] in ("-h", "--help"):
        sys.stdout.write(_dataset_usage())
        return 0 if argv else 2
    if argv[0] not in ACTIONS:
        raise ConfigError(f"There is no `lodbench dataset {argv[0]}`.", nearest_names(argv[0], ACTIONS))
    return load_command(ACTIONS[argv[0]][0])(argv)


class Parser(argparse.ArgumentParser):
    """An ``ArgumentParser`` whose faults are ``ConfigError``, and which names the flag that was meant."""

    def __init__(
        self, prog: str | None = None, description: str | None = None, epilog: str | None = None, **named: Any
    ) -> None:
        if epilog is not None:  # printed line by line, as it stands
            named.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        # An abbreviation that works today is another flag's name tomorrow.
        super().__init__(prog, description=description, epilog=epilog, **{"allow_abbrev": False, **named})
        self.register("action", "former", OldName)
        # Python's own pattern takes -1.5e-3 for an option.
        self._negative_number_matcher = _NEGATIVE

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parses words; a flag that does not exist is reported before what else is missing.

        Raises:
            ConfigError: A word is wrong, or one is missing.
        """
        words: Sequence[str] = sys.argv[1:] if args is None else args
        if waiting:
            waiting[-1](self)
        if not any(isinstance(action, argparse._SubParsersAction) for action in self._actions):
            self._require_flags(words)
        options, left = super().parse_known_args(args, namespace)
        # argparse ends a list of words at the first flag; what stands behind it belongs to it all the same.
        for action in self._get_positional_actions():
            if action.nargs in ("+", "*"):
                more = [self._get_value(action, word) for word in left if not word.startswith("-")]
                setattr(options, action.dest, [*getattr(options, action.dest), *more])
                left = [word for word in left if word.startswith("-")]
        return options, left

    def _require_flags(self, words: Sequence[str]) -> None:
        for before, word in pairwise(["", *words]):
            if word == "--":
                return
            if not self._takes_value(before):
                self._require_dashes(word)
            flag = word.partition("=")[0]
            if flag.startswith("--") and flag not in self._option_string_actions:
                known = [name for name in self._option_string_actions if name.startswith("--")]
                raise ConfigError(f"{self.prog} has no option {flag}.", nearest_names(flag, known))

    def _takes_value(self, word: str) -> bool:
        action = self._option_string_actions.get(word)
        return action is not None and action.nargs != 0

    def _require_dashes(self, word: str) -> None:
        """Refuses ``key=value``, as commands of settings have it, where an option is meant."""
        name, equals, value = word.partition("=")
        if equals and f"--{name}" in self._option_string_actions and not Path(word).exists():
            hint = f"Options have dashes: --{name} {shlex.quote(value)}"
            raise ConfigError(f"{self.prog}: {word} is not a file.", hint)

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            name = "/".join(action.option_strings) or "action"
            raise ConfigError(
                f"{self.prog}: there is no {name} {value!r}.", nearest_names(str(value), action.choices)
            )

    def error(self, message: str) -> NoReturn:
        """Reports a fault.

        Raises:
            ConfigError: Always.
        """
        text = message.replace("the following arguments are required:", "required:")
        if text.startswith("argument --"):
            flag = text.split()[1].rstrip(":")
            text = text.replace(flag, f"`{flag}`", 1)
        # An option of several words takes those after it as well.
        first = "Arguments go before options. " if "required: " in text and "required: -" not in text else ""
        hint = f"{first}See {self.prog} --help."
        raise ConfigError(f"{self.prog}: {text.rstrip('.')}.", hint)


class OldName(argparse.Action):
    """A flag's former name: it works, and says what it is called now."""

    def __init__(self, option_strings: Sequence[str], dest: str, **named: Any) -> None:
        super().__init__(option_strings, dest, help=argparse.SUPPRESS, **named)

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        """Sets the value and reports the new name."""
        new = next(
            action.option_strings[-1]
            for action in parser._actions
            if action.dest == self.dest and not isinstance(action, OldName)
        )
        report_old_name(str(option_string), new)
        setattr(namespace, self.dest, values)


def report_old_name(old: str, new: str) -> None:
    """Says in one line that a name was changed."""
    sys.stderr.write(f"lodbench: {old} is now called {new}; the old name goes with version 0.3.\n")


class PlainStream:
    """A stream that terminal sequences and other control characters from data do not pass."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Writes a text; kept are line ends, tabs and the return that drawings of a bar begin with."""
        start = "\r" if text.startswith("\r") else ""
        # Names of files may hold bytes that are no text, which no stream takes.
        plain = plain_lines(text.removeprefix(start))
        self._stream.write(start + plain.encode("utf-8", errors="backslashreplace").decode("utf-8"))
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class PlainFormatter(logging.Formatter):
    """Lines of warnings, without what would steer a terminal."""

    def format(self, record: logging.LogRecord) -> str:
        """Returns the line of a record."""
        return f"lodbench: {plain_text(record.getMessage())}"


class OnceFilter(logging.Filter):
    """Lets a warning pass once: what a command does city by city it need not say for each."""

    def __init__(self) -> None:
        super().__init__()
        self._lines: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        """Returns whether a record's line is a new one."""
        line = record.getMessage()
        is_new = line not in self._lines
        self._lines.add(line)
        return is_new


def report_fault(fault: LodbenchError) -> None:
    """Writes a fault to standard error: a line, or the lines it has, and its hint below."""
    sys.stderr.write(f"lodbench: {plain_lines(fault.message)}\n")
    if fault.hint:
        sys.stderr.write(f"  hint: {plain_lines(fault.hint)}\n")


def check_lines(checks: Sequence[Check]) -> Iterator[str]:
    """Yields a line per check, below the name of its section, and its hint below that."""
    width = max(len(check.name) for check in checks)
    section = ""
    for check in checks:
        if check.section != section:
            section = check.section
            yield f"{section}:"
        yield f"  {check.status:6}  {check.name.ljust(width)}  {check.detail}"
        if check.hint:
            yield f"  {'':6}  {'':{width}}  -> {check.hint}"


def plain_check(check: Check) -> Check:
    """Returns a check whose words, anybody's text, cannot move a terminal's cursor; indents are ours."""
    return replace(check, detail=plain_text(check.detail), hint=plain_text(check.hint))


def traceback_lines(checks: Sequence[Check]) -> Iterator[str]:
    """Yields the tracebacks of checks, each below the name of its own."""
    for check in checks:
        if check.traceback:
            yield f"{check.name}:"
            yield from (f"  {plain_lines(line)}" for line in check.traceback.splitlines())
