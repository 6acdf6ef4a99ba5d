"""What people get wrong on their first day: one line, a hint in the words they typed, exit code 2."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from lodbench.cli import main
from lodbench.storage.json_text import parse_json
from tests.fault_commands import CRS, prepare_inputs

DEGREES = "v 11.5 48.1 500\nv 11.6 48.1 500\nv 11.6 48.2 500\nv 11.5 48.1 520\nf 1 2 3\nf 1 2 4\n"
ABOUT = "--center 8 5.5 126 --heading 67 --pitch -70 --camera".split()
CAMERA = "PINHOLE 320 240 230 228 161 118.5"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """A town with a flight over it, and what is mistaken for them."""
    folder = prepare_inputs(tmp_path_factory.mktemp("day one"))
    made = SimpleNamespace(
        city=str(folder / "town/city.obj"),
        flight=str(folder / "flight"),
        photo=str(folder / "flight/DJI_00.JPG"),
        png=str(folder / "town/data/Query_image/view_00.png"),
        photos=str(folder / "town/data/Query_image"),
        mask=str(folder / "flight_masks/DJI_00.png"),
        model=str(folder / "model"),
        start=str(folder / "three/data/GPS_pose.txt"),
        masks=str(folder / "three/data/masks"),
        small=str(folder / "small.png"),
        black=str(folder / "black.png"),
        empty=str(folder / "empty"),
        degrees=str(folder / "degrees.obj"),
        no_cameras=str(folder / "no_cameras"),
        no_truth=str(folder / "no_truth"),
        folder=folder,
    )
    shutil.copytree(folder / "three/data", made.no_truth)
    (Path(made.no_truth) / "GT_pose.txt").unlink()
    (Path(made.no_truth) / "dataset.json").write_text('{"truth": false}')
    cv2.imwrite(made.small, np.full((24, 16), 255, np.uint8))
    cv2.imwrite(made.black, np.zeros((240, 320), np.uint8))
    Path(made.empty).mkdir()
    Path(made.degrees).write_text(DEGREES)
    shutil.copytree(made.model, made.no_cameras)
    (Path(made.no_cameras) / "cameras.txt").unlink()
    return made


Words = Callable[[SimpleNamespace], list[str]]
CASES: list[tuple[Words, str, str]] = [
    (lambda f: ["localize", f.city, "--city", f.photo], "is a city model by its name", "after --city"),
    (lambda f: ["localize", f.photo, f"city={f.city}"], "is not a file", f"--city {'{city}'}"),
    (lambda f: [*_at(f), "method=region"], "method=region is not a file", "--method region"),
    (
        lambda f: [*_at(f), "--pitch", "-70", "method=region"],
        "method=region is not a file",
        "--method region",
    ),
    (lambda f: [*_at(f), "--sidecars", "method=region"], "method=region is not a file", "--method region"),
    (lambda f: [*_at(f, "mising.png"), "--mask", f.mask], "photo mising.png does not exist", "Check the p"),
    (lambda f: [*_at(f, "mising.png"), "--masks", f.masks], "photo mising.png does not exist", "Check"),
    (lambda f: [*_at(f), "--mask", f.small], "16 x 24, the camera 320 x 240", "shows all of its photo"),
    (lambda f: [*_at(f), "--mask", f.black], "holds no building", "white (255)"),
    (lambda f: [*_at(f), "--mask", f.empty], "Is a directory", "Check the path"),
    (lambda f: [*_at(f), "--lat", "120", "--lon", "51"], "--lat=120 is not within -90 to 90", ""),
    (
        lambda f: [*_at(f), "--lat", "-33.9", "--lon", "151.2"],
        "14,902 km outside the city model",
        "Is it the right tile?",
    ),
    (lambda f: [*_at(f), "--takeoff", "nan"], "--takeoff=nan is not finite", ""),
    (lambda f: [*_at(f), "--takeoff", "61", "--heights", "sea_level"], "--takeoff is not used", "Leave --t"),
    (lambda f: [*_at(f), "--takeoff", "61", "--geoid", "46"], "--geoid is not used with --takeoff", "Leave"),
    (lambda f: [*_at(f), "--heights", "sea_level", "--geoid", "46"], "not used with --heights", "Leave --g"),
    (lambda f: [*_track(f), "--height", "160"], "--height is not used with --center", "--height or --center"),
    (lambda f: [*_track(f), "--height-offset", "3"], "--height-offset is not used with --center", "leave"),
    (lambda f: [*_at(f), "--camera", "PINHOLE -320 240 1 1 1 1"], "not -320 x 240", "PINHOLE W H"),
    (lambda f: ["localize", f.photo, "--city", f.degrees], "look like degrees", "--crs EPSG:"),
    (lambda f: [*_at(f)[:-1], "EPSG:4326"], "are no degrees", "--crs EPSG:"),
    (lambda f: [*_at(f, f.flight), "--masks", f.empty], "no mask of any image", "DJI_00.JPG or DJI_00.png"),
    (lambda f: [*_track(f), "--masks", f.empty], "no mask of any image", "view_00.png or view_00_mask.png."),
    (lambda f: [*_track(f), "--masks", f.masks, "--fps", "nan"], "--fps=nan", ""),
    (lambda f: [*_placed(f, f.photo)], "is not a folder", "folder that holds it"),
    (lambda f: [*_placed(f, f.no_cameras), "--start", f.start], "has no cameras.txt", "COLMAP model"),
    (lambda f: [*_placed(f, f.model), "--start", f.photo], "is not a text file", "Poses are text"),
    (lambda f: [*_placed(f, f.model)[:-2], "--images", f.flight, "--start", f.start], "no photo", "--images"),
    (lambda f: [*_at(f), "--out", f.png], "--out", "Name another folder: --out DIR"),
    (lambda f: [*_at(f, f.flight), "--out", f.png + "/below"], "can be written to --out", "another folder"),
    (lambda f: [*_track(f), "--out", f.png + "/below/it"], "written to --out", "another folder"),
    (lambda f: [*_placed(f, f.model), "--start", f.start, "--out", f.png], "written to", "another folder"),
    (lambda f: [*_at(f), "--roof-height", "tall"], "--roof-height=tall is not known", "median"),
    (lambda f: [*_at(f), "--pitch", "400"], "--pitch=400 is not within", ""),
    (lambda f: ["mask", f.png, "--mask", f.black, "--port", "99999"], "--port=99999", ""),
    (lambda f: [*_drawn(f), "--out", f.png], "--out is the photo itself", "another file"),
    (lambda f: [*_drawn(f), "--out", "mask.jpg"], "is not a PNG file", "--out mask.png"),
    (lambda f: [*_drawn(f), "--out", "my mask.jpg"], "my mask.jpg is not a PNG file", "--out 'my mask.png'"),
    (lambda f: [*_drawn(f), "--out", f.empty], "is a folder", "/empty/view_00_mask.png'"),
    (lambda f: [*_drawn(f), "--out", "/proc/mask.png"], "lodbench: /proc/mask.png: ", "permissions"),
    (lambda f: ["mask", f.png, "--no-page", "--mask", f.small], "16 x 24 pixels", "size of its photo"),
    (lambda f: ["mask", f.png, "--no-page", "--import", f.black], "is not a JSON file", "--mask"),
    (lambda f: ["mask", "nowhere.jpg", "--no-page"], "nowhere.jpg cannot be read", "Check the path"),
    (lambda f: ["city", "info", f.degrees], "look like degrees", "--crs EPSG:"),
    (lambda f: [*_init(f), "--offset", "nan", "0", "0"], "--offset=nan is not finite", ""),
    (lambda f: [*_init(f), "--colmap", f.model], "no such photo", "--images is the folder"),
    (
        lambda f: ["dataset", "import", "foo", f.model, "own"],
        "there is no FORMAT 'foo'",
        "visuallocalization",
    ),
    (lambda f: ["dataset", "import", "colmp", "nowhere", "own"], "no FORMAT 'colmp'", "mean colmap"),
    (lambda f: ["bench", "flights", "--city", "no.gml"], "no.gml does not exist", "--city"),
    (lambda f: [*_bench(f), "--flights", "0"], "--flights=0 is not at least 1", ""),
    (lambda f: [*_bench(f), "--missing", "3"], "--missing=3 is not within 0 to 0.5", ""),
    (lambda f: [*_bench(f), "--shared-height", "inf"], "--shared-height=inf is not finite", ""),
    (lambda f: [*_bench(f), "--reconstruct"], "--reconstruct needs photos", "--look plain"),
    (lambda f: ["train", "data=x", "schedule.lr=nan"], "schedule.lr=nan is not within", ""),
    (lambda f: ["train", "data=x", "traced_share=nan"], "lodbench: traced_share=nan", ""),
    (lambda f: ["train", "method=lodloc", "data=x", "schedule.lr=nan"], "schedule.lr=nan is not within", ""),
    (lambda f: _priors(f), "has no true pose to draw priors around", "--kind file --set path=FILE"),
    (lambda f: _drawn_run(f), "has no true pose to draw priors around", "prior=file prior.path=FILE"),
    (lambda f: ["run", f.photos], "is not a setting", "dataset.root="),
    (lambda f: ["run", f.photo], "is not a setting", "lodbench localize PHOTO"),
]


def _at(f: SimpleNamespace, photo: str = "") -> list[str]:
    return ["localize", photo or f.photo, "--city", f.city, "--crs", CRS]


def _track(f: SimpleNamespace) -> list[str]:
    return ["track", f.photos, "--city", f.city, *ABOUT, CAMERA]


def _placed(f: SimpleNamespace, model: str) -> list[str]:
    return ["georeference", model, "--city", f.city, "--crs", CRS, "--masks", f.masks]


def _drawn(f: SimpleNamespace) -> list[str]:
    return ["mask", f.png, "--mask", f.black, "--no-page"]


def _init(f: SimpleNamespace) -> list[str]:
    return ["dataset", "init", "own", "--images", f.flight, "--city", f.city, "--crs", CRS]


def _priors(f: SimpleNamespace) -> list[str]:
    return ["dataset", "prior", f.no_truth, "--kind", "uniform", "--out", "priors.txt"]


def _drawn_run(f: SimpleNamespace) -> list[str]:
    return ["run", "dataset=folder", f"dataset.root={f.no_truth}", f"city={f.city}", "prior=uniform"]


def _bench(f: SimpleNamespace) -> list[str]:
    return ["bench", "flights", "--city", f.city]


@pytest.mark.parametrize(("words", "said", "hint"), CASES, ids=[said for _, said, _ in CASES])
def test_a_mistake_is_one_line_and_a_hint(files, capsys, tmp_path, monkeypatch, words, said, hint):
    monkeypatch.chdir(tmp_path)
    assert main(words(files)) == 2
    lines = capsys.readouterr().err.splitlines()
    assert (len(lines), lines[0][:10]) == (2 if hint else 1, "lodbench: ")
    assert said in lines[0]
    assert hint.format(city=shlex.quote(files.city)) in lines[-1]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "words",
    [
        lambda f: _at(f, f.flight),
        lambda f: [*_placed(f, f.model), "--images", f.flight],
    ],
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
