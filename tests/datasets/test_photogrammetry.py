"""Metashape's, Pix4D's and ODM's text: their own numbers, there and back, and what is not meant."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import CRS

from lodbench.datasets.exchange.photogrammetry import (
    read_metashape,
    read_odm,
    read_pix4d,
    write_metashape,
    write_odm,
    write_pix4d,
    write_sidecar,
)
from lodbench.datasets.pose_files import read_pose_file
from lodbench.datasets.pose_text import FoundPose
from lodbench.errors import DatasetError
from lodbench.evaluation import pose_error
from lodbench.geometry import EulerAngles, Pose
from lodbench.geometry.angles import dji_from_rotation, rotation_from_dji
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.metadata import read_photo_metadata
from lodbench.photos.pose import pose_from_photo
from lodbench.photos.xmp import xmp_values
from tests.photos.dji_photo import write_photo

CENTER = (280_950.5, 5_657_400.25, 160.125)
# `Metashape.Utils.ypr2mat(Metashape.Vector((30, 91, 0)))`, as Metashape prints it.
METASHAPE_30_91_0 = [
    [0.8660254037844387, -0.008726203218641737, -0.4999238475781956],
    [-0.49999999999999994, -0.01511422733185856, -0.8658935039207541],
    [0.0, 0.9998476951563913, -0.017452406437283477],
]
WRITERS = {
    "metashape": lambda images, path: write_metashape(images, path, "EPSG:25832+7837"),
    "pix4d": write_pix4d,
    "odm": lambda images, path: write_odm(images, path, "EPSG:25832+7837"),
}
HEAD = "#Label,X/Easting,Y/Northing,Z/Altitude,Yaw,Pitch,Roll"


def turn(axis: int, degrees: float) -> np.ndarray:
    """Returns the right-handed turn about an axis, written out."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix = np.eye(3)
    a, b = [(1, 2), (2, 0), (0, 1)][axis]
    matrix[a, a] = matrix[b, b] = c
    matrix[a, b], matrix[b, a] = -s, s
    return matrix


def photo_axes(pose: Pose) -> np.ndarray:
    """Returns right, top and back of a picture in east, north and up, as columns."""
    right, down, ahead = pose.rotation
    return np.column_stack([right, -down, -ahead])


def metashape_file(tmp_path, rows: str, head: str = HEAD, system: str = "PROJCS[...]"):
    path = tmp_path / "reference.txt"
    path.write_text(f"#CoordinateSystem: {system}\n#Cameras (1)\n{head}\n{rows}")
    return path


def test_metashape_s_angles_are_those_of_its_own_function(tmp_path):
    (found,) = read_metashape(metashape_file(tmp_path, "a.jpg,280950.5,5657400.25,160.125,30,91,0\n"))
    assert found.name == "a.jpg"
    assert found.pose.center == pytest.approx(CENTER)
    assert photo_axes(found.pose) == pytest.approx(np.array(METASHAPE_30_91_0), abs=1e-15)
    # The same orientation by other angles, from the same source.
    (again,) = read_metashape(metashape_file(tmp_path, "a.jpg,0,0,0,210,89,180\n"))
    assert photo_axes(again.pose) == pytest.approx(np.array(METASHAPE_30_91_0), abs=1e-15)


@pytest.mark.parametrize("crs", ["EPSG:6247+5778", "EPSG:5516", "EPSG:6201", None])
def test_a_system_that_old_wkt_has_no_words_for_is_left_to_be_chosen(tmp_path, crs):
    # Bogota's own grid is an oblique plane that only newer forms of WKT have.
    image = FoundPose("a.jpg", "", Pose.from_euler(EulerAngles(31.0, 0.2, -40.0), CENTER))
    write_metashape([image], tmp_path / "reference.txt", crs)
    assert (tmp_path / "reference.txt").read_text().startswith("#Label,")
    assert read_pose_file(tmp_path / "reference.txt", "auto")[0] == "metashape"


def test_a_line_of_pix4d_s_that_is_cut_off_is_named(tmp_path):
    (tmp_path / "p.txt").write_text("imageName X Y Z Omega Phi Kappa\na.jpg 1 2 3 4 5\n")
    with pytest.raises(DatasetError, match="line 2: 6 values are too few"):
        list(read_pix4d(tmp_path / "p.txt"))


@pytest.mark.parametrize("name", ["DJI 0001.JPG", "IMG 0001", "Flug über Köln 2.jpg"])
@pytest.mark.parametrize("separator", [" ", ",", "\t"])
def test_names_with_spaces_in_pix4d_s_parameters(tmp_path, name, separator):
    words = [name, "280950.5", "5657400.25", "160.125", "1", "2", "3"]
    (tmp_path / "p.txt").write_text(f"imageName X Y Z Omega Phi Kappa\n{separator.join(words)}\n")
    (found,) = read_pix4d(tmp_path / "p.txt")
    assert found.name == name
    assert found.pose.center == pytest.approx(CENTER)


def test_odm_is_given_a_code_that_it_knows(tmp_path):
    image = FoundPose("a.jpg", "", Pose.from_euler(EulerAngles(31.0, 0.2, -40.0), CENTER))
    write_odm([image], tmp_path / "geo.txt", "IGNF:LAMB93")
    assert (tmp_path / "geo.txt").read_text().startswith("EPSG:2154\n")


def test_metashape_s_estimates_go_before_its_source_and_markers_are_no_cameras(tmp_path):
    head = f"{HEAD},Error_(m),X_est,Y_est,Z_est,Yaw_est,Pitch_est,Roll_est"
    rows = (
        "a.jpg,1,2,3,4,5,6,0.1,280950.5,5657400.25,160.125,30,91,0\n"
        "unaligned.jpg,1,2,3,4,5,6,,,,,,,\n"
        "#Markers (1)\n#Label,X/Easting\npoint 1,7\n"
    )
    (found,) = read_metashape(metashape_file(tmp_path, rows, head))
    assert found.pose.center == pytest.approx(CENTER)
    assert photo_axes(found.pose) == pytest.approx(np.array(METASHAPE_30_91_0), abs=1e-15)


@pytest.mark.parametrize(
    ("name", "crs"),
    [("EPSG:25833", "EPSG:25833"), ("EPSG:25832+7837", "EPSG:25832"), ("EPSG:32632+5773", "EPSG:32632")],
)
def test_metashape_s_system_goes_along(tmp_path, name, crs):
    system = CRS(name).to_wkt("WKT1_GDAL")
    (found,) = read_metashape(metashape_file(tmp_path, "a.jpg,1,2,3,4,5,6\n", system=system))
    assert found.crs == crs


@pytest.mark.parametrize("system", ["PROJCS[...]", 'LOCAL_CS["Local Coordinates (m)"]'])
def test_local_coordinates_of_metashape_s_name_no_system(tmp_path, system):
    (found,) = read_metashape(metashape_file(tmp_path, "a.jpg,1,2,3,4,5,6\n", system=system))
    assert found.crs is None


@pytest.mark.parametrize(
    ("head", "crs"),
    [
        ("EPSG:23032", "EPSG:23032"),
        ("WGS84 UTM 32N", "EPSG:32632"),
        ("WGS84 UTM 5S", "EPSG:32705"),
        ("+proj=utm +zone=33 +ellps=GRS80 +units=m +no_defs", "EPSG:25833"),
    ],
)
def test_odm_s_system_goes_along(tmp_path, head, crs):
    (tmp_path / "geo.txt").write_text(f"{head}\na.jpg 280950.5 5657400.25 160.125 1 2 3\n")
    (found,) = read_odm(tmp_path / "geo.txt")
    assert found.crs == crs


@pytest.mark.parametrize("read", [read_pix4d, read_odm])
def test_omega_phi_kappa_turn_the_axes_one_after_another(tmp_path, read):
    path = tmp_path / "geo.txt"
    head = "EPSG:25832" if read is read_odm else "imageName X Y Z Omega Phi Kappa"
    path.write_text(f"{head}\na.jpg 280950.5 5657400.25 160.125 12.5 -33.25 141.0\n")
    (found,) = read(path)
    assert photo_axes(found.pose) == pytest.approx(turn(0, 12.5) @ turn(1, -33.25) @ turn(2, 141.0))
    assert found.pose.center == pytest.approx(CENTER)


@pytest.mark.parametrize("format_name", sorted(WRITERS))
@given(pitch=st.floats(-89, 89), roll=st.floats(-80, 80), yaw=st.floats(-180, 180))
def test_there_and_back(tmp_path_factory, format_name, pitch, roll, yaw):
    path = tmp_path_factory.mktemp("there") / "poses.txt"
    pose = Pose.from_euler(EulerAngles(pitch, roll, yaw), CENTER)
    WRITERS[format_name]([FoundPose("a.jpg", "", pose)], path)
    # Which format it is shows.
    kind, (found,) = read_pose_file(path, "auto")
    assert kind == format_name
    assert found.name == "a.jpg"
    assert found.pose.center == pytest.approx(CENTER, abs=1e-8)
    assert found.pose.rotation == pytest.approx(pose.rotation, abs=1e-9)


def test_straight_down_with_north_on_top_all_angles_are_zero(tmp_path):
    pose = Pose.from_euler(EulerAngles(0, 0, 0), CENTER)
    for name, write in WRITERS.items():
        write([FoundPose("a.jpg", "", pose)], tmp_path / name)
        cells = (tmp_path / name).read_text().splitlines()[-1].replace(",", " ").split()
        assert [float(cell) for cell in cells[-3:]] == pytest.approx([0, 0, 0], abs=1e-12)


def test_odm_s_first_line_is_the_plane_s_code(tmp_path):
    pose = Pose.from_euler(EulerAngles(0, 0, 0), CENTER)
    write_odm([FoundPose("a.jpg", "", pose)], tmp_path / "geo.txt", "EPSG:25832+7837")
    assert (tmp_path / "geo.txt").read_text().startswith("EPSG:25832\n")
    with pytest.raises(DatasetError, match="names a reference system"):
        write_odm([FoundPose("a.jpg", "", pose)], tmp_path / "geo.txt", None)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("#Label,X/Longitude,Y/Latitude,Z/Altitude,Yaw,Pitch,Roll\na.jpg,6,51,100,0,0,0\n", "in degrees"),
        ("#Label,X/Easting,Y/Northing,Z/Altitude\na.jpg,6,51,100\n", "yaw"),
        (f"{HEAD}\na.jpg,6,51,100,0,0,nan\n", "not finite"),
        (f"{HEAD}\na.jpg,6,51,100\n", "line 2: 4 values are too few"),
        ("EPSG:4326\na.jpg 6 51 100 0 0 0\n", "has degrees"),
        ("EPSG:25832\na.jpg 6 51 100\n", "no angles"),
        ("EPSG:999999\na.jpg 6 51 100 0 0 0\n", "names no reference system"),
        ("#imagename,x,y,z,yaw,pitch,roll\na.jpg,6,51,100,0,0,0\n", "no omega, phi and kappa"),
        ("imageName X Y Z Omega Phi Kappa\na.jpg 6 51 x 0 0 0\n", "could not convert"),
    ],
)
def test_what_is_not_meant_is_reported(tmp_path, text, word):
    path = tmp_path / "poses.txt"
    path.write_text(text)
    with pytest.raises(DatasetError, match=word):
        read_pose_file(path, "auto")


FRAME = MapFrame("EPSG:25832+7837")


@given(st.floats(-180, 180), st.floats(-90, 30), st.floats(-20, 20), st.floats(-3, 3))
def test_a_gimbal_s_angles_make_the_same_rotation_again(yaw, pitch, roll, convergence):
    rotation = rotation_from_dji(yaw, pitch, roll, convergence)
    again = rotation_from_dji(*dji_from_rotation(rotation, convergence), convergence)
    assert again == pytest.approx(rotation, abs=1e-9)


@pytest.mark.parametrize("angles", [(0.0, 0.0, 40.0), (35.0, 0.6, -120.0), (75.0, -2.0, 170.0)])
@pytest.mark.parametrize("height", [146.02, -3.5])
def test_a_sidecar_says_the_pose(tmp_path, angles, height):
    pose = Pose.from_euler(EulerAngles(*angles), (281031.0, 5657482.28, height))
    photo = tmp_path / "DJI_0001.JPG"
    write_photo(photo)
    before = photo.read_bytes()
    path = write_sidecar(photo, pose, FRAME)
    assert path == tmp_path / "DJI_0001.xmp"
    assert photo.read_bytes() == before
    stated = read_photo_metadata(photo)
    for name, value in xmp_values(path, path.read_bytes())[0].items():
        object.__setattr__(stated, name, value)
    found = pose_from_photo(stated, FRAME)
    error = pose_error(found, pose)
    assert error.translation_m < 0.01
    assert error.rotation_deg < 0.01


def test_the_direction_of_the_picture_is_that_of_the_optical_axis(tmp_path):
    """Of a camera turned about it by two thirds of a right angle and a right angle, too."""
    east, north = 281031.0, 5657482.28
    turned = rotation_from_dji(167.07, -63.0, -120.6, FRAME.convergence_deg(east, north))
    path = write_sidecar(tmp_path / "a.JPG", Pose.from_center(turned, (east, north, 146.0)), FRAME)
    assert path is not None
    assert 'exif:GPSImgDirection="16707/100"' in path.read_text()
    assert 'drone-dji:GimbalYawDegree="+167.0700"' in path.read_text()


def test_another_program_s_sidecar_is_left_alone_and_one_s_own_is_not(tmp_path):
    pose = Pose.from_euler(EulerAngles(30.0, 0.0, 0.0), (281031.0, 5657482.28, 146.0))
    theirs = tmp_path / "a.xmp"
    theirs.write_text("<x:xmpmeta>stars</x:xmpmeta>")
    assert write_sidecar(tmp_path / "a.JPG", pose, FRAME) is None
    assert "stars" in theirs.read_text()
    own = write_sidecar(tmp_path / "b.JPG", pose, FRAME)
    assert own is not None
    before = own.read_text()
    assert write_sidecar(tmp_path / "b.JPG", pose.shifted((5.0, 0.0, 0.0)), FRAME) == own
    assert own.read_text() != before
    # Stars that another program put into it are not lost.
    own.write_text(own.read_text().replace("<rdf:Description ", '<rdf:Description xmp:Rating="5" '))
    assert write_sidecar(tmp_path / "b.JPG", pose, FRAME) is None
    assert 'xmp:Rating="5"' in own.read_text()


def test_minutes_are_never_sixty(tmp_path):
    # 7 degrees less than a ten-millionth of a minute.
    east, north = FRAME.east_north(51.0, 7.0 - 1e-12)
    path = write_sidecar(tmp_path / "a.JPG", Pose.from_euler(EulerAngles(0, 0, 0), (east, north, 9.0)), FRAME)
    assert path is not None
    assert ",60.0" not in path.read_text()
