"""Names that a spreadsheet, a page or a terminal would obey, through a whole run."""

import csv
import re
from pathlib import Path

import pytest

from tests.town import write_dataset

pytestmark = pytest.mark.attack

NAMES = ["=cmd|calc", "<img/src=x/onerror=alert(1)>.png", "@view\x1b[31m.png"]


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    root, _ = write_dataset(tmp_path_factory.mktemp("town"), count=3)
    for file in ("GT_pose.txt", "GPS_pose.txt", "intrinsic.txt"):
        text = (root / file).read_text()
        for number, name in enumerate(NAMES):
            # What stands before a slash is a folder to the readers.
            text = text.replace(f"view_0{number}.png", name.replace("/", " ").replace(" ", "_"))
        (root / file).write_text(text)
    return root


def test_they_are_kept_to_the_letter_and_obeyed_nowhere(lodbench, tmp_path, root):
    words = ["evaluate", f"poses={root / 'GPS_pose.txt'}", "dataset=folder", f"dataset.root={root}"]
    done = lodbench(*words, "format=lines")
    assert done.returncode == 0, done.stderr
    assert "\x1b" not in done.stdout + done.stderr
    folder = tmp_path / re.search(r"results: (\S+)", done.stdout)[1]
    cells = [row["query"] for row in csv.DictReader((folder / "queries.csv").open(newline=""))]
    assert not any(cell.startswith(("=", "+", "-", "@")) for cell in cells)
    assert "'=cmd|calc" in cells
    verified = lodbench("verify", str(folder))
    assert verified.returncode == 0, verified.stdout
    assert lodbench("report", str(folder)).returncode == 0
    page = (folder / "report.html").read_text()
    assert "<img_src" not in page
    assert "&lt;img_src" in page
    assert "\x1b" not in page


def test_a_table_edited_by_hand_is_flagged(lodbench, tmp_path, root):
    words = ["evaluate", f"poses={root / 'GPS_pose.txt'}", "dataset=folder", f"dataset.root={root}"]
    folder = tmp_path / re.search(r"results: (\S+)", lodbench(*words, "format=lines").stdout)[1]
    assert lodbench("compare", str(folder)).stderr == ""
    table = folder / "queries.csv"
    table.write_text(re.sub(r",\d+\.\d+,", ",0.001,", table.read_text(), count=1))
    assert "edited by hand?" in lodbench("compare", str(folder)).stderr
