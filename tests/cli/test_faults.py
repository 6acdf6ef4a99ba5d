"""Mistakes, hostile names and broken data: one line and a hint, and nothing lost."""

import csv
import logging
import re
import shlex
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from lodbench.cli import main
from lodbench.cli.localize import LocalizeOptions, parser
from lodbench.params import options_of
from lodbench.storage.json_text import parse_json
from tests.fault_commands import CRS, prepare_inputs
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


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """A town with a flight over it."""
    folder = prepare_inputs(tmp_path_factory.mktemp("day one"))
    return SimpleNamespace(
        city=str(folder / "town/city.obj"),
        flight=str(folder / "flight"),
        photo=str(folder / "flight/DJI_00.JPG"),
        mask=str(folder / "flight_masks/DJI_00.png"),
        model=str(folder / "model"),
        masks=str(folder / "three/data/masks"),
    )


def _at(f: SimpleNamespace, photo: str = "") -> list[str]:
    return ["localize", photo or f.photo, "--city", f.city, "--crs", CRS]


def _placed(f: SimpleNamespace, model: str) -> list[str]:
    return ["georeference", model, "--city", f.city, "--crs", CRS, "--masks", f.masks]


def _init(f: SimpleNamespace) -> list[str]:
    return ["dataset", "init", "own", "--images", f.flight, "--city", f.city, "--crs", CRS]


@pytest.mark.parametrize(
    "words",
    [lambda f: _at(f, f.flight), lambda f: [*_placed(f, f.model), "--images", f.flight]],
    ids=["localize", "georeference"],
)
def test_sidecars_where_nothing_may_be_written_are_refused_first(files, capsys, tmp_path, monkeypatch, words):
    beside = Path(files.flight)
    monkeypatch.setattr("lodbench.harness.photo.outputs.can_write", lambda folder: folder != beside)
    assert main([*words(files), "--sidecars", "--out", str(tmp_path / "out")]) == 2
    assert f"Nothing can be written beside the photos in {beside}" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_names_and_line_ends_of_other_systems_are_no_mistake(files, capsys, tmp_path):
    folder = tmp_path / "Größe und Ümläut 写真"
    folder.mkdir()
    city, photo, mask = folder / "Stadt α.obj", folder / "Föto 1.JPG", folder / "Mäske 1.png"
    city.write_bytes(Path(files.city).read_bytes().replace(b"\n", b"\r\n"))
    shutil.copy(files.photo, photo)
    shutil.copy(files.mask, mask)
    given = ["localize", str(photo), "--city", str(city), "--crs", CRS, "--mask", str(mask)]
    code = main([*given, "--method", "lodlocv2", "--method-option", "steps=1", "--out", str(folder / "o ö")])
    assert code in (0, 3), capsys.readouterr().err
    assert (folder / "o ö" / "Föto 1_overlay.png").is_file()


def test_a_geoid_that_was_not_used_is_told(files, capsys, tmp_path):
    words = [*_at(files), "--method", "prior_only", "--geoid", "46", "--out", str(tmp_path)]
    assert main(words) == 0
    assert "note: --geoid was not used" in capsys.readouterr().out


def test_the_next_command_is_one_that_a_shell_reads(files, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    root = tmp_path / "my town"
    assert main(["dataset", "init", str(root), *_init(files)[3:]]) == 0
    (command,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("Next: ")]
    words = shlex.split(command.removeprefix("Next: "))
    assert f"dataset.root={root}" in words
    assert main([*words[1:], "method=prior_only"]) == 0, capsys.readouterr().err


def test_a_method_without_a_score_says_so(files, capsys, tmp_path):
    words = [*_at(files), "--method", "prior_only", "--out", str(tmp_path)]
    assert main([*words, "--json"]) == 0
    assert parse_json(capsys.readouterr().out, is_strict=True)["score"] is None
    written = [*tmp_path.glob("*.json"), *tmp_path.glob("*.geojson")]
    assert len(written) == 2
    assert all(parse_json(path.read_text(), is_strict=True) for path in written)
    assert main(words) == 0
    assert "  score      -, the method's own measure" in capsys.readouterr().out
    assert main([*words, "--each-alone", files.flight, "--json"]) == 0
    answers = parse_json(capsys.readouterr().out, is_strict=True)
    assert {answer["score"] for answer in answers} == {None}


def test_a_segmenter_that_is_named_goes_before_masks_among_the_photos(tmp_path):
    (tmp_path / "masks").mkdir()
    words = [str(tmp_path), "--city", "city.obj"]
    assert options_of(parser().parse_args(words), LocalizeOptions).masks_used == tmp_path / "masks"
    named = parser().parse_args([*words, "--segmenter", "compact"])
    assert options_of(named, LocalizeOptions).masks_used is None


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


@pytest.mark.attack
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


@pytest.mark.attack
def test_a_table_edited_by_hand_is_flagged(lodbench, tmp_path, root):
    words = ["evaluate", f"poses={root / 'GPS_pose.txt'}", "dataset=folder", f"dataset.root={root}"]
    folder = tmp_path / re.search(r"results: (\S+)", lodbench(*words, "format=lines").stdout)[1]
    assert lodbench("compare", str(folder)).stderr == ""
    table = folder / "queries.csv"
    table.write_text(re.sub(r",\d+\.\d+,", ",0.001,", table.read_text(), count=1))
    assert "edited by hand?" in lodbench("compare", str(folder)).stderr
