"""`lodbench verify`: honest runs pass, and whatever is changed in them is caught."""

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from lodbench.cli import main
from lodbench.evaluation import metrics
from lodbench.harness.runs.artefacts import named_by, without_paths
from lodbench.harness.runs.predict import open_predictions
from tests.town import write_dataset

pytestmark = pytest.mark.attack


@pytest.fixture(scope="module")
def made(tmp_path_factory, cache) -> tuple[Path, Path, Path]:
    """A dataset's root, its city, and the folder of a run on it."""
    home = tmp_path_factory.mktemp("made")
    root, city = write_dataset(home, count=3)
    cameras = root / "intrinsic.txt"
    kept = [line for line in cameras.read_text().splitlines() if not line.startswith("view_02.png")]
    cameras.write_text("\n".join(kept) + "\n")
    words = ["method=prior_only", "dataset=folder", f"dataset.root={root}", f"dataset.city_model={city}"]
    environment = {**os.environ, "LODBENCH_CACHE": str(cache)}
    command = [sys.executable, "-m", "lodbench", "run", *words]
    subprocess.run(command, cwd=home, check=True, capture_output=True, env=environment)
    (folder,) = (home / "runs" / "folder" / "prior_only").iterdir()
    return root, city, folder


@pytest.fixture
def run(made, tmp_path) -> Path:
    """A copy of the run to tamper with, under its own name."""
    return Path(shutil.copytree(made[2], tmp_path / made[2].name))


def forge(run: Path) -> None:
    """Makes the digests those of the files as they are now: what a careful forger would do."""
    path = run / "provenance.json"
    provenance = json.loads(path.read_text())
    provenance["files"] = {
        name: hashlib.sha256((run / name).read_bytes()).hexdigest() for name in provenance["files"]
    }
    path.write_text(json.dumps(provenance))


def change(path: Path, pattern: str, new: str | Callable[[re.Match[str]], str]) -> None:
    text, count = re.subn(pattern, new, path.read_text(), count=1)
    assert count == 1
    path.write_text(text)


def edited(name: str, pattern: str, new: str) -> Callable[[Path], None]:
    """Returns what changes a file of a run."""
    return lambda run: change(run / name, pattern, new)


def answered(field: str, value: object) -> Callable[[Path], None]:
    """Returns what records another answer, its check made anew."""

    def damage(run: Path) -> None:
        stored = open_predictions(run)
        stored.record("data/view_00.png", {**stored["data/view_00.png"], field: value})

    return damage


def stated(key: str, value: object) -> Callable[[Path], None]:
    """Returns what states another fact in a run's provenance."""

    def damage(run: Path) -> None:
        path = run / "provenance.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))

    return damage


def unfinished(run: Path) -> None:
    for name in ("config.yaml", "summary.json", "provenance.json"):
        (run / name).unlink()


def emptied(run: Path) -> None:
    shutil.rmtree(run)
    run.mkdir()


NO_PREDICTION = "predictions.jsonl: data/view_00.png is no prediction"
KEPT = "config.yaml", "poses.txt", "queries.csv", "summary.json"
ROW = r"view_00.png.*\n"
TABLES = "compare RUN", "export RUN --format csv"


@pytest.mark.parametrize(
    ("damage", "commands", "said"),
    [
        (unfinished, ("verify RUN", "report RUN", "leaderboard add RUN"), "RUN is not finished."),
        (emptied, ("verify RUN",), "RUN"),
        (answered("pose", [1, 2]), ("verify RUN",), NO_PREDICTION),
        (answered("seconds", 3), ("verify RUN",), NO_PREDICTION),
        (answered("notes", [7]), ("verify RUN",), NO_PREDICTION),
        (answered("score", {}), ("verify RUN",), NO_PREDICTION),
        (answered("trace", {"a": "b"}), ("verify RUN",), NO_PREDICTION),
        (edited("summary.json", r'"dataset": \{', '"datasex": {'), ("verify RUN",), "is not a run summary"),
        (
            edited("summary.json", r'"dataset": \{', '"dataset": [], "other": {'),
            ("verify RUN",),
            "is not a run summary",
        ),
        (stated("files", [[]]), ("verify RUN", "report RUN"), "files holds no"),
        (stated("files", {"a": 1}), ("verify RUN", "report RUN"), "files holds no"),
        (stated("seconds_per_query", "x"), ("verify RUN", "report RUN"), "seconds_per_query holds no"),
        (
            edited("queries.csv", rf"({ROW})", r"\1\1"),
            ("verify RUN", "report RUN", "compare RUN"),
            "queries.csv: data/view_00.png occurs twice.",
        ),
        (
            edited("queries.csv", r"(view_00.png,data),[\d.]+", r"\1,-5"),
            ("verify RUN", "report RUN", "compare RUN"),
            "line 2: -5 is not a finite number from 0 to inf.",
        ),
        # 24 of 40 rows were compared with 40 of another run, and exported without a word.
        (edited("queries.csv", ROW, ""), TABLES, "2 queries of data with a truth, summary.json counts 3."),
        (edited("poses.txt", "view_00", "view_09"), TABLES, "view_09.png is not a query of queries.csv."),
        (None, ("verify RUN --city nosuch.gml",), "nosuch.gml does not exist."),
        (None, ("report RUN --dataset-root nosuch",), "Check the path after --dataset-root."),
        (None, ("export RUN --format tum --city nosuch",), "--format tum needs poses alone."),
    ],
)
def test_what_no_run_writes_and_no_place_are_one_line(lodbench, run, damage, commands, said):
    if damage:
        damage(run)
    for command in commands:
        done = lodbench(*(str(run) if word == "RUN" else word for word in command.split()))
        assert done.returncode == 2, done.stdout + done.stderr
        assert done.stderr.startswith("lodbench: ")
        assert "Traceback" not in done.stderr
        assert said.replace("RUN", str(run)) in done.stderr
        assert not (run / "export").exists()


@pytest.mark.nightly
def test_a_changed_digit_of_the_ledger_is_told(lodbench, run):
    change(run / "predictions.jsonl", r'("pose": \[-?\d\.)(\d)', lambda m: f"{m[1]}{(int(m[2]) + 1) % 10}")
    done = lodbench("verify", str(run))
    assert done.returncode == 1
    assert "predictions.jsonl: 1 damaged lines" in done.stdout


def test_another_pose_in_the_ledger_is_told_though_its_check_is_made_anew(lodbench, run):
    pose = [*open_predictions(run)["data/view_00.png"]["pose"]]
    answered("pose", [*pose[:3], pose[3] + 0.001, *pose[4:]])(run)
    done = lodbench("verify", str(run))
    assert done.returncode == 1
    assert "data/view_00.png has another pose than poses.txt" in done.stdout


def test_an_honest_run_passes(lodbench, made):
    done = lodbench("verify", str(made[2]))
    assert (done.returncode, done.stderr) == (0, "")
    assert "3 queries consistent with poses and ground truth" in done.stdout


@pytest.mark.parametrize(
    ("name", "pattern", "new", "said"),
    [
        ("summary.json", r'("5m-5deg": )0\.0', r"\g<1>66.7", "recall: 5m-5deg is 66.7, not 0.0"),
        ("summary.json", r'("median_translation_m": )[\d.]+', r"\g<1>0.5", "median_translation_m is 0.5"),
        ("summary.json", r'("num_failed": )1', r"\g<1>0", "num_failed is 0, not 1"),
        ("summary.json", r'("tilt": )"prior"', r'\g<1>"truth"', "tilt is 'truth', not 'prior'"),
        ("summary.json", r'("seed": )0', r"\g<1>1", "seed is 1, not 0"),
        ("summary.json", r'("scene": )"\w', r'\g<1>"x', "scene is 'x"),
        ("summary.json", r'("queries": )"\w', r'\g<1>"x', "queries is 'x"),
        ("queries.csv", r"view_00.png,data,[\d.]+", "view_00.png,data,0.5", "view_00.png: error is 0.5 m"),
        ("queries.csv", r"(view_00.png,data,[\d.]+),[\d.]+", r"\1,0.5", "view_00.png: error is 0.5 deg"),
        ("queries.csv", r"(view_00.png(?:,[^,]*){4}),\d+", r"\1,99", "view_00.png has another hypotheses"),
        ("queries.csv", r"view_00.png.*\n", "", "data/view_00.png is missing"),
        ("queries.csv", r"view_00", "view_09", "data/view_09.png is not a query of the dataset"),
        ("poses.txt", r" ([-\d.]+)\n", " 12.5\n", "view_00.png: error is"),
        ("poses.txt", r"view_00", "view_09", "view_09.png is not a query"),
        ("poses.txt", r"view_00.*\n", "", "view_00.png has no failure, and no pose"),
        ("config.yaml", r"seed: 0", "seed: 3", "seed is 0, not 3"),
        *((name, r"\n\Z", "\r\n", f"{name} is not the file the run wrote") for name in KEPT),
    ],
)
def test_a_forged_number_is_caught_with_new_digests_and_a_byte_by_them(
    lodbench, run, name, pattern, new, said
):
    change(run / name, pattern, new)
    if "not the file" not in said:
        forge(run)
    done = lodbench("verify", str(run))
    assert done.returncode == 1, done.stdout + done.stderr
    assert said in done.stdout


def test_other_data_is_caught_and_moved_data_is_found(lodbench, made, run, tmp_path):
    moved = Path(shutil.copytree(made[0], tmp_path / "moved"))
    assert lodbench("verify", str(run), "--dataset-root", str(moved)).returncode != 2
    change(moved / "GT_pose.txt", r" ([-\d.]+)\n", " 12.5\n")
    done = lodbench("verify", str(run), "--dataset-root", str(moved))
    assert done.returncode == 1
    assert "queries is" in done.stdout


def theirs(queries):
    return {"theirs_m": 7.0}


def test_metrics_of_plug_ins_may_come_and_go(lodbench, run, monkeypatch):
    """One that was installed when the run was made is not now, and another way round; it still ranks."""
    change(run / "summary.json", r'("metrics": \{)', r'\g<1>"gone_m": 3.5,')
    forge(run)
    ours = metrics.installed_metrics()
    monkeypatch.setattr(metrics, "installed_metrics", lambda: {**ours, "theirs": theirs})
    done = lodbench("verify", str(run))
    assert done.returncode == 0, done.stdout
    assert "not compared: gone_m, theirs_m" in done.stdout
    done = lodbench("leaderboard", "add", str(run))
    assert (done.returncode, "kept out" in done.stdout) == (0, False), done.stdout
    assert "gone_m" not in Path(run.parent / done.stdout.strip()).read_text()


def test_a_metric_of_our_own_that_is_not_there_is_told(lodbench, run):
    change(run / "summary.json", r'"median_vertical_m": [\d.]+,', "")
    forge(run)
    done = lodbench("verify", str(run))
    assert (done.returncode, "median_vertical_m is missing" in done.stdout) == (1, True), done.stderr


def test_other_roofs_are_caught_and_older_runs_are_not(lodbench, tmp_path):
    """A city tells of pitched roofs no more; or did not when the run was made, as for all older runs."""
    root, city = write_dataset(tmp_path / "mine", count=2)
    told = tmp_path / "told.gml"
    assert lodbench("city", "convert", city, told).returncode == 0
    plain = told.read_text()
    words = ("method=prior_only", "dataset=folder", f"dataset.root={root}", f"dataset.city_model={told}")
    for before, after, code in (("3100", "1000", 1), ("1000", "3100", 0), ("3100", "2100", 0)):
        told.write_text(
            re.sub(r"(<bldg:Building [^>]*>)", rf"\1<bldg:roofType>{before}</bldg:roofType>", plain)
        )
        assert lodbench("run", *words, f"paths.runs={tmp_path / before / after}").returncode == 0
        (folder,) = (tmp_path / before / after / "folder" / "prior_only").iterdir()
        told.write_text(told.read_text().replace(before, after))
        done = lodbench("verify", folder)
        assert done.returncode == code, done.stderr
        assert ("pitched roofs" in done.stdout + done.stderr) == (before == "1000")


def test_without_the_data_the_weaker_check_is_said(lodbench, run):
    change(run / "provenance.json", r'("dataset_root": )".*"', r'\g<1>"/no/such/folder"')
    done = lodbench("verify", str(run))
    assert done.returncode == 0, done.stdout
    assert "weaker check" in done.stdout
    change(run / "queries.csv", r"view_00.png,data,[\d.]+", "view_00.png,data,0.5")
    forge(run)
    done = lodbench("verify", str(run))
    assert done.returncode == 1
    assert "5m-5deg is 0.0, not 33.3" in done.stdout


@pytest.mark.parametrize("command", [("verify",), ("leaderboard", "add"), ("report",)])
def test_no_path_that_a_stranger_s_run_names_is_opened(lodbench, made, run, tmp_path, command):
    """What a run names is a pipe: a command that opens it waits for ever; one that looks at it is told of."""
    trap = tmp_path / "trap"
    trap.mkdir()
    for name in ("GT_pose.txt", "GPS_pose.txt", "intrinsic.txt", "city.obj"):
        os.mkfifo(trap / name)
    change(run / "provenance.json", r'("dataset_root": )".*"', rf'\g<1>"{trap}"')
    change(run / "provenance.json", r'("city_model": )".*"', rf'\g<1>"{trap / "city.obj"}"')
    done = lodbench(*command, str(run))
    assert done.returncode == 0, done.stderr
    if command == ("verify",):
        assert "no path that it names was opened" in done.stdout
        named = lodbench(*command, str(run), "--dataset-root", str(made[0]), "--city-model", str(made[1]))
        assert (named.returncode, "note:" in named.stdout) == (0, False), named.stdout
    if command[0] == "leaderboard":
        assert "kept out of the ranking: not verified" in done.stdout


@pytest.mark.parametrize(
    ("pattern", "new"),
    [
        (r"prior:\n  name: file\n", "prior:\n  name: file\n  path: TRAP\n"),
        (r"  options: \{\}\n", "  options:\n    terrain: TRAP\n"),
        (r"segmenter:\n(  .*\n)+", "segmenter:\n  name: compact_instances\n  mask_weights: TRAP\n"),
    ],
)
@pytest.mark.parametrize("is_mine", [True, False])
def test_no_path_in_a_stranger_s_configuration_is_opened(
    lodbench, made, run, tmp_path, pattern, new, is_mine
):
    os.mkfifo(tmp_path / "trap")
    change(run / "config.yaml", pattern, new.replace("TRAP", str(tmp_path / "trap")))
    if not is_mine:
        change(run / "provenance.json", r'("seal": )".*"', r'\g<1>"none"')
    places = ["--dataset-root", str(made[0]), "--city", str(made[1])]
    done = lodbench("verify", str(run), *places)
    assert done.returncode == 1, done.stderr
    assert "no path that it names was opened" in done.stdout
    assert ("masks were not compared" in done.stdout) == ("mask_weights" in new)


def test_settings_of_a_plug_in_that_may_be_paths_are_a_stranger_s_too():
    plug_in = {"name": "theirs", "model": "/etc/x", "files": ["a", "../b"], "home": "~"}
    plug_in |= {"mode": "fast", "size": 3}
    ours = {"name": "compact", "size": 512, "weights": None}
    config = {"dataset": {"name": "demo"}, "segmenter": plug_in, "prior": {"name": "file"}}
    cleared = {"name": "theirs", "model": None, "files": None, "home": None, "mode": "fast", "size": 3}
    assert without_paths(config) == {**config, "segmenter": cleared}
    assert named_by({}, config)[-3:] == ["/etc/x", ["a", "../b"], "~"]
    assert without_paths({**config, "segmenter": ours}) == {**config, "segmenter": ours}


def test_a_run_whose_cache_is_gone_names_no_path_either(lodbench, made, tmp_path):
    done = lodbench("verify", str(made[2]), LODBENCH_CACHE=str(tmp_path / "empty"))
    assert (done.returncode, "no path that it names was opened" in done.stdout) == (0, True)


def test_one_file_name_in_two_splits_is_read_back(lodbench, tmp_path):
    root, city = write_dataset(tmp_path / "town", count=2)
    home = tmp_path / "both"
    for split in ("day", "night"):
        shutil.copytree(root, home / split)
    words = ("dataset=folder", f"dataset.root={home}", f"dataset.city_model={city}")
    assert lodbench("run", *words, "method=prior_only").returncode == 0
    (folder,) = (tmp_path / "runs" / "folder" / "prior_only").iterdir()
    verified = lodbench("verify", str(folder))
    assert verified.returncode == 0, verified.stdout
    scored = lodbench("evaluate", *words, f"poses={folder / 'poses.txt'}", "method_name=again")
    assert scored.returncode == 0, scored.stderr
    (again,) = (tmp_path / "runs" / "folder" / "again").iterdir()
    first, second = (json.loads((run / "summary.json").read_text())["splits"] for run in (folder, again))
    for split in ("day", "night"):
        assert second[split]["num_queries"] == 2
        assert second[split]["num_failed"] == 0
        assert second[split]["median_translation_m"] == pytest.approx(first[split]["median_translation_m"])


@pytest.mark.parametrize("left", ["", None], ids=["empty", "gone"])
def test_a_run_without_its_ledger_is_not_wholly_verified_and_does_not_rank(lodbench, run, tmp_path, left):
    """Probabilities of 1 everywhere were verified, and ranked."""
    ledger = run / "predictions.jsonl"
    ledger.unlink() if left is None else ledger.write_text(left)
    done = lodbench("verify", str(run))
    assert done.returncode == 0
    assert "note: predictions.jsonl is missing: scores, probabilities and masks are those of" in done.stdout
    added = lodbench("leaderboard", "add", str(run), "--root", str(tmp_path / "board"))
    assert "kept out of the ranking: not wholly verified: predictions.jsonl is missing" in added.stdout


@pytest.mark.parametrize(
    ("words", "out", "said"),
    [
        (["compare"], "summary.json", "is what the run itself wrote"),
        (["report"], "poses.txt", "is what the run itself wrote"),
        (["export", "--format", "csv"], "queries.csv", "is what the run itself wrote"),
        (["report"], ".", "is a folder"),
        (["compare"], "", "is a folder"),
    ],
)
def test_a_run_s_own_files_are_not_written_over(lodbench, run, words, out, said):
    before = {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()}
    target = str(run / out) if out else ""
    done = lodbench(words[0], str(run), *words[1:], "--out", target)
    assert done.returncode == 2
    assert said in done.stderr
    assert {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()} == before


@pytest.mark.parametrize("command", ["report", "compare", "verify"])
def test_a_folder_that_is_no_run_is_told_with_one_below_it(command, tmp_path, capsys):
    run = tmp_path / "my runs" / "demo" / "region" / "0123"
    run.mkdir(parents=True)
    for name in ("config.yaml", "summary.json"):
        (run / name).write_text("{}")
    assert main([command, str(tmp_path / "my runs")]) == 2
    told = capsys.readouterr().err
    assert f"{tmp_path / 'my runs'} is not a run folder: it holds no config.yaml." in told
    assert f"hint: Name a run folder, as '{run}'" in told
    assert main([command, str(tmp_path / "gone")]) == 2
    assert f"{tmp_path / 'gone'} does not exist." in capsys.readouterr().err
    assert main([command, str(run / "summary.json")]) == 2
    assert "summary.json is not a folder." in capsys.readouterr().err
