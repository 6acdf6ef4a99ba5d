"""Runs side by side in tables, and two of them photo by photo on a page."""

import io
import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lodbench.datasets.pose_text import format_pose, lines_to_text, read_poses
from lodbench.harness.runs.photo_pairs import read_tags
from tests.reporting.browser import PHONE, fits, opened
from tests.town import write_dataset


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> tuple[Path, Path]:
    return write_dataset(tmp_path_factory.mktemp("town"), count=4)


def scored(lodbench, data, poses: Path, name: str) -> str:
    words = ["evaluate", f"poses={poses}", "dataset=folder", f"dataset.root={data[0]}", f"method_name={name}"]
    return re.search(r"results: (\S+)", lodbench(*words).stdout)[1]


def test_two_runs_are_tested_query_by_query(lodbench, data):
    prior = scored(lodbench, data, data[0] / "GPS_pose.txt", "prior")
    truth = scored(lodbench, data, data[0] / "GT_pose.txt", "perfect")
    done = lodbench("compare", prior, truth, "--thresholds", "1/1", "20/10", "--columns", "paper", "details")
    assert done.returncode == 0, done.stderr
    # 4 of 4 queries gained: p = 2 / 2^4.
    line = next(line for line in done.stdout.splitlines() if "recall 1m-1deg" in line)
    assert re.search(r"0\.00\s+100\.00\s+\+100\.00\s+\[\+7\.03, \+100\.00\]\s+0\.125", line)
    assert "20m-10deg" in done.stdout
    assert "horizontal m" in done.stdout
    assert "perfect" in next(line for line in done.stdout.splitlines() if " against " in line)


def test_csv_of_several_tables_has_one_head_and_each_row_once(lodbench, data):
    prior = scored(lodbench, data, data[0] / "GPS_pose.txt", "prior")
    words = ["evaluate", f"poses={data[0] / 'GPS_pose.txt'}", "dataset=folder", f"dataset.root={data[0]}"]
    oracle = re.search(r"results: (\S+)", lodbench(*words, "tilt=truth").stdout)[1]
    done = lodbench("compare", prior, oracle, "--format", "csv", "--columns", "paper", "details")
    rows = pd.read_csv(io.StringIO(done.stdout))
    assert len(rows) == 4, done.stdout
    assert rows.duplicated().sum() == 0
    assert rows["median_translation_m"].dtype == float
    assert sorted(rows["protocol"].str.extract(r"tilt=(\w+)")[0]) == ["prior", "prior", "truth", "truth"]


def test_runs_from_other_priors_share_a_table_where_priors_or_seeds_may_differ(lodbench, data):
    words = ["run", "dataset=folder", f"dataset.root={data[0]}", f"city={data[1]}", "method=prior_only"]
    near, far, again = (
        re.search(r"results:\s+(\S+)", lodbench(*words, "prior=uniform", *more).stdout)[1]
        for more in (["prior.x_m=1"], ["prior.x_m=80"], ["prior.x_m=1", "seed=1"])
    )

    def rows(*words):
        return pd.read_csv(io.StringIO(lodbench("compare", *words, "--format", "csv").stdout))

    alone = [rows(run).set_index("method").loc["prior_only", "median_translation_m"] for run in (near, again)]
    (mean,) = rows(near, again, "--over-seeds").itertuples()
    assert mean.method == "prior_only (2 seeds)"
    assert mean.median_translation_m == pytest.approx(sum(alone) / 2)
    freed = lodbench("compare", near, far, "--free", "prior").stdout
    assert freed.count("T.e./R.e.") == 1, freed
    # Not freed, they share none.
    assert lodbench("compare", near, far).stdout.count("T.e./R.e.") == 2


def test_the_budget_is_a_picture_of_recall_over_poses_drawn(lodbench, data, tmp_path):
    words = ["run", "dataset=folder", f"dataset.root={data[0]}", f"city={data[1]}", "limit=1"]
    few = ["method.coarse_size=[40,30]", "method.fine_size=[40,30]", "method.steps=1"]
    folders = [
        re.search(r"results:\s+(\S+)", lodbench(*words, *more).stdout)[1]
        for more in (["method=prior_only"], few, [*few, "method.fit=soft_iou"])
    ]
    done = lodbench("compare", *folders, "--budget", str(tmp_path / "pictures"))
    assert done.returncode == 0, done.stderr
    svg = (tmp_path / "pictures" / "budget.svg").read_text()
    for text in (">prior_only<", ">lodlocv2 iou<", ">lodlocv2 soft_iou<", "tilt=prior"):
        assert text in svg
    assert (tmp_path / "pictures" / "budget.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_the_page_has_tables_curves_and_tests_by_name(lodbench, data, tmp_path):
    prior = scored(lodbench, data, data[0] / "GPS_pose.txt", "prior")
    truth = scored(lodbench, data, data[0] / "GT_pose.txt", "perfect")
    page = tmp_path / "page.html"
    assert lodbench("compare", prior, truth, "--format", "html", "--out", str(page)).returncode == 0
    with opened(page, PHONE, "dark") as (shown, complaints):
        words = shown.inner_text("main")
        assert "perfect against prior" in words
        assert "Both runs answered 4 queries; 0 within 2 m and 2 deg of each other" in words
        assert shown.locator("table").count() == 3
        assert shown.locator(".chart svg").count() == 1
        assert fits(shown)
        assert complaints == []


def test_runs_without_a_truth_are_told_apart_by_their_answers(lodbench, tmp_path):
    root, city = write_dataset(tmp_path / "mine", count=2)
    (root / "GT_pose.txt").unlink()
    city.rename(root / "city.obj")
    (root / "dataset.json").write_text('{"truth": false, "city_model": "city.obj"}')
    folders = []
    for method in ("prior_only", "contour_alignment"):
        done = lodbench("run", "dataset=folder", f"dataset.root={root}", f"method={method}")
        folders.append(re.search(r"results:\s+(\S+)", done.stdout)[1])
    out = lodbench("compare", *folders).stdout
    assert out.count("No ground truth to compare with; the poses themselves") == 2
    assert "no paired test: there is no truth" in out
    empty = lodbench("compare", *folders, "--format", "csv", "--out", str(tmp_path / "t.csv"))
    assert empty.returncode == 2
    assert "No run has a truth" in empty.stderr
    assert not (tmp_path / "t.csv").exists()
    unheard = lodbench("compare", *folders, "--columns", "nix")
    assert unheard.returncode == 2
    assert "there is no table for --columns" in unheard.stderr
    assert "Both runs answered 2 queries; 0 within 2 m" in out
    assert "2m-2deg" not in out


def test_other_queries_are_not_tested_and_say_so(lodbench, data, tmp_path):
    prior = scored(lodbench, data, data[0] / "GPS_pose.txt", "prior")
    words = ["evaluate", f"poses={data[0] / 'GPS_pose.txt'}", "dataset=folder", f"dataset.root={data[0]}"]
    fewer = re.search(r"results: (\S+)", lodbench(*words, "limit=2").stdout)[1]
    assert (
        "no paired test: the queries differ: 2 are in one run only"
        in lodbench("compare", prior, fewer).stdout
    )


@pytest.mark.slow
def test_curves_of_other_queries_are_other_charts(lodbench, data, tmp_path):
    prior = scored(lodbench, data, data[0] / "GPS_pose.txt", "prior")
    words = ["evaluate", f"poses={data[0] / 'GPS_pose.txt'}", "dataset=folder", f"dataset.root={data[0]}"]
    fewer = re.search(r"results: (\S+)", lodbench(*words, "limit=2").stdout)[1]
    page = tmp_path / "page.html"
    assert lodbench("compare", prior, fewer, "--format", "html", "--out", str(page)).returncode == 0
    captions = re.findall(r"<figcaption>([^<]*): recall over a threshold", page.read_text())
    assert [caption.split(", ")[-1] for caption in captions] == ["4 queries", "2 queries"]


@pytest.mark.parametrize("word", ["2", "0/1", "a/b", "inf/2", "-1/2"])
def test_a_bad_threshold_is_one_line(lodbench, data, word):
    prior = scored(lodbench, data, data[0] / "GPS_pose.txt", "prior")
    done = lodbench("compare", prior, f"--thresholds={word}")
    assert (done.returncode, "is not METRES/DEGREES" in done.stderr) == (2, True), done.stderr


def test_a_run_that_is_not_finished_is_told_as_elsewhere(lodbench, tmp_path):
    (tmp_path / "plan.json").write_text('{"queries": ["a/1.jpg"]}')
    done = lodbench("compare", str(tmp_path))
    assert (done.returncode, done.stdout) == (2, "")
    assert f"The run {tmp_path} is not finished." in done.stderr


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
