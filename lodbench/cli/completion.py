"""`lodbench completion bash|zsh`: words that complete themselves; `lodbench __complete` answers shells."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence

from lodbench.cli.commands import COMMANDS, load_command
from lodbench.cli.configs import config_files
from lodbench.cli.parser import Parser, seen
from lodbench.cli.settings import config_text, groups_of, settings_in
from lodbench.errors import LodbenchError

# Commands in Hydra's grammar, and their files in conf.
CONFIGURED = {
    name: name for name in ("run", "basin", "evaluate", "render", "train", "generate-training-data")
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


def main(argv: Sequence[str]) -> int:
    """Prints the script of a shell; returns the exit code."""
    parser = Parser(
        "lodbench completion", "Print what makes a shell complete the words of lodbench.", _EPILOG
    )
    parser.add_argument(
        "shell", choices=sorted(_SCRIPTS), metavar="bash|zsh", help="what to complete words in"
    )
    sys.stdout.write(_SCRIPTS[parser.parse_args(argv).shell])
    return 0


def answer(words: Sequence[str]) -> int:
    """Prints the completions of the last of some words, one a line; returns the exit code, always 0."""
    typed = words[-1] if words else ""
    found: Iterable[str]
    if len(words) < 2:
        found = COMMANDS
    elif words[0] in CONFIGURED:
        found = _settings(words[0], words[1:-1], typed)
    else:
        found = _flags(words[0], words[1:-1], typed)
    sys.stdout.write("".join(f"{word}\n" for word in sorted(found) if word.startswith(typed)))
    return 0


def _settings(command: str, before: Sequence[str], typed: str) -> Iterable[str]:
    """Returns settings up to their equals sign; behind the one of a group, its names."""
    groups = groups_of(CONFIGURED[command])
    key, equals, _ = typed.partition("=")
    if equals:
        folder = next((group.folder for group in groups if group.key == key), None)
        return [f"{key}={name}" for name in config_files(folder)] if folder else []
    chosen = dict(word.split("=", 1) for word in before if "=" in word)
    names = [f"{group.key}=" for group in groups]
    names += [f"{setting.key}=" for setting in settings_in(config_text(CONFIGURED[command]))]
    names += ["city=", "root="] if command in ("run", "basin", "evaluate") else []
    for group in groups:
        file = config_files(group.folder).get(chosen.get(group.key, group.name))
        if file is not None and typed.startswith(f"{group.key}."):
            text = file.read_text(encoding="utf-8")
            names += [f"{setting.key}=" for setting in settings_in(text, f"{group.key}.")]
    return dict.fromkeys(names)


class _Found(Exception):
    """Leaves a command once its parser is known."""


def _flags(command: str, before: Sequence[str], typed: str) -> Iterable[str]:
    """Returns what may follow in a command with a parser of its own, asked without running it.

    Flags where one is begun, else the words that there is a choice of; where a file may stand, none.
    """
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
            raise _Found

    seen.append(keep)
    try:
        run(list(before))
    except (_Found, LodbenchError, SystemExit):
        pass
    finally:
        seen.remove(keep)
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
