import numpy as np
import pytest

from lodbench.storage import digest_of, file_digest, random_stream, write_bytes, write_text
from lodbench.storage.paths import cache_root, data_root


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
