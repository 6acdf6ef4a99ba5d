"""What the command line says to mistakes: a file for each command, each mistake followed by the whole answer.

`python -m tests.messages update` writes the answers anew, for `git diff` to show. Commands stand as they are
typed in a folder of ``prepare``.
"""

import io
import shlex
import shutil
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np

from lodbench.cli import main
from tests.fault_commands import prepare_inputs
from tests.photos.dji_photo import write_photo

HERE = Path(__file__).parent
DEGREES = "v 11.5 48.1 500\nv 11.6 48.1 500\nv 11.6 48.2 500\nv 11.5 48.1 520\nf 1 2 3\nf 1 2 4\n"


def prepare(folder: Path) -> Path:
    """Writes a town with a flight over it, and what is mistaken for them."""
    prepare_inputs(folder)
    shutil.copytree(folder / "three/data", folder / "no_truth")
    (folder / "no_truth/GT_pose.txt").unlink()
    (folder / "no_truth/dataset.json").write_text('{"truth": false}')
    cv2.imwrite(str(folder / "small.png"), np.full((24, 16), 255, np.uint8))
    cv2.imwrite(str(folder / "black.png"), np.zeros((240, 320), np.uint8))
    (folder / "empty").mkdir()
    (folder / "degrees.obj").write_text(DEGREES)
    shutil.copytree(folder / "model", folder / "no_cameras")
    (folder / "no_cameras/cameras.txt").unlink()
    # States no place.
    (folder / "placeless").mkdir()
    write_photo(folder / "placeless/DJI_0001.JPG")
    return folder


def answer(command: str, folder: Path) -> str:
    """Returns what a command that is a mistake says, typed in a folder, which it must leave as it is."""
    before, said, printed = _listed(folder), io.StringIO(), io.StringIO()
    made = AssertionError("the demo town was made for a command that is a mistake")
    with (
        patch("lodbench.synthesis.demo.open_demo", autospec=True, side_effect=made),
        redirect_stderr(said),
        redirect_stdout(printed),
    ):
        code = main(shlex.split(command))
    assert code == 2, f"{command} ends with {code}"
    # What a run is about to do is printed before priors are drawn.
    assert printed.getvalue() == "" or command.startswith("run "), f"{command} printed something"
    assert _listed(folder) == before, f"{command} wrote something"
    return said.getvalue().replace(str(folder), "FOLDER").strip()


def _listed(folder: Path) -> list[tuple[str, int]]:
    return sorted((str(path), path.stat().st_mtime_ns) for path in folder.rglob("*"))


def catalogue() -> Iterator[tuple[str, str]]:
    """Yields every command and its answer."""
    for path in sorted(HERE.glob("*.txt")):
        for block in path.read_text().strip().split("\n\n"):
            command, _, text = block.partition("\n")
            yield command.removeprefix("$ "), text


def write(commands: list[str], folder: Path) -> None:
    """Writes the answers of all commands, in a file for each first word."""
    blocks: dict[str, list[str]] = {}
    for command in dict.fromkeys(commands):
        blocks.setdefault(command.split()[0], []).append(f"$ {command}\n{answer(command, folder)}\n")
    for name, texts in blocks.items():
        (HERE / f"{name}.txt").write_text("\n".join(texts))
