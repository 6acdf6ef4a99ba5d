"""A fault of the command or the dataset: one line, a hint, exit code 2, and nothing written."""

import logging
import shutil
from pathlib import Path

import pytest

from lodbench.cli import main
from tests.town import town_gml, write_dataset


def is_clear(done, *words: str) -> None:
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("lodbench: ")
    assert "Traceback" not in done.stderr
    assert len(done.stderr.splitlines()) <= 2
    for word in words:
        assert word in done.stderr


def test_an_unknown_command(lodbench):
    is_clear(lodbench("rum"), "'rum'", "run")


def test_a_plug_in_without_its_configuration_is_no_unknown_name(monkeypatch, capsys):
    monkeypatch.setattr("lodbench.cli.hydra_app.plugin_names", lambda group: ("unset",))
    assert main(["run", "method=unset", "dataset=demo"]) == 2
    told = capsys.readouterr().err
    assert "'unset' brings no conf/method/unset.yaml" in told
    assert "lodbench.config_sources" in told


@pytest.fixture
def dataset(tmp_path) -> tuple[Path, Path]:
    return write_dataset(tmp_path / "town")


def run_words(root: Path, city: Path) -> list[str]:
    return ["run", "dataset=folder", f"dataset.root={root}", f"dataset.city_model={city}"]


@pytest.mark.parametrize(
    ("file", "content", "expected"),
    [
        ("GT_pose.txt", "a.png 1 0 0 0 0 0\n", ["GT_pose.txt", "line 1", "7"]),
        ("GT_pose.txt", "# none\n", ["GT_pose.txt", "no poses"]),
        ("GPS_pose.txt", "a.png 1 0 0 0 0 0 0\n\nb.png 1 0 0 0 0 0 nan\n", ["line 3", "not finite"]),
        ("GPS_pose.txt", "a.png 2 0 0 0 0 0 0\n", ["line 1", "length 2"]),
        ("GT_pose.txt", "a.png 1 0 0 0 0 0 0\na.png 1 0 0 0 0 0 0\n", ["line 2", "twice"]),
        ("intrinsic.txt", "a.png FISHY 10 10 1 1 1 1\n", ["line 1", "FISHY"]),
        ("intrinsic.txt", "a.png PINHOLE 10 10 1 1 1\n", ["line 1", "4 parameters"]),
    ],
)
def test_fault_of_the_dataset(lodbench, tmp_path, dataset, file, content, expected):
    root, city = dataset
    (root / file).write_text(content)
    is_clear(lodbench(*run_words(root, city)), *expected)
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("file", ["GT_pose.txt", "GPS_pose.txt", "intrinsic.txt"])
def test_a_missing_file_is_named(lodbench, dataset, file):
    root, city = dataset
    (root / file).unlink()
    is_clear(lodbench(*run_words(root, city)), file)


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("a.gml", b"", []),
        ("a.gml", b"<!DOCTYPE x [<!ENTITY e SYSTEM 'file:///etc/passwd'>]><x>&e;</x>", ["DOCTYPE"]),
        ("a.gml", b"<CityModel xmlns='http://www.opengis.net/citygml/2.0'><a>", ["a.gml"]),
        ("a.obj", b"v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n", ["line 2"]),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", ["line 4"]),
        ("a.txt", b"hello\n", ["a.txt"]),
    ],
)
def test_fault_of_the_city(lodbench, tmp_path, dataset, name, content, expected):
    root, _ = dataset
    city = tmp_path / name
    city.write_bytes(content)
    is_clear(lodbench(*run_words(root, city)), *expected)
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_a_level_of_detail_that_is_not_there(lodbench, tmp_path):
    path = tmp_path / "town.gml"
    path.write_text(town_gml())
    poses = tmp_path / "poses.txt"
    poses.write_text("a.png 1 0 0 0 0 0 0\n")
    cameras = tmp_path / "cameras.txt"
    cameras.write_text("a.png PINHOLE 10 10 5 5 5 5\n")
    done = lodbench("render", f"city={path}", f"poses={poses}", f"intrinsics={cameras}", "out=o", 'lod="4"')
    is_clear(done, "4")
    assert not (tmp_path / "o").exists()


def test_paths_with_every_awkward_character_work(lodbench, tmp_path):
    folder = tmp_path / "Städte, alt (1) = a'b & c"
    root, city = write_dataset(folder, count=1)
    odd = folder / "map {v2}, [final].obj"
    shutil.move(city, odd)
    done = lodbench(*run_words(root, odd), f"paths.runs={folder / 'my runs'}")
    assert done.returncode == 0, done.stderr
    assert list((folder / "my runs" / "folder" / "lodlocv2").glob("*/summary.json"))


@pytest.mark.parametrize("name", ["c${d}", "${oc.env:HOME}", "back\\slash", "end\\", "'quoted", 'a"b'])
def test_paths_that_look_like_hydra_s_own_grammar_are_taken_as_they_stand(lodbench, tmp_path, name):
    root, city = write_dataset(tmp_path / name, count=1)
    done = lodbench(*run_words(root, city), "method.steps=1", f"paths.runs={tmp_path / name / 'runs'}")
    assert done.returncode == 0, done.stderr
    assert list((tmp_path / name / "runs" / "folder" / "lodlocv2").glob("*/summary.json"))


def test_a_file_where_run_folders_should_go(lodbench, tmp_path, dataset):
    (tmp_path / "taken").write_text("mine")
    is_clear(lodbench(*run_words(*dataset), "paths.runs=taken"), "taken", "paths.runs")
    is_clear(lodbench(*run_words(*dataset), "paths.runs=taken/below"), "taken")
    assert (tmp_path / "taken").read_text() == "mine"


def test_an_operating_system_s_fault_is_one_line(lodbench, tmp_path):
    (tmp_path / "taken").write_text("mine")
    is_clear(lodbench("dataset", "make-demo", "taken/below"), "taken")


def test_a_closed_pipe_is_no_error(lodbench, tmp_path):
    import subprocess
    import sys

    done = subprocess.run(
        ["bash", "-c", f"set -o pipefail; {sys.executable} -m lodbench --help | head -n 1"],
        capture_output=True,
        text=True,
    )
    assert "Traceback" not in done.stderr


def test_a_warning_is_said_once_in_a_command_and_again_in_the_next(capsys, monkeypatch):
    """A table of thirteen cities said of each city's masks that they are scaled."""

    def warn(words):
        for number in (1, 1, 2):
            logging.getLogger("lodbench.somewhere").warning("%d masks are scaled", number)
        return 0

    monkeypatch.setattr("lodbench.cli.stored_runs.main_status", warn)
    monkeypatch.setattr(logging.getLogger(), "handlers", [])  # pytest's: the command line has none
    for _ in range(2):
        assert main(["status"]) == 0
        assert capsys.readouterr().err == "lodbench: 1 masks are scaled\nlodbench: 2 masks are scaled\n"
