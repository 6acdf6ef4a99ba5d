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


class Blank:
    """Imagery of nothing."""

    name = "dop.tif"

    def within(self, low, high):
        return np.zeros((4, 4, 4), np.uint8)


def test_on_imagery_roofs_have_outlines_without_the_edges_between_their_triangles():
    # A roof of four corners above its floor, a wall between, and a second roof that shares no corner.
    roof = [(0, 0, 9), (10, 0, 9), (10, 6, 9), (0, 6, 9)]
    floor = [(x, y, 0) for x, y, _ in roof]
    vertices = np.array([*roof, *floor, (20, 0, 5), (26, 0, 5), (20, 4, 5)], float)
    triangles = np.array([(0, 1, 2), (0, 2, 3), (4, 6, 5), (4, 7, 6), (0, 4, 5), (8, 9, 10)], np.int32)
    spots = [Spot("a", None, np.array([5.0, 3.0]), None)]
    assert "outline" not in draw_map(spots, vertices, triangles)
    drawn = draw_map(spots, vertices, triangles, imagery=Blank())
    path = re.search(r'id="city-outline" d="([^"]+)"', drawn)[1]
    ends = [tuple(float(number) for number in re.findall(r"-?[\d.]+", line)) for line in path.split("M")[1:]]
    west, south = 5.0 - 40.0, 3.0 - 40.0  # the map's corner; y counts downwards
    found = {frozenset([(a + west, south - b), (c + west, south - d)]) for a, b, c, d in ends}
    corners = [(0, 0), (10, 0), (10, 6), (0, 6)]
    square = {frozenset([corners[k], corners[(k + 1) % 4]]) for k in range(4)}
    other = {frozenset(pair) for pair in (((20, 0), (26, 0)), ((26, 0), (20, 4)), ((20, 4), (20, 0)))}
    assert found == square | other
    assert len(ends) == 7
