"""Cards of the published datasets: prose and facts in ``data_cards/NAME.md``, installed beside lodbench."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from lodbench.datasets.published.catalogue import SPECS
from lodbench.errors import DatasetError


@dataclass(frozen=True, slots=True)
class Card:
    """What a reader must know before results on a dataset mean anything."""

    name: str
    head: dict[str, Any]
    text: str

    def section(self, title: str) -> str:
        """Returns the text below a heading, up to the next.

        Raises:
            DatasetError: There is no such heading.
        """
        found = re.search(
            rf"^## {re.escape(title)}\n+(.*?)\s*(?=^## |\Z)", self.text, re.DOTALL | re.MULTILINE
        )
        if found is None:
            raise DatasetError(f"The card of {self.name} has no section {title!r}.")
        return found[1]


def read_card(name: str) -> Card:
    """Returns the card of a published dataset.

    Raises:
        DatasetError: There is none, or its head is not JSON.
    """
    if name not in SPECS:
        raise DatasetError(f"There is no card of {name!r}.")
    text = (files("lodbench.data_cards") / f"{name}.md").read_text(encoding="utf-8")
    try:
        _, head, _ = text.split("---\n", 2)
        pairs = (line.split(": ", 1) for line in head.splitlines())
        return Card(name, {key: json.loads(value) for key, value in pairs}, text)
    except ValueError as error:
        raise DatasetError(f"The head of data_cards/{name}.md cannot be read: {error}.") from error
