import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodbench.datasets.pose_text import (
    format_camera,
    format_pose,
    lines_to_text,
    read_cameras,
    read_poses,
    read_words,
)
from lodbench.errors import DatasetError
from lodbench.geometry import Camera, EulerAngles, Pose

GOOD = "a.jpg 1 0 0 0 1 2 3\n"
# The drone photo of the published demo: its line and its 4x4 camera-to-world matrix name one pose.
THERMAL = "DJI_20230513163714_0033_T.png"


def write(folder, text, name="GT_pose.txt"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


class TestReadPoses:
    def test_a_line_is_world_to_camera(self, tmp_path):
        half = np.sqrt(0.5)
        pose = read_poses(write(tmp_path, f"a.jpg {half} 0 0 {half} 1 2 3\n"))["a.jpg"]
        np.testing.assert_allclose(pose.rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)
        np.testing.assert_allclose(pose.center, [-2, 1, -3], atol=1e-15)

    def test_empty_lines_comments_and_a_byte_order_mark_are_skipped(self, tmp_path):
        path = write(tmp_path, "\ufeff# poses\n\n   \n" + GOOD + "  # end\n")
        assert list(read_poses(path)) == ["a.jpg"]

    def test_windows_line_ends_tabs_and_many_blanks(self, tmp_path):
        assert list(read_poses(write(tmp_path, "a.jpg\t1 0 0  0 1 2 3 \r\nb.jpg 1 0 0 0 1 2 3\r\n"))) == [
            "a.jpg",
            "b.jpg",
        ]

    def test_folders_before_the_name_are_dropped(self, tmp_path):
        poses = read_poses(write(tmp_path, "query/a.jpg 1 0 0 0 1 2 3\ndb/x/b.jpg 1 0 0 0 1 2 3\n"))
        assert list(poses) == ["a.jpg", "b.jpg"]

    def test_an_empty_file_holds_no_poses(self, tmp_path):
        assert read_poses(write(tmp_path, "")) == {}

    @pytest.mark.parametrize(
        ("line", "reason"),
        [
            ("b.jpg 1 0 0 0 1 2", "6 values"),
            ("b.jpg 1 0 0 0 1 2 3 4", "8 values"),
            ("b.jpg", "0 values"),
            ("my photo.jpg 1 0 0 0 1 2 3", "8 values"),
            ("b.jpg 1 0 0 zero 1 2 3", "zero"),
            ("b.jpg 1 0 0 0 1 nan 3", "finite"),
            ("b.jpg 1 0 0 0 inf 2 3", "finite"),
            ("b.jpg 1 0 0 0 1e9 2 3", r"1e\+09 m is beyond 1e\+08 m"),
            ("b.jpg 1 0 0 0 1 -1.1e8 3", r"-1\.1e\+08 m is beyond"),
            ("b.jpg 1 0 0 0 1 2 1e300", r"1e\+300 m is beyond"),
            ("b.jpg nan 0 0 0 1 2 3", "finite"),
            ("b.jpg 1 0 0 0.1 1 2 3", "length"),
            ("b.jpg 0 0 0 0 1 2 3", "length"),
            ("a.jpg 1 0 0 0 1 2 3", "a.jpg occurs twice"),
            ("query/a.jpg 1 0 0 0 1 2 3", "a.jpg occurs twice"),
        ],
    )
    def test_a_malformed_line_is_named(self, tmp_path, line, reason):
        with pytest.raises(DatasetError, match=f"line 3: .*{reason}") as caught:
            read_poses(write(tmp_path, "# head\n" + GOOD + line + "\n" + GOOD))
        assert "GT_pose.txt" in str(caught.value)
        assert "qw qx qy qz" in caught.value.hint

    def test_a_missing_file(self, tmp_path):
        path = tmp_path / "nowhere.txt"
        for read, needed in ((read_poses, "qw qx qy qz"), (read_cameras, "PINHOLE")):
            with pytest.raises(DatasetError) as caught:
                read(path)
            assert str(caught.value) == f"{path} cannot be read: No such file or directory."
            assert needed in caught.value.hint

    def test_text_in_another_encoding(self, tmp_path):
        path = tmp_path / "GT_pose.txt"
        path.write_bytes("Zürich.jpg 1 0 0 0 1 2 3\n".encode("cp1252"))
        with pytest.raises(DatasetError, match=r"cannot be read: it is no UTF-8 text\.$") as caught:
            read_poses(path)
        assert "UTF-8" in caught.value.hint

    def test_the_largest_coordinate_is_read(self, tmp_path):
        assert list(read_poses(write(tmp_path, "a.jpg 1 0 0 0 1e8 -1e8 3\n"))) == ["a.jpg"]

    def test_a_folder_and_a_binary_file_are_no_text(self, tmp_path):
        (tmp_path / "binary.txt").write_bytes(b"\xff\xfe\x00\x81")
        for path in (tmp_path, tmp_path / "binary.txt"):
            with pytest.raises(DatasetError, match="cannot be read"):
                read_poses(path)

    def test_the_real_file(self, shared_data):
        demo = shared_data / "uavd4l" / "demo"
        truth, prior = (read_poses(demo / name)[THERMAL] for name in ("GT_pose.txt", "GPS_pose.txt"))
        np.testing.assert_allclose(truth.euler, (0.33, 0.82, 102.50), atol=0.005)
        offset = prior.center - truth.center
        np.testing.assert_allclose(offset, (-4.27, 0.33, 20.66), atol=0.005)


class TestReadCameras:
    def test_the_real_file(self, shared_data):
        cameras = read_cameras(shared_data / "uavd4l" / "demo" / "intrinsic.txt")
        assert cameras[THERMAL] == Camera(640, 512, 1125.0, 1125.0, 320.0, 256.0)

    @pytest.mark.parametrize(
        ("line", "reason"),
        [
            ("b.jpg PINHOLE 640", "too few"),
            ("b.jpg PINHOLE 640 512 1 1 1", "takes 4 parameters"),
            ("b.jpg PINHOLE 640.5 512 1 1 1 1", "640.5"),
            ("b.jpg PINHOLE 640 512 f 1 1 1", "f"),
            ("b.jpg PINHOLE 640 512 nan 1 1 1", "."),
            ("b.jpg PINHOLE 640 -1 1 1 1 1", "positive"),
            ("b.jpg FISHY 640 512 1 1 1 1", "FISHY"),
            ("a.jpg PINHOLE 640 512 1 1 1 1", "twice"),
        ],
    )
    def test_a_malformed_line_is_named(self, tmp_path, line, reason):
        with pytest.raises(DatasetError, match=f"line 2: .*{reason}"):
            read_cameras(write(tmp_path, "db/a.jpg PINHOLE 640 512 9 9 3 2\n" + line + "\n"))


class TestFormat:
    @given(
        st.floats(-170, 170), st.floats(-80, 80), st.floats(-170, 170), st.tuples(*[st.floats(-1e6, 1e6)] * 3)
    )
    def test_a_line_restores_its_pose(self, tmp_path_factory, pitch, roll, yaw, center):
        pose = Pose.from_euler(EulerAngles(pitch, roll, yaw), center)
        path = write(tmp_path_factory.getbasetemp(), lines_to_text([format_pose("a.jpg", pose)]))
        again = read_poses(path)["a.jpg"]
        np.testing.assert_allclose(again.rotation, pose.rotation, atol=1e-14)
        np.testing.assert_array_equal(again.translation, pose.translation)
        np.testing.assert_allclose(again.cam_from_world[:3, :3], pose.cam_from_world[:3, :3], atol=1e-12)

    def test_the_real_line_restores_the_real_matrix(self, shared_data, tmp_path):
        pose = read_poses(shared_data / "uavd4l" / "demo" / "GT_pose.txt")[THERMAL]
        again = read_poses(write(tmp_path, lines_to_text([format_pose(THERMAL, pose)])))[THERMAL]
        np.testing.assert_allclose(again.world_from_cam, pose.world_from_cam, rtol=0, atol=1e-12)
        matrix = Pose.from_matrix(np.linalg.inv(pose.world_from_cam))
        np.testing.assert_allclose(matrix.cam_from_world, pose.cam_from_world, rtol=0, atol=1e-12)

    def test_a_camera_line_restores_its_camera(self, tmp_path):
        camera = Camera(5280, 3956, 3778.423, 3767.392, 2663.624, 1919.721)
        assert (
            read_cameras(write(tmp_path, lines_to_text([format_camera("a.jpg", camera)])))["a.jpg"] == camera
        )


@pytest.mark.parametrize(
    ("line", "told"), [("a.jpg one two", "2 words"), ("a.jpg ../up", "no plain name"), ("a.jpg ..", "plain")]
)
def test_the_flight_of_a_photo_is_one_plain_name(tmp_path, line, told):
    path = tmp_path / "sequences.txt"
    path.write_text(f"b.jpg morning\n{line}\n")
    with pytest.raises(DatasetError, match=f"line 2.*{told}"):
        read_words(path)
    path.write_text("b.jpg morning\n")
    assert read_words(path) == {"b.jpg": "morning"}
