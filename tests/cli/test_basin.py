"""`lodbench basin`: rows of a table, each a run of its own; cost around the truth."""

import csv
import re
from dataclasses import asdict

import pytest

from lodbench.harness.runs.basin import CostGrid
from lodbench.storage import digest_of
from tests.town import write_dataset

QUICK = ["method.steps=2", "ranges=[15,8]", "yaw_ranges=[10]", "tilt=truth", "executor.threads=1"]


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> list[str]:
    root, city = write_dataset(tmp_path_factory.mktemp("town"), count=2)
    return ["dataset=folder", f"dataset.root={root}", f"dataset.city_model={city}"]


@pytest.mark.slow
def test_a_basin_leaves_tables_maps_and_runs_that_verify(lodbench, tmp_path, data):
    done = lodbench("basin", *data, *QUICK)
    assert done.returncode == 0, done.stderr
    assert "no pose is dropped" in done.stdout
    folder = tmp_path / re.search(r"results: (\S+)", done.stdout)[1]
    lines = list(csv.DictReader((folder / "basin.csv").open()))
    assert [(line["kind"], line["half_width"], line["queries"]) for line in lines] == [
        ("translation", "8.0", "2"),
        ("translation", "15.0", "2"),
        ("orientation", "10.0", "2"),
    ]
    # Grid of 2 Delta at 10 m and 15/7 deg, then 1 + 2 x 48 poses of the filter.
    assert [float(line["hypotheses_per_query"]) for line in lines] == [
        3**3 * 8 + 97,
        4**3 * 8 + 97,
        3 * 3 * 7 * 11 + 97,
    ]
    for name in ("recall.png", "recall.svg", "cost_maps.png", "cost_maps.svg", "basin.md", "basin.tex"):
        assert (folder / name).stat().st_size > 0
    costs = list(csv.DictReader((folder / "cost_maps.csv").open()))
    # The masks are exact, so the truth is a peak of every map.
    for axis in ("xy", "z", "yaw"):
        best = max((line for line in costs if line["map"] == axis), key=lambda line: float(line["mean_iou"]))
        assert [float(best[name]) for name in ("x_m", "y_m", "z_m", "yaw_deg")] == [0, 0, 0, 0]
    # Queries done on one grid of offsets are not taken for those of another.
    assert (folder / f"cost_ledger_{digest_of(asdict(CostGrid()))}.jsonl").is_file()
    verified = lodbench("verify", str(folder.parent / "lodlocv2" / lines[0]["run"]))
    assert verified.returncode == 0, verified.stdout + verified.stderr
    # The same command again finds every query done, and writes the same bytes.
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    again = lodbench("basin", *data, *QUICK)
    assert again.returncode == 0, again.stderr
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_a_row_is_the_run_with_the_same_settings(lodbench, tmp_path, data):
    done = lodbench("basin", *data, "method=prior_only", "ranges=[20]", "yaw_ranges=[]", "maps=false")
    assert done.returncode == 0, done.stderr
    # It cannot be told how far off priors are: it searches as it is.
    assert "search: as the method is set, whatever Delta" in done.stdout
    # Apart from other runs: runs/folder/*/* names none of them.
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["basin"]
    (folder,) = (tmp_path / "runs" / "basin" / "folder").glob("prior_only-*")
    (line,) = csv.DictReader((folder / "basin.csv").open())
    widths = [f"prior.{axis}_m=20" for axis in "xyz"]
    run = lodbench("run", *data, "method=prior_only", "prior=uniform", *widths, "paths.runs=runs/basin")
    assert f"/{line['run']} (2 queries were there already)" in run.stdout, run.stdout + run.stderr
