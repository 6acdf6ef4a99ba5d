"""`lodbench report`: one page of a run, verified on the way, in a real browser."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.reporting.browser import PHONE, column_texts, fits, opened, press
from tests.town import write_dataset


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> tuple[Path, Path]:
    return write_dataset(tmp_path_factory.mktemp("town"), count=4)


def run(lodbench, tmp_path, data, *more: str) -> Path:
    words = ["run", "dataset=folder", f"dataset.root={data[0]}", f"dataset.city_model={data[1]}"]
    done = lodbench(*words, "tilt=truth", "method.steps=3", "executor.threads=1", *more)
    assert done.returncode == 0, done.stderr
    return tmp_path / re.search(r"results:\s+(\S+)", done.stdout)[1]


def test_the_page_shows_a_run_in_one_quiet_file(lodbench, tmp_path, data):
    folder = run(lodbench, tmp_path, data)
    assert lodbench("report", str(folder)).returncode == 0
    with opened(folder / "report.html", PHONE, "dark") as (page, complaints):
        words = page.inner_text("main")
        for said in ("Verified: every number follows", "Worst queries", "From above", "How the score rose"):
            assert said in words
        # Pictures: curves, one view from above, 3 best and 1 worst query, traces; all of them decoded.
        sizes = page.eval_on_selector_all("img", "all => all.map(i => i.naturalWidth)")
        assert len(sizes) == 1 + 1 + 4 + 1
        assert min(sizes) > 0
        last = page.locator("table").count() - 1
        press(page, last, 2)
        errors = [float(cell) for cell in column_texts(page, last, 2)]
        assert len(errors) == 4
        assert errors == sorted(errors)
        anchors = page.eval_on_selector_all("nav a", "all => all.map(a => a.getAttribute('href'))")
        assert all(page.locator(f"section{anchor}").count() == 1 for anchor in anchors)
        assert fits(page)
        assert complaints == []


def test_a_changed_summary_is_said_on_the_page_and_by_the_exit_code(lodbench, tmp_path, data):
    folder = run(lodbench, tmp_path, data)
    summary = folder / "summary.json"
    summary.write_text(summary.read_text().replace('"num_failed": 0', '"num_failed": 1', 1))
    done = lodbench("report", str(folder))
    assert done.returncode == 1
    assert "Not verified" in (folder / "report.html").read_text()


def test_a_scored_pose_file_has_a_page_with_overlays(lodbench, tmp_path, data):
    words = [f"poses={data[0] / 'GPS_pose.txt'}", "dataset=folder", f"dataset.root={data[0]}"]
    done = lodbench("evaluate", *words, f"dataset.city_model={data[1]}")
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "runs" / "folder" / "GPS_pose").iterdir()
    assert len(list((folder / "overlays").glob("*.png"))) == 4
    assert lodbench("report", str(folder)).returncode == 0
    page = (folder / "report.html").read_text()
    assert "Worst queries" in page
    assert "How the score rose" not in page


def test_no_run_is_one_line(lodbench, tmp_path):
    done = lodbench("report", str(tmp_path))
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 2)
