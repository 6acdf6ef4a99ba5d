"""Options that say the same thing twice, or that nothing would read: refused before any work, in one line."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from lodbench.cli import main
from lodbench.cli.localize import _masks_for, parser
from tests.photos.dji_photo import write_photo
from tests.town import box_obj


@pytest.fixture
def files(tmp_path: Path) -> SimpleNamespace:
    """A photo, a city and empty folders: nothing of them is read before the options are."""
    (tmp_path / "flight/masks").mkdir(parents=True)
    write_photo(tmp_path / "flight/DJI_0001.JPG")
    (tmp_path / "city.obj").write_text(box_obj())
    return SimpleNamespace(
        photo=str(tmp_path / "flight/DJI_0001.JPG"),
        flight=str(tmp_path / "flight"),
        masks=str(tmp_path / "flight/masks"),
        city=str(tmp_path / "city.obj"),
        out=tmp_path / "out",
    )


LOCALIZE = "localize {photo} --city {city} --out {out}"
TRACK = "track {flight} --city {city} --out {out}"
PLACED = "georeference {flight} --city {city} --out {out}"
INIT = "dataset init {out} --images {flight} --city {city}"
IMPORT = "dataset import tum {photo} {out}"
CASES = [
    (f"{LOCALIZE} --height 100 --takeoff 60", "--takeoff is not used with --height", "leave --takeoff"),
    (f"{LOCALIZE} --height 100 --geoid 46", "--geoid is not used with --height", "or --height out"),
    (f"{LOCALIZE} --height 100 --heights ellipsoid", "--heights is not used with --height", "--height out"),
    (f"{TRACK} --height 100 --takeoff 60", "--takeoff is not used with --height", "leave --takeoff"),
    (f"{LOCALIZE} --lat 51", "--lat is half a place", "Give --lon too"),
    (f"{TRACK} --lon 6", "--lon is half a place", "Give --lat too"),
    (f"{LOCALIZE} --center 1 2 3 --heights sea_level", "--heights is not used with --center", "--center has"),
    (
        f"{PLACED} --start {{photo}} --masks {{masks}} --takeoff 60",
        "not used with --start",
        "leave --takeoff",
    ),
    (f"{PLACED} --images {{flight}} --masks {{masks}} --segmenter compact", "not used with --masks", "Leave"),
    (f"{TRACK} --masks {{masks}} --segmenter compact", "--segmenter is not used with --masks", "Leave"),
    (f"{TRACK} --masks {{masks}} --segmenter-option size=384", "--segmenter-option is not used", "Leave"),
    (f"{LOCALIZE} --mask {{photo}} --segmenter compact", "--segmenter is not used with --mask", "Leave"),
    (f"{INIT} --offset 1 2 3", "--offset is not used without --colmap", "Give --colmap"),
    (f"{IMPORT} --takeoff 60", "--takeoff is not used without --city and --images", "leave --takeoff out"),
    (f"{IMPORT} --crs EPSG:25832", "--crs is not used without --city", "Give --city"),
    (f"{IMPORT} --masks {{masks}}", "--masks is not used without --images", "Give --images"),
    (f"{IMPORT} --camera C --cameras {{photo}}", "--camera and --cameras say the same", "one of them"),
]


@pytest.mark.parametrize(("words", "said", "hint"), CASES, ids=[f"{w.split()[0]} {s}" for w, s, _ in CASES])
def test_one_of_the_two_is_refused(files, capsys, words, said, hint):
    assert main([word.format(**vars(files)) for word in words.split()]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert said in lines[0]
    assert hint in lines[1]
    assert len(lines) == 2
    assert not files.out.exists()


def test_an_offset_is_added_to_a_height_that_is_known(files, capsys):
    words = [word.format(**vars(files)) for word in LOCALIZE.split()]
    assert main([*words, "--height", "100", "--height-offset", "2"]) == 2
    assert "does not say" in capsys.readouterr().err  # past the options: the photo states no place


def test_a_segmenter_that_is_named_goes_before_masks_among_the_photos(files):
    asked = parser().parse_args([files.flight, "--city", files.city])
    assert _masks_for(asked) == Path(files.masks)
    asked = parser().parse_args([files.flight, "--city", files.city, "--segmenter", "compact"])
    assert _masks_for(asked) is None


def test_a_word_is_told_back_as_it_was_typed(capsys):
    assert main(["run", "dataset=demo", "tilt=true"]) == 2
    assert capsys.readouterr().err.startswith("lodbench: tilt=true is not known.")
