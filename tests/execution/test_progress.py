"""Bars and lines with the time left; a ledger that is read back as it was written."""

import io
import json
import re

import pytest

from lodbench.execution.progress import Ledger, Progress, ProgressCallback, format_seconds
from lodbench.storage.disk import Disk, another_disk


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class TestProgress:
    def test_short_work_leaves_a_log_clean(self):
        log = io.StringIO()
        with Progress("views", 3, log) as progress:
            progress.advance(3)
        assert log.getvalue() == ""

    def test_long_work_leaves_a_line_now_and_then(self, monkeypatch):
        log = io.StringIO()
        clock = iter([0.0, 59.0, 61.0, 90.0, 122.0])  # the first item compiles
        monkeypatch.setattr("lodbench.execution.progress.time.monotonic", lambda: next(clock))
        with Progress("views", 8, log) as progress:
            for _ in range(4):
                progress.advance()
        assert log.getvalue().splitlines() == ["views: 2 of 8", "views: 4 of 8, 1 min 24 s left"]

    def test_a_bar_on_a_terminal_leaves_no_trace(self):
        screen = Terminal()
        with Progress("views", 3, screen) as progress:
            progress.advance(3)
        assert "views: 0 of 3" in screen.getvalue()
        assert screen.getvalue().endswith(" \r")

    def test_nothing_is_said_of_the_time_left_before_the_pace_is_known(self, monkeypatch):
        screen = Terminal()
        # A first item of a minute, then four a second.
        clock = iter([0.0, *(60 + step / 4 for step in range(60))])
        monkeypatch.setattr("lodbench.execution.progress.time.monotonic", lambda: next(clock))
        with Progress("views", 1000, screen) as progress:
            for _ in range(3):
                progress.advance()
            assert "left" not in screen.getvalue()
            for _ in range(20):
                progress.advance()
            progress._bar.refresh()
        assert "4 min 04 s left" in screen.getvalue()
        assert not re.search(r"\d h \d+ min left", screen.getvalue())

    def test_what_was_there_already_is_no_pace(self, monkeypatch):
        log = io.StringIO()
        clock = iter([0.0, 190.0, 255.0])
        monkeypatch.setattr("lodbench.execution.progress.time.monotonic", lambda: next(clock))
        with Progress("queries", 40, log, done=10) as progress:
            progress.advance()
            progress.advance()
        assert log.getvalue().splitlines() == ["queries: 11 of 40", "queries: 12 of 40, 30 min 20 s left"]

    def test_an_unknown_total_is_not_made_up(self, monkeypatch):
        log = io.StringIO()
        clock = iter([0.0, 61.0])
        monkeypatch.setattr("lodbench.execution.progress.time.monotonic", lambda: next(clock))
        with Progress("city.zip", None, log, "MB") as progress:
            progress.advance(45)
        assert log.getvalue() == "city.zip: 45 MB\n"


class TestProgressCallback:
    def test_counts_in_units(self):
        screen = Terminal()
        with ProgressCallback("city.gml", "MB", 10, screen) as progress:
            for done in (4, 9, 25):
                progress(done, 25)
            progress(30, 25)
        assert "city.gml: 0 of 3 MB" in screen.getvalue()

    def test_draws_nothing_without_a_call(self):
        screen = Terminal()
        with ProgressCallback("city.gml", stream=screen):
            pass
        assert screen.getvalue() == ""


@pytest.mark.parametrize(
    ("seconds", "text"), [(0, "0 s"), (59.6, "1 min 00 s"), (125, "2 min 05 s"), (4200, "1 h 10 min")]
)
def test_format_seconds(seconds, text):
    assert format_seconds(seconds) == text


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
