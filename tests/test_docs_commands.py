"""Every command that the documents print is one that there is, with options and settings that there are."""

import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from lodbench.cli import main
from lodbench.cli.parser import COMMANDS, Parser, load_command

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = sorted(
    path.relative_to(ROOT)
    for pattern in ("*.md", "docs/*.md", "docs/stories/*.md", "data_cards/*.md", "baselines/*/*.md")
    for path in ROOT.glob(pattern)
    # What was is told of old words too.
    if path.name != "CHANGELOG.md"
)
# Hydra composes each setting of the many that these sweep over.
SWEEPING = {"docs/benchmarks.md", "docs/evaluation.md", "docs/segmentation.md"}
FENCED = re.compile(r"^```[\w ]*\n(.*?)^```", re.DOTALL | re.MULTILINE)
INLINE = re.compile(r"(?<!`)`lodbench ([^`]+)`(?!`)")
# One command of a line of a shell, after its prompt and the variables it is given.
SHELL = re.compile(r"\s*(?:\$ )?(?:\w+=\S+ )*(?:(?:torchrun .*-m|python3? -m) )?lodbench (.*)")
# What the documents let their reader write, and names that stand for others.
NAMES = (
    "NAME DATASET KIND WHAT yours shake halfway bright thumbnail alps north xyz table cantons painter area "
    "horizon"
)
MADE_UP = re.compile(rf"cannot be started|['=](?:<name>|{'|'.join(NAMES.split())})(?!\w)")


class Left(Exception):
    """Left a command once its words were understood."""


def commands_in(text: str) -> Iterator[tuple[list[str], bool]]:
    """Yields the words after ``lodbench``, and whether they are a whole command, not one in a sentence."""
    for block in FENCED.findall(text):
        for line in block.replace("\\\n", " ").splitlines():
            for part in re.split(r"\s(?:&&|\|\||;)\s", line):
                found = SHELL.match(part)
                if found:
                    yield words_of(found[1]), True
    for command in INLINE.findall(FENCED.sub("", text)):
        yield words_of(command), False


def words_of(command: str) -> list[str]:
    """Returns the words as a shell parts them, without comments, pipes and what is left out."""
    command = re.sub(r'"?\$\(.*\)"?', "VALUE", command)
    words = shlex.split(re.split(r"\s[|>]\s?|\s2>", command)[0].replace("[--", "--"), comments=True)
    return [word.rstrip("]") if word.startswith("--") else word for word in words if "..." not in word]


def fault_in(words: list[str], is_whole: bool, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> str:
    """Returns what a command's own parser has to say against it; nothing where it understands all."""
    if words[0] not in COMMANDS:
        return "" if words[0].startswith("-") or words[0] in NAMES.split() else f"no command {words[0]}"
    if "--help" in words or (len(words) == 1 and not is_whole):
        return ""
    run = load_command(COMMANDS[words[0]][0])
    module = sys.modules[run.__module__]

    def understood(*_: Any) -> None:
        raise Left

    with monkeypatch.context() as patched:
        if hasattr(module, "run_hydra"):
            real = module.run_hydra
            patched.setattr(
                module, "run_hydra", lambda command, name, task, argv: real(command, name, understood, argv)
            )
        parse = Parser.parse_args

        def parse_args(self: Parser, *given: Any) -> None:
            parse(self, *given)
            raise Left

        patched.setattr(Parser, "parse_args", parse_args)
        try:
            main(words)
        except Left:
            return ""
        except SystemExit as left:
            return f"ends with {left.code}"
    said: str = capsys.readouterr().err
    is_partial = not is_whole and ("required: " in said or "is required" in said)
    stands_for_another = re.search(r"invalid (?:int|float) value: '[A-Z]", said) or MADE_UP.search(said)
    return "" if is_partial or stands_for_another else said


@pytest.mark.parametrize(
    "document",
    [
        pytest.param(path, id=str(path), marks=pytest.mark.slow if str(path) in SWEEPING else ())
        for path in DOCUMENTS
    ],
)
def test_its_commands_are_understood(document, monkeypatch, tmp_path, capsys):
    found = list(commands_in((ROOT / document).read_text("utf-8")))
    monkeypatch.chdir(tmp_path)
    faults = {
        " ".join(words): said
        for words, is_whole in found
        if (said := fault_in(words, is_whole, monkeypatch, capsys))
    }
    assert not faults


@pytest.mark.parametrize(
    "command",
    [
        "localize a.jpg --city c.gml --no-such 3",
        "localize a.jpg",
        "dataset initiate own",
        "bench flights --city c.gml --sead 1",
        "run method=region method.no_such=1",
        "run methd=region",
        "lokalize a.jpg",
    ],
)
def test_what_there_is_not_is_told(command, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    assert fault_in(words_of(command), True, monkeypatch, capsys)


def test_commands_are_found():
    shell = "$ lodbench city info \\\n  A.gml   # so\nlodbench doctor | head\n"
    text = f"a `lodbench run seed=1 ...` b\n```sh\n{shell}```\n"
    assert list(commands_in(text)) == [
        (["city", "info", "A.gml"], True),
        (["doctor"], True),
        (["run", "seed=1"], False),
    ]
    assert len(list(commands_in((ROOT / "README.md").read_text("utf-8")))) > 15
