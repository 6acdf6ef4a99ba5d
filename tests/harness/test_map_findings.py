"""Outlines of buildings that flights doubt, on the map and on Earth."""

import numpy as np
import pytest
from shapely.geometry import Polygon, shape

from lodbench.citymodel.scene import build_scene
from lodbench.harness.map_findings import building_outline, city_and_marks, contradiction_features
from lodbench.photos.map_frame import MapFrame

# A ring of flat roof, 20 m x 20 m with a court of 8 m x 8 m, as four rectangles; and a wall of it.
_RECTANGLES = ((0, 0, 20, 6), (0, 14, 20, 20), (0, 6, 6, 14), (14, 6, 20, 14))
ORIGIN = np.array([500_000.0, 5_600_000.0, 100.0])


@pytest.fixture
def scene():
    points, triangles = [], []
    for x, y, x2, y2 in _RECTANGLES:
        start = len(points)
        points += [(x, y, 9.0), (x2, y, 9.0), (x2, y2, 9.0), (x, y2, 9.0)]
        triangles += [(start, start + 1, start + 2), (start, start + 2, start + 3)]
    points += [(0, 0, 0.0), (20, 0, 0.0), (20, 0, 9.0)]
    triangles.append((len(points) - 3, len(points) - 2, len(points) - 1))
    owners = np.zeros(len(triangles), dtype=np.int64)
    return build_scene(
        np.array(points, float),
        np.array(triangles),
        owners,
        ("court",),
        lod="1",
        crs="EPSG:25832",
        origin=ORIGIN,
    )


def test_an_outline_has_its_court_as_a_hole(scene):
    ((outer, hole),) = building_outline(scene, 0)
    assert Polygon(outer, [hole]).area == pytest.approx(400.0 - 64.0)
    assert Polygon(outer).exterior.is_ccw
    assert outer.min(axis=0) == pytest.approx(ORIGIN[:2])


def test_what_is_contradicted_is_told_and_lies_where_it_stands(scene):
    frame = MapFrame("EPSG:25832")
    doubted = {"id": "court", "higher_m": 2.0, "sigma_m": 0.3, "photos": 3, "doubt": True}
    right = {"buildings": [{**doubted, "doubt": False}]}
    assert contradiction_features(scene, frame, right, "flight 1") == []
    ring = [
        [500_030.0, 5_600_000.0],
        [500_040.0, 5_600_000.0],
        [500_040.0, 5_600_010.0],
        [500_030.0, 5_600_000.0],
    ]
    lacking = {"kind": "unmapped", "outline": [ring], "area_m2": 50.0, "photos": ["p"]}
    lacking |= {"height_m": None, "sigma_m": None, "at_most_m": 8.0}
    gone = {"kind": "demolished", "id": "court", "probability": 0.9, "photos": ["p"]}
    findings = {"buildings": [doubted], "changes": [gone, lacking]}
    features = contradiction_features(scene, frame, findings, "flight 1")
    assert [each["properties"]["kind"] for each in features] == ["height", "demolished", "unmapped"]
    assert {each["properties"]["flight"] for each in features} == {"flight 1"}
    places = [shape(each["geometry"]).centroid for each in features]
    found = [frame.east_north(place.y, place.x) for place in places]
    assert found[0] == pytest.approx((500_010.0, 5_600_010.0), abs=0.01)
    assert found[1] == pytest.approx(found[0])
    assert found[2] == pytest.approx((500_036.67, 5_600_003.33), abs=0.01)
    _, marks = city_and_marks(scene, findings)
    assert [mark.title.split(":")[0] for mark in marks] == ["court", "court", "not in the map"]


def test_a_building_that_this_map_has_not_is_told_without_an_outline(scene):
    gone = {"kind": "demolished", "id": "of another map", "probability": 0.95, "photos": ["a", "b", "c"]}
    _, (mark,) = city_and_marks(scene, {"changes": [gone]})
    assert "of another map: probably demolished (95 %)" in mark.title
    assert list(mark.rings) == []
