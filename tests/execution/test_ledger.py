import json

import pytest

from lodbench.execution import Ledger


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
        assert json.loads(path.read_text()) == {"key": "ä/b", "x": [1.5, None]}

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
