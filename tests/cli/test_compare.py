"""`lodbench compare`: side by side from the rows, with tests over the same queries."""

import io
import re
from pathlib import Path

import pandas as pd
import pytest

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
