"""Every format there and back, and against the programs the formats come from where they are installed."""

import json
import struct

import cv2
import numpy as np
import pytest

from lodbench.datasets.exchange.colmap import read_colmap, write_colmap
from lodbench.datasets.exchange.kapture_nerfstudio import (
    read_kapture,
    read_nerfstudio,
    write_kapture,
    write_nerfstudio,
)
from lodbench.datasets.exchange.lines import read_lines, read_tum, write_lines, write_tum
from lodbench.datasets.own import images_from_poses, write_dataset
from lodbench.datasets.pose_files import read_pose_file
from lodbench.datasets.pose_text import FoundPose
from lodbench.errors import DatasetError
from lodbench.geometry import Camera, EulerAngles, Pose

PINHOLE = Camera(640, 480, 500.5, 501.25, 321.0, 238.5)
LENSES = [
    PINHOLE,
    PINHOLE,
    Camera(640, 480, 500.5, 501.25, 321.0, 238.5, (-0.26, 0.11, 0.001, -0.002)),
    Camera(640, 480, 500.5, 501.25, 321.0, 238.5, (0.05, -0.01, 0.003, -0.002), "OPENCV_FISHEYE"),
    Camera(
        640, 480, 500.5, 501.25, 321.0, 238.5, (-0.26, 0.11, 0.001, -0.002, -0.03, 0, 0, 0), "FULL_OPENCV"
    ),
]


def images(spaces: bool = False) -> list[FoundPose]:
    """Returns posed images at map coordinates, with every kind of lens all formats can hold."""
    generator = np.random.default_rng(11)
    return [
        FoundPose(
            f"flight a/DJI_{i:03d}.JPG" if spaces else f"DJI_{i:03d}.JPG",
            "",
            Pose.from_euler(
                EulerAngles(*generator.uniform([0, -5, -180], [90, 5, 180])),
                generator.uniform([280000, 5657000, 100], [281000, 5658000, 300]),
            ),
            LENSES[i % len(LENSES)],
        )
        for i in range(7)
    ]


FORMATS = {
    "lines": (write_lines, read_lines, "poses.txt", False),
    "tum": (write_tum, read_tum, "poses.tum", False),
    "colmap": (write_colmap, read_colmap, "model", True),
    "kapture": (write_kapture, read_kapture, "kapture", True),
    "nerfstudio": (write_nerfstudio, read_nerfstudio, "transforms.json", True),
}


@pytest.mark.parametrize("name", FORMATS)
def test_there_and_back(tmp_path, name):
    write, read, file, has_cameras = FORMATS[name]
    given = images(spaces=name != "lines")
    write(given, tmp_path / file)
    found = list(read(tmp_path / file))
    assert [image.name for image in found] == [image.name for image in given]
    for image, original in zip(found, given, strict=True):
        if has_cameras:
            assert image.camera == original.camera
        np.testing.assert_allclose(image.pose.rotation, original.pose.rotation, atol=1e-14)
        if name in ("lines", "colmap", "kapture"):
            np.testing.assert_array_equal(image.pose.translation, original.pose.translation)
        # Rounding of coordinates of 5,600 km is 1e-9 m.
        np.testing.assert_allclose(image.pose.center, original.pose.center, rtol=0, atol=5e-9)


@pytest.mark.parametrize("name", FORMATS)
def test_an_empty_list(tmp_path, name):
    write, read, file, _ = FORMATS[name]
    write([], tmp_path / file)
    assert list(read(tmp_path / file)) == []


@pytest.mark.parametrize(
    ("name", "letter"), [("lines", " "), ("kapture", ","), ("colmap", "\n"), ("tum", "\n")]
)
def test_names_a_format_cannot_hold_are_refused(tmp_path, name, letter):
    write, _, file, _ = FORMATS[name]
    odd = images()[0]._replace(name=f"a{letter}b.jpg")
    with pytest.raises(DatasetError, match="cannot be written"):
        write([odd], tmp_path / file)
    assert not list(tmp_path.rglob("*.txt"))


@pytest.mark.parametrize("name", FORMATS)
def test_two_images_of_one_name_are_refused(tmp_path, name):
    write, _, file, _ = FORMATS[name]
    with pytest.raises(DatasetError, match="Two images"):
        write([images()[0]] * 2, tmp_path / file)


@pytest.fixture(scope="module")
def pycolmap():
    return pytest.importorskip("pycolmap")


class TestColmap:
    def test_pycolmap_reads_what_we_write(self, tmp_path, pycolmap):
        given = images()
        write_colmap(given, tmp_path)
        model = pycolmap.Reconstruction(str(tmp_path))
        theirs = {image.name: image for image in model.images.values()}
        assert set(theirs) == {image.name for image in given}
        assert len(model.cameras) == len(LENSES) - 1  # the pinhole is shared
        for image in given:
            other = theirs[image.name]
            assert image.camera is not None
            matrix = other.cam_from_world().matrix()
            np.testing.assert_allclose(matrix, image.pose.cam_from_world[:3], rtol=1e-12, atol=1e-12)
            points = np.array([[0.5, -0.4, 3.0], [-0.2, 0.3, 1.5]])
            pixels = model.cameras[other.camera_id].img_from_cam(points)
            np.testing.assert_allclose(pixels, image.camera.project(points), atol=1e-9)

    @pytest.mark.parametrize("is_binary", [True, False])
    def test_we_read_what_pycolmap_writes(self, tmp_path, pycolmap, is_binary):
        given = images()
        write_colmap(given, tmp_path)
        model = pycolmap.Reconstruction(str(tmp_path))
        # A point and its observations, which lie between the images in the file.
        for image in model.images.values():
            image.points2D = pycolmap.Point2DList([pycolmap.Point2D(np.array([1.5, 2.5]))] * 3)
        out = tmp_path / "theirs"
        out.mkdir()
        (model.write_binary if is_binary else model.write_text)(str(out))
        assert (out / "images.bin").is_file() == is_binary
        found = {image.name: image for image in read_colmap(out)}
        for image in given:
            other = found[image.name]
            assert other.camera == image.camera
            np.testing.assert_allclose(other.pose.rotation, image.pose.rotation, atol=1e-12)
            np.testing.assert_allclose(other.pose.center, image.pose.center, rtol=0, atol=2e-8)

    def test_a_binary_model_cut_off_anywhere_is_an_error(self, tmp_path, pycolmap):
        write_colmap(images()[:2], tmp_path)
        pycolmap.Reconstruction(str(tmp_path)).write_binary(str(tmp_path))
        whole = (tmp_path / "images.bin").read_bytes()
        for length in range(0, len(whole), 7):
            (tmp_path / "images.bin").write_bytes(whole[:length])
            with pytest.raises(DatasetError, match=r"images\.bin"):
                list(read_colmap(tmp_path))

    def test_a_count_of_points_beyond_the_file_is_an_error(self, tmp_path):
        import struct

        (tmp_path / "images.bin").write_bytes(
            struct.pack("<Qi7di", 1, 1, 1, 0, 0, 0, 0, 0, 0, 1) + b"a.jpg\0" + struct.pack("<Q", 2**60)
        )
        (tmp_path / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, 1, 64, 48, 50, 50, 32, 24))
        with pytest.raises(DatasetError, match="cut off"):
            list(read_colmap(tmp_path))

    @pytest.mark.parametrize(
        ("cameras", "match"),
        [
            ("1 PINHOLE 640 480 1 1", "parameters"),
            ("1 FISHY 640 480 1 1 1 1", "FISHY"),
            ("1 PINHOLE", "too few"),
            ("2 PINHOLE 640 480 1 1 1 1", "no camera 1"),
        ],
    )
    def test_malformed_cameras_are_named(self, tmp_path, cameras, match):
        (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.jpg\n\n")
        (tmp_path / "cameras.txt").write_text(cameras + "\n")
        with pytest.raises(DatasetError, match=match):
            list(read_colmap(tmp_path))

    def test_a_file_without_lines_of_points_loses_no_image(self, tmp_path):
        lines = [f"{i} 1 0 0 0 0 0 0 1 {i}.jpg" for i in (1, 2, 3)]
        (tmp_path / "images.txt").write_text("\n".join(lines))
        with pytest.raises(DatasetError, match=r"line 2: .* no list of points"):
            list(read_colmap(tmp_path / "images.txt"))


def test_kapture_s_own_reader_agrees(tmp_path):
    pytest.importorskip("kapture")
    from kapture.io.csv import kapture_from_dir

    given = images()
    write_kapture(given, tmp_path)
    theirs = kapture_from_dir(str(tmp_path))
    for timestamp, device, name in (
        (time, device, theirs.records_camera[time][device])
        for time in theirs.records_camera
        for device in theirs.records_camera[time]
    ):
        image = given[timestamp]
        assert (image.name, image.camera is not None) == (name, True)
        pose = theirs.trajectories[timestamp][device]
        np.testing.assert_allclose(pose.r_raw, image.pose.quat_wxyz, atol=1e-15)
        np.testing.assert_allclose(np.ravel(pose.t_raw), image.pose.translation)
        sensor = theirs.sensors[device]
        model, params = image.camera.to_colmap()
        assert sensor.camera_type.name == model
        assert list(sensor.camera_params) == [640, 480, *params]


def test_we_read_what_kapture_writes(tmp_path):
    pytest.importorskip("kapture")
    from kapture.io.csv import kapture_from_dir, kapture_to_dir

    given = images()
    write_kapture(given, tmp_path / "ours")
    kapture_to_dir(str(tmp_path / "theirs"), kapture_from_dir(str(tmp_path / "ours")))
    found = list(read_kapture(tmp_path / "theirs"))
    assert [(image.name, image.camera) for image in found] == [(image.name, image.camera) for image in given]
    for image, original in zip(found, given, strict=True):
        np.testing.assert_allclose(image.pose.center, original.pose.center, rtol=0, atol=5e-9)


def test_evo_reads_our_trajectory(tmp_path):
    pytest.importorskip("evo")
    from evo.tools.file_interface import read_tum_trajectory_file

    given = images()
    write_tum(given, tmp_path / "poses.tum")
    theirs = read_tum_trajectory_file(str(tmp_path / "poses.tum"))
    assert theirs.timestamps.tolist() == [float(i) for i in range(len(given))]
    for matrix, image in zip(theirs.poses_se3, given, strict=True):
        np.testing.assert_allclose(matrix, image.pose.world_from_cam, rtol=1e-12, atol=1e-9)


_TURN = "[[-1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]"
_MIRRORED = f'{{"frames": [{{"file_path": "a", "transform_matrix": {_TURN}}}]}}'
_NO_PICTURE = (
    '{"w": 4, "h": 3, "fl_x": 1, "camera_model": "EQUIRECTANGULAR", "frames": [{"file_path": "a", '
    '"transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}'
)


class TestNerfstudio:
    def test_looks_down_minus_z_with_y_up(self, tmp_path):
        level = Pose.from_euler(EulerAngles(90.0, 0.0, 0.0), (3.0, 4.0, 5.0))
        write_nerfstudio([FoundPose("a.jpg", "", level, PINHOLE)], tmp_path / "transforms.json")
        values = json.loads((tmp_path / "transforms.json").read_text())
        matrix = np.array(values["frames"][0]["transform_matrix"])
        # Looking north: the camera's x is east, its y up, its z south.
        np.testing.assert_allclose(matrix[:3, :3], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)
        # Stated where it was before the shift, and small after it.
        np.testing.assert_allclose(matrix[:3, 3] + [3, 4, 5], [3, 4, 5], atol=1e-12)

    def test_intrinsics_of_all_frames_and_nerfstudio_s_own_turn(self, tmp_path):
        pose = images()[0].pose
        turn = np.array([[0, 1, 0, 2.0], [0, 0, -1, 3.0], [-1, 0, 0, 4.0], [0, 0, 0, 1]])
        saved = turn @ pose.world_from_cam @ np.diag([1.0, -1, -1, 1])
        saved[:3, 3] *= 0.5
        values = {
            "w": 640, "h": 480, "fl_x": 500.5, "fl_y": 501.25, "cx": 321.0, "cy": 238.5,
            "camera_model": "PINHOLE", "applied_transform": turn[:3].tolist(), "applied_scale": 0.5,
            "frames": [{"file_path": "images/a.jpg", "transform_matrix": saved.tolist()}],
        }  # fmt: skip
        (tmp_path / "transforms.json").write_text(json.dumps(values))
        (found,) = read_nerfstudio(tmp_path)
        assert found.camera == PINHOLE
        np.testing.assert_allclose(found.pose.rotation, pose.rotation, atol=1e-12)
        np.testing.assert_allclose(found.pose.center, pose.center, rtol=0, atol=1e-8)

    @pytest.mark.parametrize(
        ("stated", "focal_px"),
        [
            # 90 degrees across 640 pixels, and across 480.
            ({"camera_angle_x": np.pi / 2}, (320.0, 320.0)),
            ({"camera_angle_y": np.pi / 2}, (240.0, 240.0)),
            ({"camera_angle_x": np.pi / 2, "camera_angle_y": np.pi / 2}, (320.0, 240.0)),
            ({"fl_x": 500.0, "camera_angle_x": 1.0, "camera_angle_y": np.pi / 2}, (500.0, 240.0)),
            ({"fl_x": 500.0, "fl_y": 510.0, "camera_angle_y": 1.0}, (500.0, 510.0)),
        ],
    )
    def test_a_field_of_view_stands_for_a_focal_length(self, tmp_path, stated, focal_px):
        frame = {"file_path": "a", "transform_matrix": np.eye(4).tolist(), **stated}
        (tmp_path / "transforms.json").write_text(json.dumps({"w": 640, "h": 480, "frames": [frame]}))
        (found,) = read_nerfstudio(tmp_path)
        assert (found.camera.fx, found.camera.fy) == pytest.approx(focal_px, abs=1e-9)

    def test_instant_ngp_s_fisheye_is_one(self, tmp_path):
        frame = {"file_path": "a", "transform_matrix": np.eye(4).tolist()}
        lens = {"w": 640, "h": 480, "fl_x": 300.0, "k1": 0.1, "k2": 0.02, "k3": 0.0, "k4": 0.001}
        (tmp_path / "transforms.json").write_text(json.dumps({**lens, "is_fisheye": True, "frames": [frame]}))
        (found,) = read_nerfstudio(tmp_path)
        assert (found.camera.lens, found.camera.distortion) == ("OPENCV_FISHEYE", (0.1, 0.02, 0.0, 0.001))

    @pytest.mark.parametrize(
        ("text", "match"),
        [
            ("{", "transforms.json"),
            ("[]", "no JSON object"),
            ("{}", "frames"),
            ('{"frames": 3}', "no list"),
            ('{"frames": [{"file_path": "a"}]}', "transform_matrix"),
            ('{"frames": [{"file_path": "a", "transform_matrix": [[1, 2], [3]]}]}', "frame 0"),
            ('{"frames": [{"file_path": "a", "transform_matrix": [[NaN]]}]}', "NaN"),
            ('{"frames": [], "applied_transform": [[0,0,0,0],[0,0,0,0],[0,0,0,0]]}', "undone"),
            ("[" * 100_000, "nested"),
            (_MIRRORED, "no rotation"),
            (_NO_PICTURE.replace('"w": 4', '"w": 1e999'), "frame 0"),
            (_NO_PICTURE.replace('"fl_x": 1', '"camera_angle_x": 0'), "frame 0"),
            (_NO_PICTURE, "EQUIRECTANGULAR"),
        ],
    )
    def test_malformed_files_are_named(self, tmp_path, text, match):
        (tmp_path / "transforms.json").write_text(text)
        with pytest.raises(DatasetError, match=match):
            list(read_nerfstudio(tmp_path / "transforms.json"))


class TestKapture:
    def test_images_without_a_pose_and_cameras_without_numbers(self, tmp_path):
        write_kapture(images()[:3], tmp_path)
        sensors = tmp_path / "sensors/sensors.txt"
        sensors.write_text(
            "# kapture format: 1.1\ncamera0, , camera, UNKNOWN_CAMERA, 640, 480\n"
            + "\n".join(line for line in sensors.read_text().splitlines() if not line.startswith("camera0"))
        )
        trajectories = tmp_path / "sensors/trajectories.txt"
        lines = trajectories.read_text().splitlines()
        trajectories.write_text("\n".join(line for line in lines if not line.startswith("1, ")))
        found = list(read_kapture(tmp_path))
        assert [image.name for image in found] == ["DJI_000.JPG", "DJI_002.JPG"]
        assert found[0].camera is None

    def test_rigs_are_refused(self, tmp_path):
        write_kapture(images()[:1], tmp_path)
        (tmp_path / "sensors/rigs.txt").write_text("rig, camera0, 1, 0, 0, 0, 0, 0, 0\n")
        with pytest.raises(DatasetError, match="rigs"):
            list(read_kapture(tmp_path))


CAMERAS = {"PINHOLE": "100 100 32 24", "NEW_MODEL": "1 2 3", "SIMPLE_PINHOLE": "100 32 24"}


def text_model(folder, names, models=tuple(CAMERAS)):
    """A model whose n-th image has the n-th of some camera models."""
    rows = [f"{n} {model} 64 48 {CAMERAS[model]}" for n, model in enumerate(models, start=1)]
    (folder / "cameras.txt").write_text("\n".join(rows) + "\n")
    poses = [f"{n} 1 0 0 0 0 0 {n} {n} {name}\n\n" for n, name in enumerate(names, start=1)]
    (folder / "images.txt").write_text("".join(poses))
    return folder


def test_a_camera_model_that_is_not_known_costs_its_own_images_alone(tmp_path):
    found = list(read_colmap(text_model(tmp_path, ["a.jpg", "b.jpg", "c.jpg"])))
    assert [pose.camera is None for pose in found] == [False, True, False]
    assert "NEW_MODEL" in found[1].no_camera
    images, left_out = images_from_poses(found)
    assert [image.name for image in images] == ["a.jpg", "c.jpg"]
    assert left_out == [("b.jpg", found[1].no_camera)]


def test_in_a_binary_file_it_costs_those_behind_it_too(tmp_path):
    head = [struct.pack("<iiQQ", n, model, 64, 48) for n, model in ((1, 1), (2, 99))]
    content = struct.pack("<Q", 2) + head[0] + struct.pack("<4d", 100, 100, 32, 24) + head[1] + bytes(40)
    (tmp_path / "cameras.bin").write_bytes(content)
    rows = [
        struct.pack("<i7di", n, 1, 0, 0, 0, 0, 0, n, n) + f"{n}.jpg".encode() + bytes(9) for n in (1, 2, 3)
    ]
    (tmp_path / "images.bin").write_bytes(struct.pack("<Q", 3) + b"".join(rows))
    found = list(read_colmap(tmp_path))
    assert [pose.camera is None for pose in found] == [False, True, True]
    assert all("99" in pose.no_camera for pose in found[1:])


@pytest.mark.parametrize("slash", ["/", "\\"])
def test_images_of_a_rig_keep_apart_and_are_found_under_names_of_windows(tmp_path, slash):
    names = [f"cam1{slash}x.jpg", f"cam2{slash}x.jpg", f"cam2{slash}y.jpg"]
    model = text_model(tmp_path, names, ("PINHOLE", "PINHOLE", "PINHOLE"))
    for name in names:
        photo = tmp_path / "photos" / name.replace("\\", "/")
        photo.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(photo), np.zeros((48, 64, 3), np.uint8))
    kind, found = read_pose_file(model, "auto")
    assert (kind, [pose.name for pose in found]) == ("colmap", ["cam1/x.jpg", "cam2/x.jpg", "cam2/y.jpg"])
    images, left_out = images_from_poses(found, photos=tmp_path / "photos")
    assert left_out == []
    assert [image.photo.parent.name for image in images] == ["cam1", "cam2", "cam2"]
    written = write_dataset(images, tmp_path / "data", {})
    assert written.names == ("cam1_x.jpg", "cam2_x.jpg", "y.jpg")
