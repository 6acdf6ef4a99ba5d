"""The command line: `lodbench COMMAND ...`. Nothing heavy is imported before a command is chosen."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from typing import cast

from lodbench.cli.commands import COMMANDS, HEADINGS, USAGE, load_command

__all__ = ["COMMANDS", "main", "usage"]


def usage() -> str:
    """Returns the help of `lodbench --help`."""
    width = max(map(len, COMMANDS))
    lines: list[str] = []
    for name, (_, help_) in COMMANDS.items():
        if name in HEADINGS:
            lines += ["", f"{HEADINGS[name]}:"]
        lines.append(f"  {name.ljust(width)}  {help_}")
    return USAGE.format(commands="\n".join(lines))


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
    import gc
    import logging

    # What a command imports are some hundred thousand objects that stay: looked through once, not 400 times.
    gc.set_threshold(50_000, 10, 10)
    from lodbench.cli.parser import PlainFormatter, SaidOnce, report_fault
    from lodbench.errors import LodbenchError

    if logging.lastResort is not None:
        logging.lastResort.setFormatter(PlainFormatter())
        logging.lastResort.filters[:] = [SaidOnce()]
    try:
        return _run(words)
    except LodbenchError as error:
        from lodbench.cli.settings import in_syntax_of

        error.message, error.hint = in_syntax_of(words, error.message), in_syntax_of(words, error.hint)
        report_fault(error)
        return 2
    except BrokenPipeError:
        # The reader of a pipe has left (`| head`): leave quietly, and keep Python from flushing again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        from lodbench.storage.disk import final_name

        reason = f"{final_name(error.filename) or 'A file'}: {error.strerror or error}."
        report_fault(LodbenchError(reason, "Check the path, its permissions and the free space."))
        return 2
    except KeyboardInterrupt:
        again = f" The same command again {_GOES_ON[words[0]]}." if words[0] in _GOES_ON else ""
        sys.stderr.write(f"\nlodbench: stopped.{again}\n")
        return 130


def _help_of_settings(words: list[str]) -> int | None:
    """Writes the help of a command whose words are settings, without loading the command itself.

    Returns:
        The exit code; None where the command parses flags, and has help of its own.
    """
    from lodbench.cli.settings import SETTINGS_COMMANDS, names_method

    command, *rest = words
    if command not in SETTINGS_COMMANDS:
        return None
    from lodbench.cli.settings import help_text

    is_of_method = command == "train" and names_method(rest)
    sys.stdout.write(help_text(command, "train-method" if is_of_method else command, rest))
    return 0


# What a command does that is given again after it was stopped.
_GOES_ON = dict.fromkeys(("run", "basin", "generate-training-data"), "goes on from here") | {
    "train": "goes on after the last epoch that was validated, if there is one, else from the start"
}


def _run(words: list[str]) -> int:
    """Runs the command that the first word names; returns its exit code."""
    import contextlib

    from lodbench.cli.parser import PlainStream

    if words[0] == "__complete":
        from lodbench.cli.completion import answer

        return answer(words[1:])
    of_plugin = None if words[0] in COMMANDS else _plugin_command(words[0])
    # Names and texts of cities, photos and runs come from strangers.
    streams = PlainStream(sys.stdout), PlainStream(sys.stderr)
    with contextlib.redirect_stdout(streams[0]), contextlib.redirect_stderr(streams[1]):
        code = _help_of_settings(words) if {"-h", "--help"}.intersection(words) else None
        if of_plugin is not None:
            from lodbench.plugins import blaming

            with blaming("commands", words[0], "run"):
                code = int(of_plugin(words[1:]) or 0)
        elif code is None:
            code = load_command(COMMANDS[words[0]][0])(words[1:])
    sys.stdout.flush()
    return code


def _plugin_command(name: str) -> Callable[[Sequence[str]], int | None]:
    """Returns the function of another package's command; lodbench's own are found without a scan."""
    from lodbench.errors import LodbenchError, nearest_names
    from lodbench.plugins import load_plugin, plugin_names

    others = plugin_names("commands")
    if name not in others:
        raise LodbenchError(f"There is no command {name!r}.", nearest_names(name, [*COMMANDS, *others]))
    return cast("Callable[[Sequence[str]], int | None]", load_plugin("commands", name))
