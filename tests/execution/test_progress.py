import io

import pytest

from lodbench.execution.progress import Progress, ProgressCallback, format_seconds


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class TestProgress:
    def test_is_silent_in_a_log(self):
        log = io.StringIO()
        with Progress("views", 3, log) as progress:
            progress.advance(3)
        assert log.getvalue() == ""

    def test_shows_the_last_item_on_a_terminal_and_leaves_no_trace(self):
        screen = Terminal()
        with Progress("views", 3, screen) as progress:
            progress.advance(3)
        assert "views: 3 of 3" in screen.getvalue()
        assert screen.getvalue().endswith("\r\x1b[K")

    def test_time_left_follows_from_the_pace(self):
        progress = Progress("views", 10, io.StringIO())
        progress.advance(4)
        assert progress.line(20.0) == "views: 4 of 10, 30 s left"

    def test_an_unknown_total_is_not_made_up(self):
        progress = Progress("city.zip", None, io.StringIO(), "MB")
        progress.advance(45)
        assert progress.line(20.0) == "city.zip: 45 MB"


class TestProgressCallback:
    def test_counts_in_units(self):
        screen = Terminal()
        with ProgressCallback("city.gml", "MB", 10, screen) as progress:
            for done in (4, 9, 25):
                progress(done, 25)
            progress(30, 25)
        assert "city.gml: 3 of 3 MB" in screen.getvalue()

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
