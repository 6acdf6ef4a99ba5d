import json

import pytest

from lodbench.execution import Ledger
from lodbench.storage.disk import Disk, another_disk

pytestmark = pytest.mark.attack


class TestLedger:
    def test_keeps_items_in_the_file(self, tmp_path):
        path = tmp_path / "ledger.jsonl"
        Ledger(path).record("a", {"x": 1})
        again = Ledger(path)
        assert "a" in again
        assert again["a"] == {"x": 1}
        assert "b" not in again
        assert len(again) == 1

    def test_drops_the_half_line_a_kill_leaves(self, tmp_path):
        path = tmp_path / "ledger.jsonl"
        ledger = Ledger(path)
        ledger.record("a", {"x": 1})
        ledger.record("b", {"x": 2})
        whole = path.read_bytes()
        for cut in range(len(whole.splitlines()[0]) + 2, len(whole)):
            path.write_bytes(whole[:cut])
            again = Ledger(path)
            assert "a" in again
            assert "b" not in again
            again.record("b", {"x": 2})
            assert path.read_bytes() == whole

    def test_refuses_what_json_cannot_hold(self, tmp_path):
        with pytest.raises(ValueError, match="JSON"):
            Ledger(tmp_path / "ledger.jsonl").record("a", {"x": float("nan")})

    def test_lines_are_json(self, tmp_path):
        path = tmp_path / "ledger.jsonl"
        Ledger(path).record("ä/b", {"x": [1.5, None]})
        line = json.loads(path.read_text())
        assert len(line.pop("check")) == 16
        assert line == {"key": "ä/b", "x": [1.5, None]}

    def test_a_changed_byte_anywhere_is_a_damaged_line(self, tmp_path, caplog):
        path = tmp_path / "ledger.jsonl"
        items = {"a": {"x": 1.25, "failure": ""}, "b": {"x": 2.5, "failure": "no"}}
        for key, value in items.items():
            Ledger(path).record(key, value)
        whole = path.read_bytes()
        for place in range(len(whole)):
            for flip in (1, 4, 64):
                path.write_bytes(whole[:place] + bytes([whole[place] ^ flip]) + whole[place + 1 :])
                found = Ledger(path, read_only=True)
                for key in items:
                    # A stray key may come in where it is the check's name that was hit: the answer stands.
                    assert key not in found or {k: found[key].get(k) for k in items[key]} == items[key]
        assert "damaged lines, which count as not done" in caplog.text

    def test_lines_of_older_versions_are_read_up_to_the_first_with_a_check(self, tmp_path):
        path = tmp_path / "ledger.jsonl"
        path.write_text('{"key": "a", "x": 1}\n')
        Ledger(path).record("b", {"x": 2})
        with path.open("a") as stream:
            stream.write('{"key": "c", "x": 3}\n')
        again = Ledger(path)
        assert ("a" in again, "b" in again, "c" in again) == (True, True, False)

    def test_a_full_disk_leaves_no_half_line(self, tmp_path):
        class Full(Disk):
            def write(self, stream, content, path):
                super().write(stream, content[:7], path)
                raise OSError(28, "No space left on device", str(path))

        path = tmp_path / "ledger.jsonl"
        ledger = Ledger(path)
        ledger.record("a", {"x": 1})
        with another_disk(Full()), pytest.raises(OSError, match="No space"):
            ledger.record("b", {"x": 2})
        assert "b" not in ledger
        ledger.record("c", {"x": 3})
        assert len(Ledger(path)) == 2

    @pytest.mark.parametrize(
        "damage",
        [
            b"garbage",
            b"\0" * 64,
            b"\xff\xfe",
            b"",
            b'{"x": 1}',
            b'{"key": 3, "x": 1}',
            b'{"key": null}',
            b'["key"]',
            b'"key"',
            b"null",
            b"[" * 200_000,
        ],
        ids=lambda damage: repr(damage[:12]),
    )
    def test_a_damaged_line_is_dropped_and_done_again(self, tmp_path, damage):
        path = tmp_path / "ledger.jsonl"
        ledger = Ledger(path)
        ledger.record("a", {"x": 1})
        ledger.record("b", {"x": 2})
        first, second = path.read_bytes().splitlines(keepends=True)
        path.write_bytes(first + damage + b"\n" + second)
        again = Ledger(path)
        assert len(again) == 2
        assert again["b"] == {"x": 2}
        assert path.read_bytes() == first + second
        assert list(tmp_path.iterdir()) == [path]
        path.write_bytes(damage + b"\n")
        assert len(Ledger(path)) == 0
        assert path.read_bytes() == b""

    def test_a_sound_file_is_not_written_again(self, tmp_path):
        path = tmp_path / "ledger.jsonl"
        Ledger(path).record("a", {"x": 1})
        before = path.stat().st_ino
        Ledger(path)
        assert path.stat().st_ino == before
