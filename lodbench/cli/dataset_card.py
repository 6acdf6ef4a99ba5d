"""`lodbench dataset card NAME`: a dataset's card as Markdown, and as Croissant JSON-LD."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from lodbench.datasets.cards import card_markdown, card_of
from lodbench.datasets.croissant import croissant_text
from lodbench.storage import write_text


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code.

    Raises:
        ConfigError: There is no card of that name.
    """
    parser = argparse.ArgumentParser("lodbench dataset card", description="Print or write a dataset's card.")
    parser.add_argument("dataset", metavar="NAME")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write NAME.md and NAME.croissant.json there")
    parser.add_argument("--croissant", action="store_true", help="print the JSON-LD instead of Markdown")
    options = parser.parse_args(argv[1:])
    card = card_of(options.dataset)
    if options.out is None:
        sys.stdout.write(croissant_text(card) if options.croissant else card_markdown(card))
        return 0
    options.out.mkdir(parents=True, exist_ok=True)
    for name, text in (
        (f"{card.spec.id}.md", card_markdown(card)),
        (f"{card.spec.id}.croissant.json", croissant_text(card)),
    ):
        write_text(options.out / name, text)
        sys.stdout.write(f"{options.out / name}\n")
    return 0
