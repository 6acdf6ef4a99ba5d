"""The page of two runs, photo by photo, in a browser: order, filters, outlines, tags kept in a file."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from lodbench.datasets.pose_text import format_pose, lines_to_text, read_poses
from lodbench.harness.runs.photo_pairs import read_tags
from tests.reporting.browser import PHONE, fits, opened
from tests.town import write_dataset


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> tuple[Path, Path]:
    return write_dataset(tmp_path_factory.mktemp("town"), count=4)


@pytest.fixture(scope="module")
def moved(data, tmp_path_factory) -> Path:
    """The true poses, moved east: the first by a metre, the second by two ..."""
    truth = read_poses(data[0] / "GT_pose.txt")
    path = tmp_path_factory.mktemp("poses") / "moved.txt"
    lines = [
        format_pose(name, pose.shifted((float(count), 0.0, 0.0)))
        for count, (name, pose) in enumerate(truth.items(), start=1)
    ]
    path.write_text(lines_to_text(lines))
    return path


@pytest.fixture
def runs(lodbench, data, moved) -> list[str]:
    """Poses beside the truth, and at it."""
    folders = []
    for name, poses in (("moved", moved), ("true", data[0] / "GT_pose.txt")):
        words = ["evaluate", f"poses={poses}", "dataset=folder", f"dataset.root={data[0]}", f"city={data[1]}"]
        folders.append(re.search(r"results: (\S+)", lodbench(*words, f"method_name={name}").stdout)[1])
    return folders


def rows_of(shown) -> list[dict[str, str]]:
    """Returns the visible rows of the table of photos, by the names of its columns."""
    return shown.evaluate(
        """() => {
          const table = document.querySelector("section.pair table");
          const names = [...table.tHead.rows[0].cells].map((cell) => cell.dataset.name ?? "view");
          return [...table.tBodies[0].rows].filter((row) => !row.hidden).map((row) =>
            Object.fromEntries([...row.cells].map((cell, k) => [names[k], cell.innerText.trim()])));
        }"""
    )


def photo_shown(shown) -> str:
    return shown.locator("section.pair .slides figure:not([hidden])").get_attribute("data-key")


@pytest.mark.slow
def test_photos_are_sorted_filtered_and_tagged_and_the_tags_come_back(lodbench, data, runs, tmp_path):
    page = tmp_path / "compared.html"
    assert lodbench("compare", *runs, "--out", str(page)).returncode == 0
    with opened(page) as (shown, complaints):
        rows = rows_of(shown)
        distances = [float(row["apart"]) for row in rows]
        assert distances == [4.0, 3.0, 2.0, 1.0]
        assert photo_shown(shown) == rows[0]["photo"]
        furthest = shown.locator("section.pair a.furthest")
        assert f"differ most at {rows[0]['photo']}: 4.00 m and" in shown.inner_text("section.pair")
        shown.locator("section.pair tbody tr").nth(2).click()
        assert photo_shown(shown) == rows[2]["photo"]
        furthest.click()
        assert photo_shown(shown) == rows[0]["photo"]
        shown.locator('section.pair th[data-name="apart"] button').click()
        assert [row["photo"] for row in rows_of(shown)] == [row["photo"] for row in reversed(rows)]

        # The photo comes before the many conditions.
        assert not shown.locator('input.condition[data-column="apart"]').is_visible()
        shown.locator("section.pair .filters summary").click()
        # Only what lies at least as far apart as the second of them.
        shown.locator('input.condition[data-column="apart"]').fill("2.5")
        assert {row["photo"] for row in rows_of(shown)} == {row["photo"] for row in rows[:2]}
        shown.locator("section.pair .tagging input").fill("blurred  roof")
        shown.locator("section.pair .tag-shown").click()
        shown.locator("section.pair .clear").click()
        assert [row["tags"] for row in rows_of(shown)].count("blurred roof") == 2
        shown.locator("select.tagged").select_option("=blurred roof")
        assert len(rows_of(shown)) == 2

        with shown.expect_download() as download:
            shown.locator("section.pair .export").click()
        assert download.value.suggested_filename == "compared.tags.json"
        download.value.save_as(tmp_path / "compared.tags.json")
        assert complaints == []
    tags = json.loads((tmp_path / "compared.tags.json").read_text())["tags"]
    assert tags == {row["photo"]: ["blurred roof"] for row in rows[:2]}

    assert lodbench("compare", *runs, "--out", str(page)).returncode == 0
    with opened(page, PHONE, "dark") as (shown, complaints):
        assert {row["photo"] for row in rows_of(shown) if row["tags"] == "blurred roof"} == set(tags)
        assert fits(shown)
        # A name takes two lines at most.
        cell = shown.locator("section.pair tbody td.name").first
        assert cell.bounding_box()["height"] < 60
        assert shown.inner_text("main").count("Both runs answered") == 1
        # Each run has one colour, in the curves and on the map, and the prior another.
        inks = [f"var(--c{number})" for number in (0, 1, 4)]
        curves = shown.locator("#curves .chart svg").first.inner_html()
        assert set(re.findall(r"var\(--c\d\)", curves)) == set(inks)
        stroke = "e => getComputedStyle(e).stroke"
        dots = [shown.locator(f".map .dot.{kind}").first for kind in ("second", "estimate")]
        second, first = (dot.evaluate(stroke) for dot in dots)
        named = """(name) => { const e = document.createElement("i"); e.style.color = name;
          document.body.append(e); return getComputedStyle(e).color; }"""
        assert [first, second] == [shown.evaluate(named, ink) for ink in (inks[0], inks[2])]
        assert complaints == []


@pytest.mark.slow
def test_layers_are_shown_and_hidden_and_outlines_lie_where_the_runs_have_them(lodbench, runs, tmp_path):
    page = tmp_path / "compared.html"
    assert lodbench("compare", *runs, "--out", str(page)).returncode == 0
    with opened(page) as (shown, _):
        images = 'section.pair .slides figure:not([hidden]) img[data-layer="{}"]'
        assert shown.locator(images.format("a")).is_visible()
        shown.locator('input[data-layer="a"]').uncheck()
        assert not shown.locator(images.format("a")).is_visible()
        # B is the truth, pixel for pixel; A is elsewhere.
        alpha = """(image) => { const c = document.createElement("canvas");
          [c.width, c.height] = [image.naturalWidth, image.naturalHeight];
          const g = c.getContext("2d"); g.drawImage(image, 0, 0);
          return [...g.getImageData(0, 0, c.width, c.height).data].filter((_, k) => k % 4 == 3); }"""
        a, b, truth = (
            np.array(shown.locator(images.format(name)).evaluate(alpha)) > 0 for name in ("a", "b", "truth")
        )
        assert truth[b].mean() > 0.99
        assert truth[a].mean() < 0.6


def test_tags_of_another_dataset_or_of_no_tags_are_one_line(lodbench, runs, tmp_path):
    page, kept = tmp_path / "compared.html", tmp_path / "compared.tags.json"
    kept.write_text('{"tags": {"a": "b"}}')
    done = lodbench("compare", *runs, "--out", str(page))
    assert done.returncode == 2
    assert "compared.tags.json holds no tags by photo." in done.stderr
    kept.write_text('{"dataset": "demo", "version": "1", "tags": {}}')
    done = lodbench("compare", *runs, "--out", str(page))
    assert done.returncode == 2
    assert "holds tags of the dataset demo 1" in done.stderr
    assert not page.exists()
    assert read_tags(tmp_path / "none.tags.json", {"name": "demo", "version": "1"}) == {}


@pytest.mark.slow
def test_runs_without_truth_show_how_far_answers_lie_apart(lodbench, tmp_path):
    root, city = write_dataset(tmp_path / "mine", count=2)
    (root / "GT_pose.txt").unlink()
    city.rename(root / "city.obj")
    (root / "dataset.json").write_text('{"truth": false, "city_model": "city.obj"}')
    folders = []
    for method in ("prior_only", "contour_alignment"):
        done = lodbench("run", "dataset=folder", f"dataset.root={root}", f"method={method}")
        folders.append(re.search(r"results:\s+(\S+)", done.stdout)[1])
    page = tmp_path / "compared.html"
    done = lodbench("compare", *folders, "--out", str(page))
    assert done.returncode == 0, done.stderr
    with opened(page) as (shown, complaints):
        rows = rows_of(shown)
        assert len(rows) == 2
        assert "error_a" not in rows[0]
        assert all(float(row["apart"]) > 0 for row in rows)
        assert shown.locator('section.pair .slides figure:not([hidden]) img[data-layer="b"]').count() == 1
        assert shown.locator("section.pair svg").count() >= 1
        assert complaints == []
