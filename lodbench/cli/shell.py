"""The command line, what a shell calls: `lodbench COMMAND ...`, and `lodbench completion bash|zsh`.

Nothing heavy is imported before a command is chosen.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, cast

from lodbench.cli.parser import COMMANDS, HEADINGS, USAGE, load_command

if TYPE_CHECKING:
    from lodbench.cli.parser import Parser
# What a command does that is given again after it was stopped.
_GOES_ON = dict.fromkeys(("run", "basin", "generate-training-data"), "goes on from here") | {
    "train": "goes on after the last epoch that was validated, if there is one, else from the start"
}
# The shells break words at "=" or not: both hand over the words as they are, and take back whole ones.
_BASH = r"""_lodbench() {
  local cur=${COMP_WORDS[COMP_CWORD]} line word
  local -a words=()
  # Bash parts words at "=" and ":"; the line as typed has them whole.
  read -ra words <<< "${COMP_LINE:0:COMP_POINT}"
  [[ ${COMP_LINE:0:COMP_POINT} == *" " ]] && words+=("")
  local typed=${words[-1]} head=
  [[ $typed == *=* ]] && head=${typed%"${typed##*=}"}
  COMPREPLY=()
  while IFS= read -r line; do
    [[ $line == "$typed"* ]] && COMPREPLY+=("${line#"$head"}")
  done < <(lodbench __complete "${words[@]:1}" 2>/dev/null)
  if [[ ${#COMPREPLY[@]} -eq 0 ]]; then
    while IFS= read -r line; do COMPREPLY+=("$line"); done < <(compgen -f -- "${typed#"$head"}")
  elif [[ ${#COMPREPLY[@]} -eq 1 && ${COMPREPLY[0]} == *= ]]; then
    compopt -o nospace 2>/dev/null
  fi
}
complete -o filenames -F _lodbench lodbench
"""
_ZSH = r"""#compdef lodbench
_lodbench() {
  local -a found
  found=("${(@f)$(lodbench __complete "${(@)words[2,CURRENT]}" 2>/dev/null)}")
  found=(${found:#})
  if (( ${#found} )); then
    local -a open closed
    open=(${(M)found:#*=}) closed=(${found:#*=})
    (( ${#open} )) && compadd -Q -S '' -- $open
    (( ${#closed} )) && compadd -Q -- $closed
  else
    [[ $PREFIX == *=* ]] && compset -P 1 '*='
    _files
  fi
  return 0
}
compdef _lodbench lodbench
"""
_SCRIPTS = {"bash": _BASH, "zsh": _ZSH}
_EPILOG = """\
Add to ~/.bashrc or ~/.zshrc (there after compinit), and open a new shell:
  source <(lodbench completion bash)
  source <(lodbench completion zsh)
"""


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
    from lodbench.cli.parser import OnceFilter, PlainFormatter, report_fault
    from lodbench.errors import LodbenchError

    if logging.lastResort is not None:
        logging.lastResort.setFormatter(PlainFormatter())
        logging.lastResort.filters[:] = [OnceFilter()]
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


def _run(words: list[str]) -> int:
    """Runs the command that the first word names; returns its exit code."""
    import contextlib

    from lodbench.cli.parser import PlainStream

    if words[0] == "__complete":
        return complete(words[1:])
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


def main_completion(argv: Sequence[str]) -> int:
    """Prints the script of a shell; returns the exit code."""
    from lodbench.cli.parser import Parser

    parser = Parser(
        "lodbench completion", "Print what makes a shell complete the words of lodbench.", _EPILOG
    )
    parser.add_argument(
        "shell", choices=sorted(_SCRIPTS), metavar="bash|zsh", help="what to complete words in"
    )
    sys.stdout.write(_SCRIPTS[parser.parse_args(argv).shell])
    return 0


def complete(words: Sequence[str]) -> int:
    """Prints the completions of the last of some words, one a line; returns the exit code, always 0."""
    from lodbench.cli.settings import SETTINGS_COMMANDS

    typed = words[-1] if words else ""
    completions: Iterable[str]
    if len(words) < 2:
        completions = COMMANDS
    elif words[0] in SETTINGS_COMMANDS:
        completions = _settings(words[0], words[1:-1], typed)
    else:
        completions = _flags(words[0], words[1:-1], typed)
    sys.stdout.write("".join(f"{word}\n" for word in sorted(completions) if word.startswith(typed)))
    return 0


def _settings(command: str, before: Sequence[str], typed: str) -> Iterable[str]:
    """Returns settings up to their equals sign; behind the one of a group, its names."""
    from lodbench.cli.settings import config_text, groups_of, settings_in
    from lodbench.plugins import config_files

    groups = groups_of(command)
    key, equals, _ = typed.partition("=")
    if equals:
        folder = next((group.folder for group in groups if group.key == key), None)
        return [f"{key}={name}" for name in config_files(folder)] if folder else []
    chosen = dict(word.split("=", 1) for word in before if "=" in word)
    names = [f"{group.key}=" for group in groups]
    names += [f"{setting.key}=" for setting in settings_in(config_text(command))]
    names += ["city=", "root="] if command in ("run", "basin", "evaluate") else []
    for group in groups:
        file = config_files(group.folder).get(chosen.get(group.key, group.name))
        if file is not None and typed.startswith(f"{group.key}."):
            text = file.read_text(encoding="utf-8")
            names += [f"{setting.key}=" for setting in settings_in(text, f"{group.key}.")]
    return dict.fromkeys(names)


class _ParserKnown(Exception):
    """Leaves a command once its parser is known."""


def _flags(command: str, before: Sequence[str], typed: str) -> Iterable[str]:
    """Returns what may follow in a command with a parser of its own, asked without running it.

    Flags where one is begun, else the words that there is a choice of; where a file may stand, none.
    """
    from lodbench.cli.parser import waiting
    from lodbench.errors import LodbenchError

    if command not in COMMANDS:
        return []
    run = load_command(COMMANDS[command][0])
    actions = list(getattr(sys.modules[run.__module__], "ACTIONS", {}))
    if actions and not before:
        return actions
    parsers: list[Parser] = []

    def keep(parser: object) -> None:
        parsers.append(parser)  # type: ignore[arg-type]
        if not any(hasattr(action, "_name_parser_map") for action in parsers[-1]._actions):
            raise _ParserKnown

    waiting.append(keep)
    try:
        run(list(before))
    except (_ParserKnown, LodbenchError, SystemExit):
        pass
    finally:
        waiting.remove(keep)
    if not parsers:
        return []
    last = parsers[-1]
    flag = last._option_string_actions.get(before[-1]) if before else None
    if flag is not None and flag.nargs != 0:
        return map(str, flag.choices or ())
    if typed.startswith("-"):
        return [name for name in last._option_string_actions if name.startswith("--")]
    return [
        str(word) for action in last._actions if not action.option_strings for word in action.choices or ()
    ]
