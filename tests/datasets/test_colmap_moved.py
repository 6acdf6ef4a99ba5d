"""COLMAP models moved by a similarity, against COLMAP's own transform."""

from __future__ import annotations

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
