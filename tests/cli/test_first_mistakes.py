"""What people may take for mistakes and what is none; mistakes themselves are in `tests/messages`."""

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
