"""Poses in another reference system than the city's: places and headings, and what cannot be brought."""

import numpy as np
import pytest
from pyproj import Transformer

from lodbench.datasets.pose_files import brought
from lodbench.datasets.pose_text import FoundPose
from lodbench.errors import DatasetError
from lodbench.geometry import EulerAngles, Pose

CITY = "EPSG:25832+7837"
CENTER = (280_950.5, 5_657_400.25)


def found(crs: str | None, center=CENTER) -> FoundPose:
    pose = Pose.from_euler(EulerAngles(50.0, 3.0, -40.0), (*center, 160.0))
    return FoundPose("a.jpg", "geo.txt, line 2", pose, crs=crs)


@pytest.mark.parametrize("crs", ["EPSG:23032", "EPSG:25831", "EPSG:32632", "EPSG:31466"])
def test_a_camera_sees_the_same_places_in_the_city_s_system(crs):
    way = Transformer.from_crs(crs, "EPSG:25832", always_xy=True, allow_ballpark=False)
    image = found(crs, way.transform(*CENTER, direction="INVERSE"))
    (moved,), (note,) = brought([image], CITY)
    assert moved.pose.center == pytest.approx([*CENTER, 160.0], abs=1e-3)
    assert f"poses in {crs} brought to {CITY}; its heights stay as they are" in note
    for pixel in [(0, 0, 1), (1, 0, 1), (0, 1, 1)]:
        east, north, up = image.pose.center + 10 * image.pose.rotation.T @ np.array(pixel, float)
        seen = np.array([*way.transform(east, north), up])
        ray = moved.pose.rotation @ (seen - moved.pose.center)
        # A metre of the plane is not quite one on the ground: up to 1 in 1000 between zones.
        assert ray / ray[2] == pytest.approx(pixel, abs=2e-3)


def test_poses_of_the_same_plane_or_of_none_stay():
    for crs in ("EPSG:25832", "EPSG:25832+5783", None):
        image = found(crs)
        assert brought([image], CITY) == ([image], ())
    image = found("EPSG:25833")
    assert brought([image], None) == ([image], ())


@pytest.mark.parametrize(
    ("crs", "words"),
    [
        ("EPSG:2263", "EPSG:2263 is not in metres to the east and north"),
        ("EPSG:26918", "in EPSG:26918 cannot be brought to EPSG:25832"),
    ],
)
def test_what_cannot_be_brought_is_refused_by_both_names(crs, words):
    with pytest.raises(DatasetError, match=words) as caught:
        brought([found(crs)], CITY)
    assert CITY in caught.value.hint
