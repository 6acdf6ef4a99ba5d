"""What a method prepares: made once, whole or not at all, and found again."""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from lodbench.errors import LodbenchError
from lodbench.methods.protocol import Workspace, open_workspace

pytestmark = pytest.mark.attack


def never(path: Path) -> None:
    raise AssertionError("a part that is there is not made again")


def test_a_part_is_made_once(tmp_path):
    path = Workspace(tmp_path / "work").part("names.npy", lambda file: np.save(file, np.arange(5)))
    assert np.load(path).tolist() == [0, 1, 2, 3, 4]
    assert Workspace(tmp_path / "work").part("names.npy", never) == path


def test_a_part_may_be_a_folder(tmp_path):
    def make(folder: Path) -> None:
        folder.mkdir()
        (folder / "a.txt").write_text("a")

    workspace = Workspace(tmp_path)
    assert (workspace.part("tiles", make) / "a.txt").read_text() == "a"
    assert workspace.part("tiles", never).is_dir()


def test_what_fails_leaves_nothing_and_keeps_the_rest(tmp_path):
    workspace = Workspace(tmp_path)
    workspace.part("first", lambda file: file.write_text("done"))

    def fail(file: Path) -> None:
        file.write_text("half")
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        workspace.part("second", fail)
    assert {path.name for path in tmp_path.iterdir()} == {"first", ".first.xxh3"}


@pytest.mark.parametrize("place", [0, 90, -1])
def test_a_damaged_part_is_told_and_made_anew(tmp_path, caplog, place):
    workspace, values = Workspace(tmp_path), np.arange(50)
    path = workspace.part("a.npy", lambda file: np.save(file, values))
    content = bytearray(path.read_bytes())
    content[place] ^= 4
    path.write_bytes(content)
    again = workspace.part("a.npy", lambda file: np.save(file, values))
    assert np.load(again).tolist() == values.tolist()
    assert "a.npy, which a method prepared, is damaged" in caplog.text
    assert Workspace(tmp_path).part("a.npy", never) == path


def test_a_folder_that_another_process_made_meanwhile_stays(tmp_path):
    workspace = Workspace(tmp_path)

    def make(folder: Path) -> None:
        folder.mkdir()
        (folder / "a.txt").write_text("a")

    theirs: list[int] = []

    def make_later(folder: Path) -> None:
        make(tmp_path / ".other")
        (tmp_path / ".other").rename(tmp_path / "tiles")
        theirs.append((tmp_path / "tiles").stat().st_ino)
        make(folder)

    part = workspace.part("tiles", make_later)
    assert part.stat().st_ino == theirs[0]
    assert workspace.part("tiles", never) == part


@pytest.mark.parametrize("damage", ["changed", "gone", "more", "no check"])
def test_a_folder_with_a_damaged_file_is_made_anew(tmp_path, damage):
    def make(folder: Path) -> None:
        folder.mkdir()
        (folder / "a.txt").write_text("a")
        (folder / "b.txt").write_text("b")

    workspace = Workspace(tmp_path)
    part = workspace.part("tiles", make)
    if damage == "changed":
        (part / "b.txt").write_text("c")
    elif damage == "gone":
        (part / "b.txt").unlink()
    elif damage == "more":
        (part / "c.txt").write_text("c")
    else:
        (tmp_path / ".tiles.xxh3").unlink()
    assert sorted(file.read_text() for file in workspace.part("tiles", make).iterdir()) == ["a", "b"]
    assert workspace.part("tiles", never) == part


def test_a_kill_keeps_the_finished_parts(tmp_path):
    code = (
        "import sys, time\nfrom pathlib import Path\nfrom lodbench.methods.protocol import Workspace\n"
        "work = Workspace(Path(sys.argv[1]))\nwork.part('first', lambda file: file.write_text('done'))\n"
        "work.part('second', lambda file: (file.write_text('half'), time.sleep(600)))\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)])
    while not any("second" in path.name for path in tmp_path.iterdir()):
        assert process.poll() is None
        time.sleep(0.02)
    process.kill()
    process.wait()
    workspace = Workspace(tmp_path)
    assert workspace.part("first", never).read_text() == "done"
    assert workspace.part("second", lambda file: file.write_text("whole")).read_text() == "whole"


@pytest.mark.parametrize("name", ["a/b", "../a", ".hidden", "", ".."])
def test_names_stay_inside(tmp_path, name):
    with pytest.raises(LodbenchError, match="cannot name a folder"):
        Workspace(tmp_path).part(name, lambda file: file.write_text(""))


def test_a_part_that_is_not_written_is_told(tmp_path):
    with pytest.raises(LodbenchError, match="Nothing was written"):
        Workspace(tmp_path).part("empty", lambda file: None)


def test_one_for_each_content_below_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path))
    one, other = open_workspace("retrieval", "aa"), open_workspace("retrieval", "bb")
    assert one.folder != other.folder
    assert one.folder.is_relative_to(tmp_path)
    one.part("x", lambda file: file.write_text("1"))
    assert open_workspace("retrieval", "aa").part("x", never).read_text() == "1"


def test_the_longest_unused_make_room(tmp_path, monkeypatch):
    import os

    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path))
    monkeypatch.setenv("LODBENCH_CACHE_GB", "0.000001")
    old = open_workspace("retrieval", "old")
    old.part("x", lambda file: file.write_bytes(bytes(5000)))
    os.utime(old.folder, (1, 1))
    new = open_workspace("retrieval", "new")
    assert new.folder.is_dir()
    assert not old.folder.exists()
