"""Runs and basins by the command: what they print, keep and go on from."""

import csv
import json
import math
import re
import shutil
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from lodbench import __version__
from lodbench.cli import main
from lodbench.datasets.pose_text import read_poses
from lodbench.evaluation import pose_error
from lodbench.harness.runs.basin import CostGrid
from lodbench.storage import digest_of
from tests.town import box_obj, write_dataset

STABLE = ["config.yaml", "poses.txt", "queries.csv", "summary.json"]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> tuple[Path, Path]:
    return write_dataset(tmp_path_factory.mktemp("town"), count=3)


def words(dataset: tuple[Path, Path], *more: str) -> list[str]:
    return ["run", "dataset=folder", f"dataset.root={dataset[0]}", f"city={dataset[1]}", *more]


def run_folder(tmp_path: Path, name: str = "runs") -> Path:
    (folder,) = (tmp_path / name / "folder" / "lodlocv2").iterdir()
    return folder


def test_finds_the_poses_and_leaves_the_artefacts(lodbench, tmp_path, dataset):
    done = lodbench(*words(dataset))
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert "100.00" in done.stdout
    folder = run_folder(tmp_path)
    truth = read_poses(dataset[0] / "GT_pose.txt")
    for name, pose in read_poses(folder / "poses.txt").items():
        assert pose_error(pose, truth[name]).translation_m < 1.5
    summary = json.loads((folder / "summary.json").read_text())
    split = summary["splits"]["data"]
    assert split["num_queries"] == 3
    assert split["recall"]["2m-2deg"] == 100.0
    assert split["hypotheses_per_query"] == 504 + 1 + 40 * 48
    assert summary["prior"]["data"]["recall"]["5m-5deg"] == 0.0
    assert len(list((folder / "overlays").glob("*.png"))) == 3


def test_the_rows_follow_from_the_stored_poses(lodbench, tmp_path, dataset):
    lodbench(*words(dataset))
    folder = run_folder(tmp_path)
    truth, poses = read_poses(dataset[0] / "GT_pose.txt"), read_poses(folder / "poses.txt")
    rows = list(csv.DictReader((folder / "queries.csv").open()))
    assert [row["query"] for row in rows] == list(truth)
    for row in rows:
        error = pose_error(poses[row["query"]], truth[row["query"]])
        assert math.isclose(float(row["translation_error_m"]), error.translation_m, abs_tol=1e-9)
        assert math.isclose(float(row["rotation_error_deg"]), error.rotation_deg, abs_tol=1e-9)
    median = json.loads((folder / "summary.json").read_text())["splits"]["data"]["median_translation_m"]
    assert math.isclose(median, np.median([float(row["translation_error_m"]) for row in rows]))


@pytest.mark.slow
def test_same_bytes_whatever_the_threads_and_the_hash_seed(lodbench_process, tmp_path, dataset):
    for threads in ("1", "2"):
        more = [f"executor.threads={threads}", f"paths.runs=runs{threads}"]
        assert lodbench_process(*words(dataset, *more), PYTHONHASHSEED=threads).returncode == 0
    a, b = run_folder(tmp_path, "runs1"), run_folder(tmp_path, "runs2")
    assert a.name == b.name
    for name in STABLE:
        assert (a / name).read_bytes() == (b / name).read_bytes(), name


def test_a_killed_run_resumes_to_the_same_bytes(lodbench, tmp_path, dataset):
    lodbench(*words(dataset))
    folder = run_folder(tmp_path)
    whole = {name: (folder / name).read_bytes() for name in STABLE}
    ledger = folder / "predictions.jsonl"
    lines = ledger.read_bytes().splitlines(keepends=True)
    # As a kill leaves it: one query done, half a line of the next, none of the results.
    ledger.write_bytes(lines[0] + lines[1][:40])
    for name in STABLE:
        (folder / name).unlink()
    done = lodbench(*words(dataset))
    assert "(1 query was there already)" in done.stdout
    assert {name: (folder / name).read_bytes() for name in STABLE} == whole


def test_another_seed_or_tilt_is_another_run(lodbench, tmp_path, dataset):
    done = lodbench(*words(dataset, "--multirun", "seed=0,1", "tilt=prior,truth", "limit=1"))
    assert done.returncode == 0, done.stderr
    assert len(list((tmp_path / "runs" / "folder" / "lodlocv2").iterdir())) == 4
    assert done.stdout.count("tilt=truth · ") == 2


def test_a_fault_in_a_sweep_names_its_job_and_spares_the_others(lodbench, tmp_path, dataset):
    done = lodbench(*words(dataset, "--multirun", "tilt=prior,sideways", "seed=3", "limit=1"))
    assert done.returncode == 2
    (said,) = [line for line in done.stderr.splitlines() if line.startswith("lodbench: ")]
    assert said.startswith("lodbench: tilt=sideways: ")
    assert "tilt=prior" in done.stdout
    assert len(list((tmp_path / "runs" / "folder" / "lodlocv2").iterdir())) == 1


@pytest.mark.parametrize("command", [["run"], ["localize"], ["dataset", "check"], ["train"]])
def test_any_command_says_the_version_of_lodbench(command, capsys):
    assert main([*command, "--version"]) == 0
    assert capsys.readouterr().out == f"lodbench {__version__}\n"


def test_changed_input_under_the_same_path_is_another_run(lodbench, tmp_path):
    dataset = write_dataset(tmp_path / "town", count=2)
    lodbench(*words(dataset))
    poses = dataset[0] / "GPS_pose.txt"
    original = poses.read_text()
    poses.write_text(original + "# a remark\n")
    lodbench(*words(dataset))
    assert len(list((tmp_path / "runs" / "folder" / "lodlocv2").iterdir())) == 1
    first, *others = original.splitlines(keepends=True)
    *numbers, tz = first.split()
    poses.write_text(" ".join([*numbers, str(float(tz) + 1)]) + "\n" + "".join(others))
    lodbench(*words(dataset))
    assert len(list((tmp_path / "runs" / "folder" / "lodlocv2").iterdir())) == 2
    poses.write_text(original)
    (dataset[0] / "masks" / "view_00.png").unlink()
    lodbench(*words(dataset))
    assert len(list((tmp_path / "runs" / "folder" / "lodlocv2").iterdir())) == 3


def test_faults_of_single_queries_are_rows_with_reasons(lodbench, tmp_path):
    import cv2

    root, city = write_dataset(tmp_path / "town", count=7)
    names = list(read_poses(root / "GT_pose.txt"))

    def drop(file: str, name: str) -> None:
        lines = (root / file).read_text().splitlines(keepends=True)
        (root / file).write_text("".join(line for line in lines if not line.startswith(name)))

    drop("GT_pose.txt", names[1])
    drop("intrinsic.txt", names[2])
    drop("GPS_pose.txt", names[3])
    (root / "masks" / names[4]).unlink()
    cv2.imwrite(str(root / "masks" / names[5]), np.zeros((240, 320), dtype=np.uint8))
    drop("GPS_pose.txt", names[6])
    with (root / "GPS_pose.txt").open("a") as stream:
        stream.write(f"{names[6]} 0 1 0 0 90000 0 0\n")

    done = lodbench("run", "dataset=folder", f"dataset.root={root}", f"city={city}")
    assert done.returncode == 0, done.stderr
    folder = run_folder(tmp_path)
    failures = {row["query"]: row["failure"] for row in csv.DictReader((folder / "queries.csv").open())}
    assert failures[names[0]] == ""
    for name, word in zip(
        names[1:], ["true pose", "camera", "prior", "mask", "no building", "outside"], strict=True
    ):
        assert word in failures[name], (name, failures[name])
        assert failures[name] in done.stdout
    split = json.loads((folder / "summary.json").read_text())["splits"]["data"]
    # The denominator is the truth list: six names, one of them answered.
    assert (split["num_queries"], split["num_failed"]) == (6, 5)
    assert split["recall"]["5m-5deg"] == pytest.approx(100 / 6)
    assert split["median_translation_m"] is None


def test_a_distorted_camera_is_its_query_s_fault(lodbench, tmp_path):
    root, city = write_dataset(tmp_path / "town", count=2)
    lines = (root / "intrinsic.txt").read_text().splitlines()
    lines[1] = lines[1].replace("PINHOLE", "OPENCV") + " 0.1 0 0 0"
    (root / "intrinsic.txt").write_text("\n".join(lines) + "\n")
    done = lodbench(*words((root, city), "method.steps=1"))
    assert done.returncode == 0, done.stderr
    assert "1 x the camera has lens distortion" in done.stdout


@pytest.mark.parametrize("content", [b"", b"no picture"])
def test_a_photo_that_cannot_be_read_costs_no_table(lodbench, tmp_path, content):
    root, city = write_dataset(tmp_path / "town", count=1)
    (root / "Query_image").mkdir()
    (root / "Query_image" / "view_00.png").write_bytes(content)
    done = lodbench(*words((root, city), "method.steps=1"))
    assert done.returncode == 0, done.stderr
    assert "lodlocv2 full" in done.stdout


@pytest.mark.parametrize("place", ["methods/protocol.py", "photos/pictures.py", "baselines/__init__.py"])
def test_other_code_is_another_run(tmp_path, monkeypatch, place):
    from lodbench.storage import digest as module

    changed, baselines = tmp_path / "lodbench", tmp_path / "baselines"
    shutil.copytree(Path(module.__file__).parents[1], changed, ignore=shutil.ignore_patterns("weights"))
    shutil.copytree(Path(find_spec("lodbench.baselines").origin).parent, baselines)
    monkeypatch.setattr(module, "__file__", str(changed / "execution" / "code_version.py"))
    monkeypatch.setattr(module, "package_files", lambda name: sorted(baselines.rglob("*.py")))
    before = module.own_digest.__wrapped__()
    with (tmp_path / (place if place.startswith("baselines") else f"lodbench/{place}")).open("a") as stream:
        stream.write("# changed\n")
    assert module.own_digest.__wrapped__() != before


def test_another_scipy_is_another_run(monkeypatch):
    from lodbench.storage import digest

    before = digest.own_digest.__wrapped__()
    there = digest.version
    monkeypatch.setattr(digest, "version", lambda name: "0.1" if name == "scipy" else there(name))
    assert digest.own_digest.__wrapped__() != before


def test_a_setting_names_the_same_run_however_it_is_written(lodbench, tmp_path, dataset):
    for more in (["seed=0"], ["seed=00"], ["split=data"], ["split=[data]"]):
        assert lodbench(*words(dataset, "limit=1", "method.steps=1", *more)).returncode == 0
    assert len(list((tmp_path / "runs" / "folder" / "lodlocv2").iterdir())) == 2


def test_baseline_plugin_answers_the_prior(lodbench, tmp_path, dataset):
    done = lodbench(*words(dataset, "method=prior_only"))
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "runs" / "folder" / "prior_only").iterdir()
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["splits"]["data"]["recall"] == summary["prior"]["data"]["recall"]


def test_a_sweep_goes_over_cities_and_tables_say_which(lodbench, tmp_path):
    for name, height in (("a, old.obj", 15), ("b.obj", 20), ("c.obj", 30)):
        (tmp_path / name).write_text(box_obj([(0, 0, 40, 30, 0, height)]))
    words = ["run", "--multirun", "method=prior_only", "dataset=views", "dataset.num_views=1"]
    done = lodbench(*words, "city=b.obj,c.obj")
    assert done.returncode == 0, done.stderr
    heads = [line for line in done.stdout.splitlines() if line.startswith("views (")]
    assert [head.rpartition(" · ")[2] for head in heads] == ["city=b.obj", "city=c.obj"]
    # A comma within a name is none between two.
    done = lodbench(*words, "city=a, old.obj")
    assert done.returncode == 0, done.stderr


def test_compare_puts_runs_in_one_table(lodbench, tmp_path, dataset):
    lodbench(*words(dataset, "--multirun", "method.variant=no_refine,full", "limit=1"))
    folders = sorted(str(path) for path in (tmp_path / "runs" / "folder" / "lodlocv2").iterdir())
    for style, word in (
        ("text", "no refine"),
        ("markdown", "| lodlocv2 full |"),
        ("latex", r"\midrule"),
        ("csv", "full"),
    ):
        assert word in lodbench("compare", *folders, "--format", style).stdout


def test_render_draws_the_mask_the_pose_sees(lodbench, tmp_path, dataset):
    import cv2

    root, city = dataset
    out = tmp_path / "out, (1)"
    done = lodbench(
        "render",
        f"city={city}",
        f"poses={root / 'GT_pose.txt'}",
        f"intrinsics={root / 'intrinsic.txt'}",
        f"out={out}",
    )
    assert done.returncode == 0, done.stderr
    for path in (root / "masks").iterdir():
        drawn, kept = cv2.imread(str(out / path.name), 0), cv2.imread(str(path), 0)
        assert np.array_equal(drawn, kept)


def test_help_teaches(lodbench):
    for command in ("run", "compare", "render", "city", "dataset", "bench"):
        assert command in lodbench("--help").stdout


def test_city_info_for_machines(lodbench, dataset):
    info = json.loads(lodbench("city", "info", str(dataset[1]), "--json").stdout)
    assert info["format"] == "OBJ"
    assert info["buildings"] == 7
    assert {"version", "crs", "parts", "extent_m", "lods", "findings"} <= set(info)


def test_groups_within_a_dataset_s_settings_are_taken(lodbench, dataset):
    more = ["dataset.num_views=1", "dataset.world.focal=0.02", "dataset.range_m=4", "method=prior_only"]
    done = lodbench("run", "dataset=views", f"city={dataset[1]}", *more)
    assert done.returncode == 0, done.stderr
    assert "prior_only" in done.stdout
    done = lodbench("run", "dataset=views", f"city={dataset[1]}", "dataset.world.focal=long")
    assert done.returncode == 2
    assert "dataset.world.focal" in done.stderr


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
