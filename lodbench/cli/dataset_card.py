"""`lodbench dataset card NAME`: a dataset's card as Markdown, and as Croissant JSON-LD."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lodbench.cli.configs import config_files
from lodbench.cli.parser import Parser
from lodbench.datasets.cards import croissant_text, read_card
from lodbench.datasets.published.catalogue import SPECS
from lodbench.errors import ConfigError, nearest_names
from lodbench.storage import make_folder, write_text

MARKDOWN, CROISSANT = ".md", ".croissant.json"


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code.

    Raises:
        ConfigError: There is no card of that name.
    """
    parser = Parser("lodbench dataset card", description="Print or write a dataset's card.")
    parser.add_argument("dataset", metavar="NAME", help="as `lodbench dataset list` has it")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="write NAME.md, and NAME.croissant.json for a download"
    )
    parser.add_argument("--croissant", action="store_true", help="print the JSON-LD instead of Markdown")
    options = parser.parse_args(argv[1:])
    texts = _texts(options.dataset)
    if options.out is None:
        if options.croissant and CROISSANT not in texts:
            raise ConfigError(
                f"{options.dataset} has no Croissant: that describes files to download.",
                "It is made on your machine; the card without --croissant says how.",
            )
        sys.stdout.write(texts[CROISSANT if options.croissant else MARKDOWN])
        return 0
    make_folder(options.out)
    for ending, text in texts.items():
        path = options.out / f"{options.dataset}{ending}"
        write_text(path, text)
        sys.stdout.write(f"{path}\n")
    return 0


@dataclass(frozen=True, slots=True)
class ConfigCard:
    """The card of a dataset that is no published one: ``dataset/NAME.md`` beside its configuration."""

    text: str
    title: str
    counts: dict[str, int]


def config_card(name: str) -> ConfigCard | None:
    """Returns the card beside a dataset's configuration; None if it has none.

    Raises:
        ConfigError: Its head is no YAML.
    """
    import yaml

    file = config_files("dataset", MARKDOWN).get(name)
    if file is None:
        return None
    text = re.sub(r"\A<!--.*?-->\s*", "", file.read_text(encoding="utf-8"))
    head = re.match(r"---\n(.*?)\n---\n", text, re.DOTALL)
    try:
        values: Any = yaml.safe_load(head[1]) if head else {}
        splits = values.get("splits") or {}
        counts = {str(split): int(count) for split, count in splits.items() if count is not None}
        return ConfigCard(text, str(values.get("title", name)), counts)
    except Exception as error:  # a head may be anything
        raise ConfigError(f"The head of {file} cannot be read: {str(error).splitlines()[0]}") from error


def _texts(name: str) -> dict[str, str]:
    """Returns the files of a card by their endings.

    Raises:
        ConfigError: There is no card of that name.
    """
    if name not in SPECS:
        card = config_card(name)
        if card is None:
            if name in config_files("dataset"):
                raise ConfigError(
                    f"{name} has no card.",
                    f"It would be conf/dataset/{name}.md, beside the dataset's YAML.",
                )
            known = [*SPECS, *config_files("dataset", MARKDOWN)]
            raise ConfigError(f"There is no card of {name!r}.", nearest_names(name, known))
        return {MARKDOWN: card.text}
    published = read_card(name)
    return {MARKDOWN: published.text, CROISSANT: croissant_text(published)}
