"""XMP beside photos: read back by the reader of photos' own metadata, and never over another program's."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodbench.datasets.exchange.photogrammetry import write_sidecar
from lodbench.evaluation import pose_error
from lodbench.geometry import EulerAngles, Pose
from lodbench.geometry.angles import dji_from_rotation, rotation_from_dji
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.metadata import read_photo_metadata
from lodbench.photos.pose import pose_from_photo
from lodbench.photos.xmp import xmp_values
from tests.photos.dji_photo import write_photo

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
