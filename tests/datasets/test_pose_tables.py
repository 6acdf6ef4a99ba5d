"""Tables with a head as poses: spellings, both kinds of places, lodbench's own table, and what is refused."""

import csv

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodbench.datasets.exchange.lines import table_columns
from lodbench.datasets.pose_files import brought, read_pose_file
from lodbench.errors import DatasetError
from lodbench.evaluation import pose_error
from lodbench.geometry import EulerAngles, Pose
from lodbench.geometry.angles import look_from_rotation, rotation_from_look
from lodbench.photos.map_frame import SURVEY_COLUMNS, MapFrame, survey_row

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
