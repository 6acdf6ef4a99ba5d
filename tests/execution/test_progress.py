import io
import re

import pytest

from lodbench.execution.progress import Progress, ProgressCallback, format_seconds


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
