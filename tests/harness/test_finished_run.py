"""A finished run given again: nothing is computed or drawn anew, and nothing out of date is left."""

import os
import re

import pytest

from lodbench.cli import main
from lodbench.harness.runs import gallery, predict
from tests.town import write_dataset


@pytest.fixture
def words(tmp_path):
    root, city = write_dataset(tmp_path / "data", count=2)
    place = [f"dataset.root={root}", f"dataset.city_model={city}", f"paths.runs={tmp_path / 'runs'}"]
    return ["run", "dataset=folder", *place, "method=prior_only"]


@pytest.fixture
def drawn(monkeypatch):
    """The pictures that are drawn, by name, and how often renderers were warmed up."""
    names, real, warm = [], gallery.write_picture, predict._warm_up

    def write_picture(path, picture):
        names.append(path.name)
        real(path, picture)

    def warm_up(city_map):
        names.append("warm-up")
        warm(city_map)

    monkeypatch.setattr(gallery, "write_picture", write_picture)
    monkeypatch.setattr(predict, "_warm_up", warm_up)
    return names


def files_of(folder):
    # Times and provenance are of each command.
    apart = ("provenance.json", "timings.csv")
    kept = [path for path in folder.rglob("*") if path.is_file() and path.name not in apart]
    return {path.relative_to(folder): path.read_bytes() for path in kept}


def test_a_second_time_draws_nothing_and_leaves_the_same_files(words, drawn, tmp_path, capsys):
    assert main(words) == 0
    assert drawn.count("warm-up") == 1
    pictures = sorted(set(drawn) - {"warm-up"})
    assert len(pictures) == 2
    before = files_of(tmp_path / "runs")
    drawn.clear()
    first = capsys.readouterr().out
    assert main(words) == 0
    assert drawn == []
    assert files_of(tmp_path / "runs") == before
    second = re.sub(r" \(\d queries were there already\)", "", capsys.readouterr().out)
    assert second == first


def test_a_picture_that_is_gone_or_older_than_its_photo_or_answers_is_drawn_again(words, drawn, tmp_path):
    assert main(words) == 0
    first, second = sorted((tmp_path / "runs").rglob("overlays/*.png"))
    before = files_of(tmp_path / "runs")
    drawn.clear()
    first.unlink()
    assert main(words) == 0
    assert drawn == [first.name]
    drawn.clear()
    os.utime(second, ns=(1, 1))
    assert main(words) == 0
    assert drawn == [second.name]
    assert files_of(tmp_path / "runs") == before


def test_pictures_are_drawn_again_where_the_rows_differ(words, drawn, tmp_path):
    assert main(words) == 0
    (rows,) = (tmp_path / "runs").rglob("queries.csv")
    rows.write_text(rows.read_text().replace("prior_only", "x").replace("0", "1", 1))
    drawn.clear()
    assert main(words) == 0
    assert len(drawn) == 2
