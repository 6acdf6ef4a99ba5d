"""Figures anyone can make again: accuracy on a real model, speed beside other programs."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lodbench.errors import LodbenchError
from lodbench.reporting.aligned_text import format_columns
from lodbench.storage import make_folder, write_bytes

if TYPE_CHECKING:
    import pandas as pd

# Meaning of a seed.
SEED = "random seed (0)"
# Called with the steps done and their total.
Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured number."""

    figure: str  # what was measured, unique within a report
    value: float  # our number
    unit: str  # its unit; "" for a count
    peer: str = ""  # who or what the number stands beside, with the reason if it could not be measured; or ""
    peer_value: float | None = None  # the peer's number in the same unit, or None
    ratio: float | None = None  # how many times better ours is, or None

    def to_json(self) -> dict[str, str | float | None]:
        """Returns a JSON object in which what is not finite is null."""
        return {
            "figure": self.figure,
            "value": _finite(self.value),
            "unit": self.unit,
            "peer": self.peer,
            "peer_value": _finite(self.peer_value),
            "ratio": _finite(self.ratio),
        }


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """What a bench measured."""

    text: str  # a table and what must be known of it, for people
    figures: Sequence[Figure]  # the numbers, for machines
    data: pd.DataFrame | None = None  # the measurements behind them, a row each; None where none are kept
    # Returns pictures by file name, drawn when they are requested
    draw: Callable[[], dict[str, bytes]] = dict

    def write_pictures(self, folder: Path) -> None:
        """Writes the pictures, if there are any, into a folder that is made."""
        for name, content in self.draw().items():
            make_folder((folder / name).parent)
            write_bytes(folder / name, content)


def plain_report(title: str, figures: Sequence[Figure], *notes: str) -> Report:
    """Returns a report that is a table of figures, each beside its peer's, with lines of notes below."""
    import pandas as pd

    rows = [[title, "value", "unit", "peer", "peer's value", "ratio"]]
    for each in figures:
        beside = "" if each.peer_value is None else _in_words(each.peer_value)
        ratio = "" if each.ratio is None else f"{each.ratio:.1f}x"
        rows.append([each.figure, _in_words(each.value), each.unit, each.peer, beside, ratio])
    return Report("\n".join([format_columns(rows), *notes]), figures, pd.DataFrame(map(asdict, figures)))


def load_in_words() -> str:
    """Returns how busy the machine is: ``load 1.5``, averaged over a minute."""
    return f"load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "load unknown"


def python_output(what: str, words: Sequence[str], python: str = sys.executable) -> str:
    """Returns what a process of Python prints.

    Args:
        what: It does, for the fault.
        words: Of Python: a script, or a module and its words.
        python: Which one.

    Raises:
        LodbenchError: It fails.
    """
    done = subprocess.run([python, *words], capture_output=True, text=True)  # noqa: S603 - with code of ours
    if done.returncode != 0:
        raise LodbenchError(f"{what} failed: {(done.stderr.strip() or done.stdout.strip())[-300:]}")
    return done.stdout


def seconds_of_command(*words: str) -> float:
    """Returns how long a command of lodbench takes in a process of its own, its start included."""
    start = time.perf_counter()
    python_output(f"lodbench {' '.join(words)}", ["-m", "lodbench", *words])
    return time.perf_counter() - start


def no_progress(done: int, total: int) -> None:
    """Tells nobody."""


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _in_words(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1e4 else f"{value:.4g}"


def words(text: str) -> tuple[str, ...]:
    """Returns words separated by commas."""
    return tuple(text.split(",")) if text else ()
