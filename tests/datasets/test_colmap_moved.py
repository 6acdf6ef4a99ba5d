"""COLMAP models moved by a similarity, against COLMAP's own transform."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lodbench.datasets.exchange.colmap import read_colmap, write_colmap
from lodbench.datasets.exchange.colmap_moved import write_moved_colmap
from lodbench.errors import DatasetError
from lodbench.geometry.similarity import Similarity

MOVED = Similarity(
    27.5, Rotation.from_rotvec([0.3, -1.1, 0.4]).as_matrix(), np.array([281000.0, 5657500.0, 60.0])
)


@pytest.fixture(scope="module")
def models(tmp_path_factory) -> tuple[Path, Path]:
    """A model of COLMAP's own making, with points and tracks, as binary and as text."""
    pycolmap = pytest.importorskip("pycolmap")
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = (
        1,
        1,
        5,
        30,
    )
    made = pycolmap.synthesize_dataset(options)
    folders = tmp_path_factory.mktemp("binary"), tmp_path_factory.mktemp("text")
    made.write_binary(str(folders[0]))
    made.write_text(str(folders[1]))
    return folders


def test_a_text_model_is_not_put_beside_a_binary_one_that_goes_before_it(models, tmp_path):
    write_moved_colmap(models[0], MOVED, tmp_path)
    with pytest.raises(DatasetError, match="would be read before"):
        write_moved_colmap(models[1], MOVED, tmp_path)
    with pytest.raises(DatasetError, match="would be read before"):
        write_colmap(list(read_colmap(models[1])), tmp_path)


@pytest.mark.parametrize("kind", [0, 1])
def test_poses_points_and_tracks_are_as_colmap_moves_them(models, tmp_path, kind):
    pycolmap = pytest.importorskip("pycolmap")
    write_moved_colmap(models[kind], MOVED, tmp_path / "moved")
    expected, found = (
        pycolmap.Reconstruction(str(models[0])),
        pycolmap.Reconstruction(str(tmp_path / "moved")),
    )
    turn = pycolmap.Rotation3d(Rotation.from_matrix(MOVED.rotation).as_quat())
    expected.transform(pycolmap.Sim3d(MOVED.scale, turn, MOVED.translation))
    assert found.num_reg_images() == expected.num_reg_images() == 5
    for number, image in expected.images.items():
        mine = found.images[number]
        assert mine.name == image.name
        assert mine.projection_center() == pytest.approx(image.projection_center(), abs=1e-5)
        assert mine.cam_from_world().rotation.matrix() == pytest.approx(
            image.cam_from_world().rotation.matrix(), abs=1e-9
        )
        assert mine.num_points3D == image.num_points3D > 0
    assert len(found.points3D) == len(expected.points3D) > 0
    for number, point in expected.points3D.items():
        assert found.points3D[number].xyz == pytest.approx(point.xyz, abs=1e-5)
        assert found.points3D[number].track.length() == point.track.length()
    # What is seen stays where it is seen.
    assert found.compute_mean_reprojection_error() == pytest.approx(
        expected.compute_mean_reprojection_error(), abs=1e-3
    )
    assert len(list(read_colmap(tmp_path / "moved"))) == 5


def test_a_file_that_is_cut_off_is_named(models, tmp_path):
    broken = tmp_path / "broken"
    broken.mkdir()
    for file in models[0].glob("*.bin"):
        (broken / file.name).write_bytes(file.read_bytes())
    points = (broken / "points3D.bin").read_bytes()
    (broken / "points3D.bin").write_bytes(points[: len(points) // 2])
    with pytest.raises(DatasetError, match=r"points3D\.bin"):
        write_moved_colmap(broken, MOVED, tmp_path / "moved")


def test_a_model_is_never_written_over_itself(models):
    before = (models[1] / "images.txt").read_bytes()
    with pytest.raises(DatasetError, match="is the model that is to be moved"):
        write_moved_colmap(models[1], MOVED, models[1] / ".." / models[1].name)
    assert (models[1] / "images.txt").read_bytes() == before


def rig_model(pycolmap, has_rigs=True):
    """A model of a rig of two cameras, the second 0.5 m beside the first; or the same without the rig."""
    made = pycolmap.Reconstruction()
    upright = pycolmap.Rotation3d(np.array([0, 0, 0, 1.0]))
    for n in (1, 2):
        camera = pycolmap.Camera.create_from_model_name(n, "PINHOLE", 100.0, 64, 48)
        (made.add_camera if has_rigs else made.add_camera_with_trivial_rig)(camera)
    places = (np.array([-1.0, 0, 0]), np.array([-0.5, 0, 0]))
    images = [pycolmap.Image(name=f"cam{n}/x.jpg", camera_id=n, image_id=n) for n in (1, 2)]
    if not has_rigs:
        for image, place in zip(images, places, strict=True):
            made.add_image_with_trivial_frame(image, pycolmap.Rigid3d(upright, place))
        return made
    sensors = [pycolmap.sensor_t(pycolmap.SensorType.CAMERA, n) for n in (1, 2)]
    rig, frame = pycolmap.Rig(rig_id=7), pycolmap.Frame(frame_id=9, rig_id=7)
    rig.add_ref_sensor(sensors[0])
    rig.add_sensor(sensors[1], pycolmap.Rigid3d(upright, np.array([0.5, 0, 0])))
    made.add_rig(rig)
    frame.rig_from_world = pycolmap.Rigid3d(upright, places[0])
    for n, sensor in enumerate(sensors, start=1):
        frame.add_data_id(pycolmap.data_t(sensor, n))
    made.add_frame(frame)
    for image in images:
        image.frame_id = 9
        made.add_image(image)
    made.register_frame(9)
    return made


@pytest.mark.parametrize("kind", ["binary", "text"])
@pytest.mark.parametrize("has_rigs", [True, False])
def test_rigs_and_frames_move_along_as_colmap_moves_them(tmp_path, kind, has_rigs):
    """COLMAP takes the poses of frames before those of images: a former tool's were read instead of ours."""
    pycolmap = pytest.importorskip("pycolmap")
    made = rig_model(pycolmap, has_rigs)
    source, target = tmp_path / "sparse", tmp_path / "placed"
    source.mkdir()
    getattr(made, f"write_{kind}")(str(source))
    for shift in (0.0, 20.0):  # the second time COLMAP has saved there, rigs and frames with it
        moved = Similarity(2.5, MOVED.rotation, MOVED.translation + shift)
        write_moved_colmap(source, moved, target)
        found, expected = pycolmap.Reconstruction(str(target)), pycolmap.Reconstruction(str(source))
        turn = pycolmap.Rotation3d(Rotation.from_matrix(moved.rotation).as_quat())
        expected.transform(pycolmap.Sim3d(moved.scale, turn, moved.translation))
        assert (len(found.rigs), len(found.frames)) == ((1, 1) if has_rigs else (2, 2))
        for pose in read_colmap(target):
            n = int(pose.name[3])
            for model in (found, expected):
                np.testing.assert_allclose(model.images[n].projection_center(), pose.pose.center, atol=1e-6)
        getattr(found, f"write_{kind}")(str(target))


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_a_model_of_before_rigs_gets_such_as_colmap_makes(models, tmp_path, kind):
    pycolmap = pytest.importorskip("pycolmap")
    old = tmp_path / "old"
    old.mkdir()
    for name in ("cameras", "images", "points3D"):
        content = (models[kind == "txt"] / f"{name}.{kind}").read_bytes()
        (old / f"{name}.{kind}").write_bytes(content)
    write_moved_colmap(old, MOVED, tmp_path / "placed")
    found = pycolmap.Reconstruction(str(tmp_path / "placed"))
    expected = pycolmap.Reconstruction(str(old))
    assert set(found.rigs) == set(expected.rigs)
    assert {n: frame.rig_id for n, frame in found.frames.items()} == {
        n: frame.rig_id for n, frame in expected.frames.items()
    }


def test_what_we_write_overrules_what_colmap_saved_there(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    rig_model(pycolmap).write_text(str(tmp_path))
    given = [each._replace(pose=MOVED.pose(each.pose)) for each in read_colmap(tmp_path)]
    write_colmap(given, tmp_path)
    found = pycolmap.Reconstruction(str(tmp_path))
    centers = {image.name: image.projection_center() for image in found.images.values()}
    for each in given:
        np.testing.assert_allclose(centers[each.name], each.pose.center, atol=1e-6)


@pytest.mark.parametrize("name", ["rigs.bin", "frames.bin"])
def test_binary_rigs_alone_are_in_the_way_of_text_too(models, tmp_path, name):
    (tmp_path / name).write_bytes(bytes(8))
    with pytest.raises(DatasetError, match=f"{name} would be read before"):
        write_moved_colmap(models[1], MOVED, tmp_path)


@pytest.mark.parametrize("kind", ["binary", "text"])
@pytest.mark.parametrize("name", ["rigs", "frames"])
def test_rigs_cut_off_are_an_error_that_names_the_file(tmp_path, kind, name):
    pycolmap = pytest.importorskip("pycolmap")
    getattr(rig_model(pycolmap), f"write_{kind}")(str(tmp_path))
    file = next(tmp_path.glob(f"{name}.*"))
    content = file.read_bytes()
    file.write_bytes(content[:-30] if kind == "binary" else content.rstrip()[:-12])
    if kind == "text" and name == "frames":
        file.write_bytes(content.rstrip().rsplit(b" ", 9)[0])
    with pytest.raises(DatasetError, match=name):
        write_moved_colmap(tmp_path, MOVED, tmp_path / "placed")
