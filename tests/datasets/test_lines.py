"""Tables with a head as poses, and raw GNSS fixes as priors: spellings, places, what is refused."""

import csv
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodbench.datasets.exchange.lines import Fix, read_fixes, table_columns
from lodbench.datasets.pose_files import brought, read_pose_file
from lodbench.datasets.prior_sources import SensorPrior
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import ConfigError, DatasetError
from lodbench.evaluation import pose_error
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.geometry.angles import look_from_rotation, rotation_from_look
from lodbench.photos.map_frame import SURVEY_COLUMNS, MapFrame, survey_row
from lodbench.photos.measurements import FRAME_M
from tests.photos.dji_photo import PROPERTIES, exif_of, write_photo, xmp_packet

CRS = "EPSG:25832+7837"
CENTER = (280_950.5, 5_657_400.25, 160.125)


def table(tmp_path, text: str):
    path = tmp_path / "rough.csv"
    path.write_text(text)
    return path


def read(tmp_path, text: str, crs: str | None = CRS) -> list:
    kind, found = read_pose_file(table(tmp_path, text), "auto")
    assert kind == "table"
    return brought(found, crs)[0]


@pytest.mark.parametrize(
    "head",
    [
        "name,lat,lon,height,heading,pitch",
        "Photo;Latitude;Longitude;Altitude (m);Yaw [deg];Pitch [deg]",
        "filename\tGPSLatitude\tGPSLongitude\theight m\tGimbalYawDegree\tGimbalPitchDegree",
        '"image","latitude_deg","longitude_deg","height_m","heading_deg","pitch_deg"',
        "imageName,lat,lng,alt,heading,pitch",
    ],
)
def test_common_spellings_of_degrees_are_the_same_pose(tmp_path, head):
    separator = next(sign for sign in ",;\t" if sign in head)
    row = separator.join(["DJI 1.JPG", "51.0261598", "5.8765601", "120.5", "83.5", "-40"])
    (found,) = read(tmp_path, f"# rough\n{head}\n{row}\n")
    assert found.name == "DJI 1.JPG"
    place = MapFrame(CRS).place_of(found.pose)
    assert place == pytest.approx((51.0261598, 5.8765601, 120.5, 83.5, -40.0, 0.0), abs=1e-7)


def test_eastings_are_the_city_s_and_headings_then_the_grid_s(tmp_path):
    text = "easting_m,northing_m,up,yaw,pitch,roll,name\n280950.5,5657400.25,160.125,83.5,-40,1.5,a.jpg\n"
    for crs in (CRS, None):
        (found,) = read(tmp_path, text, crs)
        assert found.pose.center == pytest.approx(CENTER)
        assert look_from_rotation(found.pose.rotation) == pytest.approx((83.5, -40.0, 1.5))


@pytest.mark.parametrize("is_local", [False, True])
@given(pitch=st.floats(0, 179), roll=st.floats(-60, 60), yaw=st.floats(-180, 180))
def test_lodbench_s_own_table_gives_the_same_poses_again(tmp_path_factory, is_local, pitch, roll, yaw):
    tmp_path = tmp_path_factory.mktemp("own")
    pose, frame = Pose.from_euler(EulerAngles(pitch, roll, yaw), CENTER), MapFrame(CRS)
    with table(tmp_path, "").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, ["photo", *SURVEY_COLUMNS, "crs", "failure"])
        writer.writeheader()
        place = None if is_local else frame.place_of(pose)
        writer.writerow(
            {"photo": "flight/a.jpg", **survey_row(pose, place), "crs": None if is_local else CRS}
        )
        writer.writerow({"photo": "flight/b.jpg", "failure": "9 km outside, it says"})
    (found,) = read(tmp_path, (tmp_path / "rough.csv").read_text(), None if is_local else CRS)
    error = pose_error(found.pose, pose)
    assert found.name == "flight/a.jpg"
    assert error.translation_m < 0.003
    assert error.rotation_deg < 0.002 or abs(pitch - 178) < 2  # looking straight up


@given(pitch=st.floats(0, 4), roll=st.floats(-4, 4), yaw=st.floats(-180, 180))
def test_angles_near_straight_down_are_taken_back(pitch, roll, yaw):
    pose = Pose.from_euler(EulerAngles(pitch, roll, yaw), CENTER)
    again = rotation_from_look(*look_from_rotation(pose.rotation))
    assert again == pytest.approx(pose.rotation, abs=1e-9)


HEAD = "name,lat,lon,height,heading,pitch"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("name,lat,lon,heading\na.jpg,51,6,0\n", "line 1: there is no column for height, pitch."),
        ("lat,lon,height,heading,pitch\n51,6,1,0,0\n", "line 1: there is no column for name."),
        ("name,lat,height,heading,pitch\na.jpg,51,1,0,0\n", "line 1: there is no column for lon."),
        (f"{HEAD},yaw\na.jpg,51,6,1,0,0,0\n", "line 1: several columns hold heading."),
        (f"{HEAD}\na.jpg,51,6,,0,0\n", "line 2: height is missing."),
        (f"{HEAD}\na.jpg,51,6,1,0\n", "line 2: pitch is missing."),
        (f"{HEAD}\n,51,6,1,0,0\n", "line 2: name is missing."),
        (f"{HEAD}\na.jpg,51,6,high,0,0\n", "line 2: height is 'high', no number."),
        (f"{HEAD}\na.jpg,51,6,1,nan,0\n", "line 2: heading nan is not finite."),
        (f"{HEAD}\na.jpg,510,6,1,0,0\n", "line 2: lat 510 is not in -90 to 90."),
        (f"{HEAD}\na,b.jpg,51,6,1,0,0\n", "line 2: 7 values for 6 columns."),
        (f"{HEAD}\n", "holds no poses."),
    ],
)
def test_what_is_missing_or_no_number_is_one_line(tmp_path, text, words):
    with pytest.raises(DatasetError) as fault:
        read(tmp_path, text)
    assert words in fault.value.message
    assert "\n" not in fault.value.message


def test_degrees_are_nowhere_in_a_city_without_a_system(tmp_path):
    with pytest.raises(DatasetError, match="line 2: latitude and longitude are nowhere") as fault:
        read(tmp_path, f"{HEAD}\na.jpg,51,6,1,0,0\n", None)
    assert "--crs" in fault.value.hint


def test_lines_of_numbers_are_no_head():
    assert table_columns("a.jpg 1 0 0 0 1 2 3") == []
    assert table_columns("imageName X Y Z Omega Phi Kappa") == []


PLANE = "EPSG:25832"
CSV = (
    "name,latitude,longitude,height,sigma_east,sigma_north,sigma_up\n"
    "a.jpg,51.0479,9.0690,210.5,2.5,3.5,6.0\n"
    "b.jpg,51.0480,9.0691,,,,\n"
)
GPX = """<?xml version="1.0"?><gpx xmlns="http://www.topografix.com/GPX/1/1" version="1.1">
<wpt lat="51.0479" lon="9.0690"><ele>210.5</ele><name>a.jpg</name></wpt>
<trk><trkseg><trkpt lat="51.0480" lon="9.0691"><name>b.jpg</name></trkpt></trkseg></trk></gpx>"""
LOOK = Pose.from_euler(EulerAngles(40.0, 2.0, 15.0), (1.0, 2.0, 3.0))


def written(folder, text, name="fixes.csv"):
    path = folder / name
    path.write_text(text)
    return path


def dataset_of(folder, image=None) -> Dataset:
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    entries = tuple(Entry(f"{letter}.jpg", "all", camera, LOOK, image, None, (LOOK,)) for letter in "abc")
    return Dataset(
        "d", "", folder, None, None, ("all",), entries, {}, photo_crs=PLANE, photo_origin=(0.0, 0.0, 0.0)
    )


def test_both_files_say_the_same(tmp_path):
    by_table = read_fixes(written(tmp_path, CSV))
    by_points = read_fixes(written(tmp_path, GPX, "fixes.GPX"))
    assert by_table["a.jpg"] == Fix(51.0479, 9.069, 210.5, (2.5, 3.5, 6.0))
    assert by_table["b.jpg"] == by_points["b.jpg"] == Fix(51.048, 9.0691, None, (None,) * 3)
    assert by_points["a.jpg"][:3] == by_table["a.jpg"][:3]


def test_the_prior_is_the_fix_with_its_own_deviation_and_the_angles_of_before(tmp_path):
    prior = SensorPrior(fixes=str(written(tmp_path, CSV)), fix_sigma_m=4.0)
    found = prior.apply(dataset_of(tmp_path), 0)
    first, second, third = found.entries
    east, north = MapFrame(PLANE).east_north(51.0479, 9.069)
    np.testing.assert_allclose(first.prior.center, [east, north, 210.5], atol=1e-6)
    np.testing.assert_allclose(first.prior.rotation, LOOK.rotation, atol=1e-12)
    expected = [math.hypot(sigma, FRAME_M) for sigma in (2.5, 3.5, 6.0)]
    np.testing.assert_allclose(first.measured.sigmas[:3], expected)
    # Without a photo nobody says how high the second was; the third has no fix.
    assert (second.prior, third.prior) == (None, None)
    assert any("no fix of c.jpg" in item.detail for item in found.findings)
    assert "raw fixes" in prior.describe()


def test_a_photo_adds_its_angles_and_a_height_that_a_fix_lacks(tmp_path):
    photo = write_photo(tmp_path / "p.jpg", exif=exif_of(), xmp=xmp_packet(PROPERTIES))
    prior = SensorPrior(fixes=str(written(tmp_path, CSV)), fix_sigma_m=4.0)
    second = prior.apply(dataset_of(tmp_path, photo), 0).entries[1]
    assert second.prior.center[2] == pytest.approx(203.41)
    sigma = math.hypot(4.0, FRAME_M)
    assert second.measured.sigmas[:3] == pytest.approx((sigma, sigma, None))
    assert not np.allclose(second.prior.rotation, LOOK.rotation, atol=0.1)
    assert second.measured.takeoff_height_m == 80.1


@pytest.mark.parametrize(
    ("text", "name", "said"),
    [
        ("name,latitude\n", "f.csv", "one column longitude"),
        ("name,latitude,longitude\n", "f.csv", "holds no fixes"),
        (CSV + "a.jpg,51,9,1,,,\n", "f.csv", "the name a.jpg occurs twice"),
        (CSV + "c.jpg,99,9,1,,,\n", "f.csv", "latitude 99 is not within"),
        (CSV + "c.jpg,51,9,nan,,,\n", "f.csv", "height nan is not within"),
        (CSV + "c.jpg,51,9,1,-2,,\n", "f.csv", "sigma_east -2 is not within"),
        (CSV + "c.jpg,51,,1,,,\n", "f.csv", "latitude or longitude is missing"),
        (CSV + ",51,9,1,,,\n", "f.csv", "name is missing"),
        (GPX.replace("<name>b.jpg</name>", ""), "f.gpx", "name is missing"),
        (GPX[:-20], "f.gpx", "f.gpx"),
        ('<!DOCTYPE gpx [<!ENTITY a "b">]>' + GPX[21:], "f.gpx", "DOCTYPE"),
    ],
)
def test_damaged_files_are_refused_in_one_line(tmp_path, text, name, said):
    with pytest.raises(DatasetError) as fault:
        read_fixes(written(tmp_path, text, name))
    assert said in str(fault.value)
    assert "\n" not in str(fault.value)


def test_a_deviation_of_nothing_is_a_fault():
    with pytest.raises(ConfigError, match="fix_sigma_m"):
        SensorPrior(fix_sigma_m=0.0)
