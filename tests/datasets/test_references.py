"""Posed pictures of the place: any folder in the text layout, told in one line where it lacks something."""

import numpy as np
import pytest

from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.inputs import Input, inputs_of, read_references
from lodbench.datasets.pose_text import format_camera, format_pose, lines_to_text
from lodbench.errors import DatasetError
from lodbench.geometry import Camera, EulerAngles, Pose
from tests.town import write_dataset

CAMERA = Camera(40, 30, 35.0, 36.0, 20.0, 15.0)
POSES = {f"r{k}.jpg": Pose.from_euler(EulerAngles(30.0, 0.0, 40.0 * k), (k, 2.0, 90.0)) for k in range(3)}


def write_references(folder, images="images", poses="poses.txt"):
    (folder / images).mkdir(parents=True, exist_ok=True)
    (folder / poses).write_text(lines_to_text(format_pose(*item) for item in POSES.items()))
    (folder / "intrinsic.txt").write_text(lines_to_text(format_camera(name, CAMERA) for name in POSES))
    for name in POSES:
        (folder / images / name).write_bytes(b"not opened")
    return folder


@pytest.mark.parametrize(
    ("images", "poses"), [("images", "poses.txt"), ("Query_image", "GT_pose.txt"), (".", "poses.txt")]
)
def test_each_layout_is_read(tmp_path, images, poses):
    found = read_references(write_references(tmp_path, images, poses))
    assert [reference.name for reference in found] == list(POSES)
    for reference in found:
        assert reference.image.is_file()
        assert reference.camera == CAMERA
        expected = POSES[reference.name].cam_from_world
        np.testing.assert_allclose(reference.pose.cam_from_world, expected, atol=1e-9)


def test_what_lacks_is_one_line(tmp_path):
    with pytest.raises(DatasetError, match="is not a folder"):
        read_references(tmp_path / "none")
    with pytest.raises(DatasetError, match="have no poses"):
        read_references(tmp_path)
    folder = write_references(tmp_path / "a")
    (folder / "images" / "r1.jpg").unlink()
    with pytest.raises(DatasetError, match=r"r1\.jpg .* has no picture"):
        read_references(folder)
    folder = write_references(tmp_path / "b")
    (folder / "intrinsic.txt").write_text(format_camera("r0.jpg", CAMERA) + "\n")
    with pytest.raises(DatasetError, match=r"r1\.jpg .* has no camera"):
        read_references(folder)


def test_a_lens_that_distorts_is_refused(tmp_path):
    folder = write_references(tmp_path)
    lines = "".join(f"{name} SIMPLE_RADIAL 40 30 35 20 15 0.1\n" for name in POSES)
    (folder / "intrinsic.txt").write_text(lines)
    with pytest.raises(DatasetError, match=r"r0\.jpg .* lens distortion"):
        read_references(folder)


def test_a_dataset_names_them_by_one_key_each(tmp_path):
    root, city = write_dataset(tmp_path / "town", count=1)
    plain = open_folder(FolderParams(str(root), str(city)))
    assert not {Input.REFERENCES, Input.TEXTURED_MAP} & inputs_of(plain, plain.entries)
    references = write_references(tmp_path / "references")
    params = FolderParams(str(root), str(city), references=str(references), textured_map=str(city))
    dataset = open_folder(params)
    assert len(dataset.references) == 3
    assert inputs_of(dataset, dataset.entries) >= {Input.REFERENCES, Input.TEXTURED_MAP}
    with pytest.raises(DatasetError, match="does not exist"):
        open_folder(FolderParams(str(root), str(city), textured_map=str(tmp_path / "none.obj")))
