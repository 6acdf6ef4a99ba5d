"""Which pictures below a folder are photos: no masks, however their folder is written, no results."""

from pathlib import Path

import pytest

from lodbench.cli import main
from lodbench.errors import DatasetError
from lodbench.harness.photo.flight_inputs import masks_of
from lodbench.harness.photo.many import photos_of


@pytest.fixture
def flight(tmp_path) -> Path:
    folder = tmp_path / "flight"
    for name in ("a.JPG", "b.JPG", "masks/a.png", "better/a.png", "out/a_overlay.png"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(name.encode())
    return folder


@pytest.mark.parametrize("relative", [True, False])
def test_masks_and_earlier_results_are_no_photos(flight, monkeypatch, relative):
    monkeypatch.chdir(flight.parent)
    source = Path("flight") if relative else flight
    found = photos_of([source], flight / "better", source / "masks", Path("flight/out"))
    assert [photo.name for photo in found] == ["a.JPG", "b.JPG"]
    # What the shell makes of flight/*, folders among it.
    named = photos_of(sorted(source.iterdir()), flight / "better", flight / "masks", flight / "out")
    assert source / "a.JPG" in named
    assert source / "better" / "a.png" not in named
    # Results beside the photos, or above them, are no reason to leave photos out.
    for out in (flight, flight.parent):
        assert source / "a.JPG" in photos_of([source], flight / "better", flight / "masks", out)


def test_what_macos_keeps_of_photos_is_none(flight):
    (flight / "._a.JPG").write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X        ")
    found = photos_of([flight], flight / "masks", flight / "better", flight / "out")
    assert [photo.name for photo in found] == ["a.JPG", "b.JPG"]


def test_a_folder_of_masks_alone_and_one_of_photos_alone_are_refused_in_one_line(capsys, flight):
    (flight / "c" / "masks").mkdir(parents=True)
    (flight / "masks" / "a.png").rename(flight / "c" / "masks" / "c.png")
    with pytest.raises(DatasetError, match="holds no photos outside the folders of masks"):
        photos_of([flight / "c"], flight / "c" / "masks")
    photos = photos_of([flight], flight, flight / "masks", flight / "better")
    assert photos[:2] == [flight / "a.JPG", flight / "b.JPG"]
    assert main(["localize", str(flight), "--city", "city.gml", "--masks", str(flight)]) == 2
    told = capsys.readouterr().err
    assert f"{flight} holds no mask of any image" in told
    assert "Traceback" not in told


def test_a_link_to_nowhere_does_not_lose_the_others(flight):
    gone = flight / "gone.JPG"
    gone.symlink_to(flight / "nowhere.JPG")
    _, reasons = masks_of([gone, flight / "a.JPG"], None)
    assert list(reasons) == [0]
    assert "cannot be read" in reasons[0]


def test_a_folder_that_is_called_as_photos_are_is_none(flight):
    """Some programs name folders after the photo that they tell of; a link that leads nowhere is told."""
    (flight / "c.jpg").mkdir()
    (flight / "c.jpg" / "tile.png").write_bytes(b"")
    (flight / "d.jpg").symlink_to(flight / "nothing.jpg")
    found = photos_of([flight], flight / "masks", flight / "better", flight / "out")
    assert [photo.name for photo in found] == ["a.JPG", "b.JPG", "tile.png", "d.jpg"]
