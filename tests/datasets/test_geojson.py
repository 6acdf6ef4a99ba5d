"""Cameras on maps: GeoPackages as GDAL reads them, and rows of tables in surveyors' terms."""

import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lodbench.citymodel.source import is_own_geopackage, open_sources
from lodbench.datasets.exchange.geojson import nowhere_feature, write_geopackage
from lodbench.evaluation import pose_error
from lodbench.geometry import EulerAngles, Pose
from lodbench.geometry.angles import STEEP_DEG, off_nadir_deg
from lodbench.photos.map_frame import SIGMA_COLUMNS, SURVEY_COLUMNS, MapFrame, survey_row
from lodbench.photos.metadata import PhotoMetadata
from lodbench.photos.pose import RoughPlace, pose_at, pose_from_photo

FEATURES = [
    {
        "type": "Feature",
        "geometry": {"type": "Point", "coordinates": [7.1, 51.2]},
        "properties": {"name": "a \"quoted\" 'name'.jpg", "height_m": 3, "is_good": True, "tags": ["x", 1]},
    },
    {
        "type": "Feature",
        "geometry": {"type": "LineString", "coordinates": [[7.1, 51.2], [7.2, 51.3]]},
        "properties": {"name": "a"},
    },
    {
        "type": "Feature",
        "geometry": {"type": "Polygon", "coordinates": [[[7, 51], [8, 51], [8, 52], [7, 51]]]},
        "properties": {"name": "a", "ground_m": 1.5},
    },
    nowhere_feature({"name": "lost \udce9.jpg", "failure": "no GPS"}),
]


def test_gdal_reads_layers_columns_and_types(tmp_path):
    pyogrio = pytest.importorskip("pyogrio", reason="GDAL reads what was written")
    path = tmp_path / "a.gpkg"
    write_geopackage(FEATURES, path)
    layers = {name: kind for name, kind in pyogrio.list_layers(path)}
    assert layers == {"cameras": "Point", "views": "LineString", "footprints": "Polygon"}
    meta, _, geometries, values = pyogrio.raw.read(path, layer="cameras")
    rows = dict(zip(meta["fields"], values, strict=True))
    assert meta["crs"] == "EPSG:4326"
    assert shapely.from_wkb(geometries).tolist() == [shapely.Point(7.1, 51.2), None]
    assert rows["name"].tolist() == ["a \"quoted\" 'name'.jpg", "lost \\udce9.jpg"]
    assert rows["height_m"][0] == 3.0
    assert np.isnan(rows["height_m"][1])
    assert rows["tags"][0] == '["x", 1]'
    assert rows["failure"].tolist() == [None, "no GPS"]
    bounds = pyogrio.read_info(path, layer="footprints")["total_bounds"]
    assert tuple(bounds) == (7, 51, 8, 52)


def test_it_is_the_same_again_and_no_city(tmp_path):
    for name in ("a.gpkg", "b.gpkg"):
        write_geopackage(FEATURES, tmp_path / name)
    assert (tmp_path / "a.gpkg").read_bytes() == (tmp_path / "b.gpkg").read_bytes()
    (tmp_path / "tile.gml").write_text("<CityModel/>")
    (tmp_path / "broken.gpkg").write_bytes(b"SQLite format 3\0 and nothing else")
    assert is_own_geopackage(tmp_path / "a.gpkg")
    assert not is_own_geopackage(tmp_path / "broken.gpkg")
    assert [source.path.name for source in open_sources(tmp_path)] == ["broken.gpkg", "tile.gml"]


def test_no_features_at_all_are_an_empty_layer(tmp_path):
    pyogrio = pytest.importorskip("pyogrio", reason="GDAL reads what was written")
    write_geopackage([], tmp_path / "a.gpkg")
    assert pyogrio.read_info(tmp_path / "a.gpkg")["features"] == 0


LOOK = ("heading_deg", "pitch_deg", "roll_deg")
UTM = MapFrame("EPSG:25832")
POSE = Pose.from_euler(EulerAngles(60.0, 1.5, -30.0), (281018.84, 5657451.55, 151.24))


def test_a_row_without_a_reference_system_counts_from_the_axes():
    row = survey_row(POSE, None)
    assert list(row) == list(SURVEY_COLUMNS)
    # Roll is 1.5 about the level axis ahead; the axis itself looks a little to the side of that.
    right, _, ahead = POSE.rotation
    heading, pitch = math.atan2(ahead[0], ahead[1]), math.asin(ahead[2])
    roll = math.asin(-right[2] / math.cos(pitch))
    assert [row[name] for name in LOOK] == pytest.approx(np.degrees([heading, pitch, roll]), abs=6e-4)
    assert {name for name, value in row.items() if value is None} == {
        "latitude_deg", "longitude_deg", *SIGMA_COLUMNS,
    }  # fmt: skip


def test_a_heading_counts_from_true_north():
    """Three degrees west of its central meridian, UTM's grid north is 2.3 degrees west of true north."""
    place = MapFrame("EPSG:25832").place_of(POSE)
    row = survey_row(POSE, place)
    latitude, off_meridian = math.radians(row["latitude_deg"]), math.radians(row["longitude_deg"] - 9.0)
    convergence = math.degrees(math.atan(math.tan(off_meridian) * math.sin(latitude)))
    assert row["heading_deg"] == pytest.approx(survey_row(POSE, None)["heading_deg"] + convergence, abs=0.01)
    assert convergence < -2


@given(
    st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: 0.1 < np.linalg.norm(q)),
    st.sampled_from([None, UTM]),
)
def test_a_row_given_back_with_heading_pitch_and_roll_makes_the_same_pose(quaternion, frame):
    """Through what reads a photo's metadata, whatever way the camera is turned; columns are rounded."""
    pose = Pose.from_center(Rotation.from_quat(quaternion).as_matrix(), POSE.center)
    assume(STEEP_DEG < off_nadir_deg(pose.rotation) < 180.0 - STEEP_DEG)
    row = survey_row(pose, None if frame is None else frame.place_of(pose))
    assert -90.0 <= row["pitch_deg"] <= 90.0
    photo = PhotoMetadata("a.jpg", 400, 300)
    turned = RoughPlace(**{name: row[name] for name in LOOK})
    if frame is None:
        again = pose_at(tuple(row[name] for name in list(row)[:3]), 0.0, photo, turned)
    else:
        where = {name: row[name] for name in ("latitude_deg", "longitude_deg", "height_m")}
        again = pose_from_photo(photo, frame, given=replace(turned, **where))
    error = pose_error(again, pose)
    assert error.translation_m < 0.002
    assert error.rotation_deg < 0.002


@pytest.mark.parametrize("is_triangle", [False, True])
def test_standard_deviations_are_of_their_columns(is_triangle):
    covariance = np.diag(np.arange(1.0, 7.0) ** 2)
    covariance[0, 1] = covariance[1, 0] = 0.5
    given = covariance[np.triu_indices(6)] if is_triangle else covariance
    row = survey_row(POSE, None, given)
    # A covariance has x, y, z, pitch, roll, yaw; those of the angles come from draws of whole poses.
    assert [row[name] for name in SIGMA_COLUMNS[:3]] == [1.0, 2.0, 3.0]
    draws = np.random.default_rng(1).normal(size=(20000, 3)) * (0.004, 0.005, 0.006)
    rows = [survey_row(Pose.from_euler(EulerAngles(*d), (0, 0, 0)), None) for d in draws + POSE.euler]
    spread = 1000.0 * np.std([[row[name] for name in LOOK] for row in rows], axis=0)
    assert [row[name] for name in SIGMA_COLUMNS[3:]] == pytest.approx(spread, rel=0.02)


def test_a_heading_just_west_of_north_is_no_360_degrees():
    pose = Pose.from_euler(EulerAngles(60.0, 0.0, 1e-5), (0.0, 0.0, 10.0))
    assert survey_row(pose, None)["heading_deg"] == 0.0
