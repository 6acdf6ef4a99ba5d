from __future__ import annotations

import numpy as np
import pytest
from lxml import etree

from lodbench.citymodel import ReadOptions
from lodbench.citymodel.terrain import ground_under
from lodbench.synthesis.town.build import ascii_grid_text, relief_text
from lodbench.synthesis.town.town import ORIGIN_M

GML = "{http://www.opengis.net/gml}"


def test_the_raster_gives_readers_the_ground_of_the_town(town, tmp_path):
    path = tmp_path / "terrain.asc"
    path.write_text(ascii_grid_text(town.terrain), encoding="ascii")
    places = np.random.default_rng(0).uniform(-600, 600, (500, 2))
    found = ground_under(places + ORIGIN_M[:2], "EPSG:25832", ReadOptions(terrain=str(path)))
    wrong = np.abs(found - town.terrain.height(places))
    # Cells of four metres on slopes of up to a tenth; the banks of the river are steeper.
    assert np.median(wrong) < 0.06
    assert np.percentile(wrong, 99) < 1.0


def test_the_relief_is_a_tin_whose_corners_are_the_ground(town):
    root = etree.fromstring(relief_text(town.terrain, "relief").encode())
    triangles = root.findall(f".//{GML}Triangle//{GML}posList")
    assert len(triangles) == 2 * 64 * 64
    corners = np.array([[float(v) for v in t.text.split()] for t in triangles[::50]]).reshape(-1, 4, 3)
    np.testing.assert_array_equal(corners[:, 0], corners[:, 3])
    local = corners[:, :3].reshape(-1, 3) - ORIGIN_M
    np.testing.assert_allclose(local[:, 2], town.terrain.height(local[:, :2]), atol=0.001)
    a, b, c = (corners[:, k] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


@pytest.mark.slow
def test_hills_are_higher_where_the_look_says_so(town, town_of):
    places = np.stack(np.meshgrid(*[np.arange(-500.0, 501.0, 50.0)] * 2), axis=-1).reshape(-1, 2)
    assert 25.0 < np.ptp(town.terrain.height(places)) < 70.0
    assert town_of(1).terrain.height(places)[0] != pytest.approx(town.terrain.height(places)[0], abs=0.1)
