"""Files written whole, digests that are compared at reading, cells that are no formulas."""

import hashlib
import math
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodbench.errors import ConfigError, InputChanged
from lodbench.storage import (
    can_write,
    digest_of,
    file_digest,
    hide_formula,
    new_folder,
    random_stream,
    remove_leftovers,
    show_formula,
    write_bytes,
    write_text,
)
from lodbench.storage.digest import (
    content_digest,
    known_contents,
    read_content,
    remember_contents,
    remembered_contents,
)
from lodbench.storage.disk import Disk, another_disk, disk
from lodbench.storage.json_text import parse_json
from lodbench.storage.paths import cache_limit_bytes, cache_root, data_root, mark_used, prune_cache


def test_what_can_be_written_to_is_known_beforehand(tmp_path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "gone").symlink_to(tmp_path / "nowhere")
    assert can_write(tmp_path)
    assert can_write(tmp_path / "new" / "below")
    assert not any(can_write(tmp_path / name) for name in ("file", "file/below/it", "gone", "gone/below"))
    with pytest.raises(OSError, match="too long"):
        can_write(tmp_path / ("x" * 300) / "below")


class TestAtomicWrite:
    def test_replaces_the_file(self, tmp_path):
        write_text(tmp_path / "a.txt", "one")
        write_text(tmp_path / "a.txt", "zwei ü\n")
        assert (tmp_path / "a.txt").read_bytes() == "zwei ü\n".encode()
        assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]

    def test_a_failure_leaves_the_old_file_and_no_part(self, tmp_path, monkeypatch):
        write_bytes(tmp_path / "a.txt", b"old")

        def full_disk(handle: int) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr("os.fsync", full_disk)
        with pytest.raises(OSError, match="No space"):
            write_bytes(tmp_path / "a.txt", b"new")
        assert (tmp_path / "a.txt").read_bytes() == b"old"
        assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


class TestRandomStream:
    def test_is_named_by_its_path(self):
        a = random_stream(0, "demo", "q1", "fine", 3).standard_normal(5)
        assert np.array_equal(a, random_stream(0, "demo", "q1", "fine", 3).standard_normal(5))
        for other in (
            (1, "demo", "q1", "fine", 3),
            (0, "demo", "q1", "fine", 4),
            (0, "demo", "q1", "fine", "3"),
        ):
            assert not np.array_equal(a, random_stream(*other).standard_normal(5))

    def test_is_the_same_on_every_machine(self):
        drawn = random_stream(0, "golden").integers(0, 1000, 4)
        assert drawn.tolist() == GOLDEN


GOLDEN = [686, 858, 371, 805]


class TestDigest:
    def test_ignores_the_order_of_keys_only(self):
        assert digest_of({"a": 1, "b": [1, 2]}) == digest_of({"b": [1, 2], "a": 1})
        assert digest_of({"a": [1, 2]}) != digest_of({"a": [2, 1]})

    def test_of_a_file_is_sha256(self, tmp_path):
        (tmp_path / "a").write_bytes(b"abc")
        expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
        assert file_digest(tmp_path / "a") == expected


def test_roots_follow_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("LODBENCH_DATA", str(tmp_path / "d"))
    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path / "c"))
    assert (data_root(), cache_root()) == (tmp_path / "d", tmp_path / "c")
    monkeypatch.delenv("LODBENCH_DATA")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "x"))
    assert data_root() == tmp_path / "x" / "lodbench"


class TestPruning:
    @staticmethod
    def fill(root, names, age_s=0.0):
        for n, name in enumerate(names):
            (root / name).mkdir()
            (root / name / "data").write_bytes(bytes(100))
            used = time.time() - age_s - 10 * (len(names) - n)
            os.utime(root / name, (used, used))

    def test_longest_unused_goes_first(self, tmp_path):
        self.fill(tmp_path, "abcd")
        mark_used(tmp_path / "a")
        assert prune_cache(tmp_path, 250, keep=tmp_path / "d") == [tmp_path / "b", tmp_path / "c"]
        assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "d"]

    def test_keeps_what_fits_and_what_it_must(self, tmp_path):
        self.fill(tmp_path, "ab")
        assert prune_cache(tmp_path, 200, keep=tmp_path / "b") == []
        assert prune_cache(tmp_path, 0, keep=tmp_path / "a") == [tmp_path / "b"]

    def test_parts_of_a_dead_process_go_and_those_of_a_living_stay(self, tmp_path):
        self.fill(tmp_path, [".new.1"])
        self.fill(tmp_path, [".old.1"], age_s=2 * 24 * 3600)
        assert prune_cache(tmp_path, 0, keep=tmp_path) == [tmp_path / ".old.1"]

    def test_what_is_no_folder_of_ours_stays(self, tmp_path):
        (tmp_path / "note.txt").write_text("mine")
        assert prune_cache(tmp_path, 0, keep=tmp_path) == []
        mark_used(tmp_path / "absent")

    def test_limit(self, monkeypatch):
        monkeypatch.delenv("LODBENCH_CACHE_GB", raising=False)
        assert cache_limit_bytes() == 20_000_000_000
        monkeypatch.setenv("LODBENCH_CACHE_GB", "0.5")
        assert cache_limit_bytes() == 500_000_000
        for wrong in ("much", "-1", "nan", "inf"):
            monkeypatch.setenv("LODBENCH_CACHE_GB", wrong)
            with pytest.raises(ConfigError, match="is no size"):
                cache_limit_bytes()


class TestNewFolder:
    def test_appears_whole_in_place_of_the_old(self, tmp_path):
        path = tmp_path / "folder"
        for text in ("old", "new"):
            with new_folder(path) as partial:
                (partial / text).write_text(text)
                assert not (path / text).exists()
        assert [file.name for file in path.iterdir()] == ["new"]
        assert path.stat().st_mode & 0o777 == 0o755

    def test_a_fault_leaves_the_old_one_and_nothing_else(self, tmp_path):
        path = tmp_path / "folder"
        path.mkdir()
        with pytest.raises(FileNotFoundError), new_folder(path) as partial:
            (partial / "absent" / "half").write_text("")
        assert [entry.name for entry in tmp_path.rglob("*")] == ["folder"]


class TestNewFolderUnderKills:
    @staticmethod
    def fill(path, text):
        with new_folder(path) as partial:
            (partial / "a").write_text(text)

    @pytest.mark.parametrize("can_swap", [True, False])
    def test_replaces_a_folder(self, tmp_path, monkeypatch, can_swap):
        if not can_swap:
            monkeypatch.setattr("lodbench.storage.disk.Disk.swap", lambda *_: False)
        for text in ("one", "two"):
            self.fill(tmp_path / "x", text)
            assert (tmp_path / "x/a").read_text() == text
            assert [path.name for path in tmp_path.iterdir()] == ["x"]

    def test_a_kill_at_any_moment_leaves_the_old_one_or_the_new(self, tmp_path):
        code = (
            "import os, sys; from pathlib import Path\n"
            "from lodbench.storage import disk, new_folder\n"
            "class Dying(disk.Disk):\n"
            "    def sync_folder(self, folder): os._exit(9)\n"
            "disk._disk = Dying()\n"
            "with new_folder(Path(sys.argv[1])) as partial: (partial / 'a').write_text('new' * 1000)\n"
        )
        self.fill(tmp_path / "x", "old")
        for _ in range(2):
            done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "x")])
            assert done.returncode == 9
            # The part that the first left is swept up by the second.
            assert (tmp_path / "x/a").read_text() == "old"
            assert len(list(tmp_path.iterdir())) == 2
        self.fill(tmp_path / "x", "new")
        assert (tmp_path / "x/a").read_text() == "new"
        assert [path.name for path in tmp_path.iterdir()] == ["x"]

    def test_what_a_living_process_writes_is_left_alone(self, tmp_path):
        with new_folder(tmp_path / "x") as partial:
            remove_leftovers(tmp_path)
            self.fill(tmp_path / "x", "theirs")
            assert partial.is_dir()
            (partial / "a").write_text("ours")
        assert (tmp_path / "x/a").read_text() == "ours"


def test_a_file_that_is_about_to_get_its_name_is_left_alone_by_who_sweeps_up(tmp_path):
    """Another worker that began to write in the folder took it for a killed process's."""

    class Swept(Disk):
        def rename(self, source: Path, target: Path) -> None:
            remove_leftovers(target.parent)
            super().rename(source, target)

    with another_disk(Swept()):
        write_bytes(tmp_path / "a", b"whole")
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("a", b"whole")]


def test_a_full_disk_is_told_with_the_file(tmp_path):
    with (
        pytest.raises(OSError, match="No space left on device: '/dev/full'"),
        Path("/dev/full").open("wb", buffering=0) as stream,
    ):
        disk().write(stream, b"x", Path("/dev/full"))


class TestJson:
    @pytest.mark.parametrize("text", ["[" * 100_000, '{"a":' * 100_000])
    def test_deep_nesting_is_a_value_error(self, text):
        with pytest.raises(ValueError, match="nested too deeply"):
            parse_json(text)

    def test_strictly_there_is_no_nan(self):
        assert math.isnan(parse_json("[NaN]")[0])
        with pytest.raises(ValueError, match="Infinity is not a number of JSON"):
            parse_json("[-Infinity]", is_strict=True)


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "mask.png"
    path.write_bytes(b"as it was")
    return path


def test_what_changed_since_it_was_hashed_is_not_read(file):
    with remembered_contents():
        assert content_digest(file) == hashlib.sha256(b"as it was").hexdigest()
        assert read_content(file) == b"as it was"
        file.write_bytes(b"as it is.")
        with pytest.raises(InputChanged, match=r"mask\.png changed"):
            read_content(file)
        file.write_bytes(b"as it was")
        assert read_content(file) == b"as it was"


def test_a_digest_is_that_of_the_first_look_and_anew_in_a_scope_of_its_own(file):
    with remembered_contents():
        first = content_digest(file)
        file.write_bytes(b"as it is.")
        assert content_digest(file) == first
        with remembered_contents():
            assert content_digest(file) == hashlib.sha256(b"as it is.").hexdigest()
        assert known_contents() == {file: first}
    assert known_contents() == {}
    assert read_content(file) == b"as it is."


def test_a_file_never_hashed_is_just_read_and_one_that_is_not_there_has_a_word(file):
    with remembered_contents():
        assert read_content(file) == b"as it was"
        assert content_digest(Path("nowhere.png")) == "unreadable"
        assert content_digest(None) is None
        with pytest.raises(FileNotFoundError):
            read_content(Path("nowhere.png"))


def test_a_worker_compares_with_what_another_process_found(file):
    remember_contents({file: hashlib.sha256(b"something else").hexdigest()})
    try:
        with pytest.raises(InputChanged):
            read_content(file)
        with remembered_contents():  # a run of its own knows its own files
            assert read_content(file) == b"as it was"
    finally:
        remember_contents({})
    assert read_content(file) == b"as it was"


def test_runs_in_threads_do_not_mix_what_they_remember(file, tmp_path):
    def digest_and_read(name):
        with remembered_contents():
            content_digest(file)
            (tmp_path / name).write_bytes(name.encode())
            content_digest(tmp_path / name)
            return known_contents().keys() - {file}

    with ThreadPoolExecutor(4) as pool:
        names = [f"{number}.png" for number in range(20)]
        assert list(pool.map(digest_and_read, names)) == [{tmp_path / name} for name in names]


def test_a_wanted_digest_goes_before_what_is_remembered(file):
    with pytest.raises(InputChanged):
        read_content(file, hashlib.sha256(b"something else").hexdigest())
    assert read_content(file, hashlib.sha256(b"as it was").hexdigest()) == b"as it was"


@pytest.mark.parametrize("text", ["=1+1", "+49", "-x", "@SUM(A1)", "'=1", "''@x"])
def test_what_a_spreadsheet_would_compute_gets_an_apostrophe(text):
    assert hide_formula(text) == f"'{text}"


@pytest.mark.parametrize("text", ["", "a=b", "'quoted'", "DJI_0001.JPG"])
def test_other_texts_stay(text):
    assert hide_formula(text) == text


@given(st.text(alphabet="'=+-@ab", max_size=8))
def test_every_text_comes_back(text):
    assert show_formula(hide_formula(text)) == text
    assert not hide_formula(text).startswith(("=", "+", "-", "@"))
