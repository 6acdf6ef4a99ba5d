from __future__ import annotations

import re

import numpy as np
import pytest

from lodbench.reporting.map_figure import Spot, draw_map
from lodbench.reporting.page import markup, rendered
from tests.reporting.browser import opened


@pytest.mark.parametrize(("count", "classes"), [(199, "map"), (200, "map many"), (1000, "map many crowd")])
def test_many_cameras_are_drawn_smaller(count, classes):
    spots = [Spot(f"a/{n}", np.array([n, 0.0]), np.array([n, 5.0]), None) for n in range(count)]
    assert re.match('<div class="([^"]*)"', draw_map(spots, None, None))[1] == classes


@pytest.mark.slow
def test_cameras_grow_as_one_comes_closer(tmp_path):
    places = np.random.default_rng(0).uniform(0, 900, size=(1000, 2))
    drawn = draw_map([Spot(f"a/{n}", None, place, None) for n, place in enumerate(places)], None, None)
    told = {"differences": [], "is_weak": False, "has_truth": True, "answered": "", "untrusted": ""}
    sections = [("places", "From above", markup(drawn), [])]
    page_file = tmp_path / "page.html"
    page_file.write_text(rendered("run.html.jinja", title="x", protocol="", sections=sections, **told))
    with opened(page_file) as (page, complaints):
        buttons, seen = page.locator(".map button"), []
        for _ in range(7):
            seen.append(page.locator(".map").get_attribute("class"))
            buttons.first.click()
        buttons.last.click()
        assert list(dict.fromkeys(seen)) == ["map many crowd", "map many", "map"]
        assert page.locator(".map").get_attribute("class") == "map many crowd"
        assert complaints == []
