"""The committed leaderboard pages in a real browser."""

import re
from html import unescape
from pathlib import Path
from urllib.parse import unquote

import pytest

from tests.reporting.browser import DESK, PHONE, column_texts, fits, opened, press

ROOT = Path(__file__).resolve().parents[2] / "leaderboard"
PAGE = ROOT / "uavd4l_lodv2.html"


@pytest.mark.slow
@pytest.mark.parametrize(("size", "scheme"), [(DESK, "light"), (PHONE, "dark")])
def test_the_page_is_readable_and_quiet(size, scheme):
    with opened(PAGE, size, scheme) as (page, complaints):
        assert "1.13/044" in page.inner_text("main")
        assert fits(page)
        ink, paper = page.evaluate("(s => [s.color, s.backgroundColor])(getComputedStyle(document.body))")
        assert brightness(ink) > 0.7 if scheme == "dark" else brightness(paper) > 0.9
        assert abs(brightness(ink) - brightness(paper)) > 0.7
        assert complaints == []


@pytest.mark.slow
def test_columns_sort_by_number_and_unknown_ones_stay_last():
    with opened(PAGE) as (page, complaints):
        before = column_texts(page, 0, 1)
        press(page, 0, 1)
        rising = column_texts(page, 0, 1)
        assert rising == sorted(before, key=float)
        press(page, 0, 1)
        assert column_texts(page, 0, 1) == sorted(before, key=float, reverse=True)
        press(page, 0, 4)
        medians = column_texts(page, 0, 4)
        known = [float(cell.split("/")[0]) for cell in medians if cell != "-"]
        assert known == sorted(known)
        assert medians[len(known) :] == ["-"] * (len(medians) - len(known))
        press(page, 0, 0)
        names = column_texts(page, 0, 0)
        assert names == sorted(names, key=str.lower)
        assert complaints == []


@pytest.mark.slow
def test_on_a_phone_the_index_shows_its_figures_and_its_links_look_like_links():
    with opened(ROOT / "index.html", PHONE) as (page, complaints):
        for cell in page.locator("tbody b").all():
            box = cell.bounding_box()
            assert 0 <= box["x"]
            assert box["x"] + box["width"] <= PHONE["width"]
        link = page.get_by_role("link", name="All rows of demo")
        assert link.evaluate("e => getComputedStyle(e).textDecorationLine") == "underline"
        assert page.locator("h2 a").count() == 0
        assert complaints == []


def test_every_link_leads_somewhere():
    for file in ROOT.glob("*.html"):
        targets = re.findall(r'<a href="([^"#]+)', file.read_text(encoding="utf-8"))
        assert targets
        assert [t for t in targets if not (ROOT / unquote(unescape(t))).is_file()] == []


def brightness(colour: str) -> float:
    """Returns the mean of the channels of ``rgb(r, g, b)``, 0 to 1."""
    channels = [float(word) for word in colour[colour.index("(") + 1 : -1].split(",")[:3]]
    return sum(channels) / (3 * 255)
