"""What a flight's photos are solved with: poses in a model whose images may be called alike."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from lodbench.datasets.exchange.colmap import write_colmap
from lodbench.datasets.pose_text import FoundPose
from lodbench.errors import DatasetError
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.harness.photo.flight_inputs import masks_of, picture_file, poses_in_model, tied_notes
from lodbench.methods.flight.relative_poses import width_looked_at
from lodbench.photos.camera import pinhole_of
from tests.town import CAMERA


def model_of(folder: Path, *names: str) -> Path:
    """Returns a model whose images stand at x = 1, 2 and so on."""
    poses = [Pose.from_euler(EulerAngles(0, 0, 0), (x + 1.0, 0.0, 0.0)) for x in range(len(names))]
    write_colmap([FoundPose(n, "", pose, CAMERA) for n, pose in zip(names, poses, strict=True)], folder)
    return folder


def places(known: dict[Path, Pose]) -> dict[str, int]:
    return {photo.as_posix(): round(float(pose.center[0])) for photo, pose in known.items()}


@pytest.mark.parametrize(
    ("images", "photos", "expected"),
    [
        (["a.jpg", "b.jpg"], ["x/a.jpg", "x/b.jpg", "x/c.jpg"], {"x/a.jpg": 1, "x/b.jpg": 2}),
        (["card/a.jpg"], ["x/a.jpg"], {"x/a.jpg": 1}),
        # Memory cards begin anew after 999 photos: two folders, each with an a.jpg.
        (["1/a.jpg", "2/a.jpg"], ["x/2/a.jpg", "x/1/a.jpg"], {"x/2/a.jpg": 2, "x/1/a.jpg": 1}),
        (["1/a.jpg", "2/a.jpg", "b.jpg"], ["x/a.jpg", "x/b.jpg"], {"x/b.jpg": 3}),
        (["a.jpg", "b.jpg"], ["1/a.jpg", "2/a.jpg", "1/b.jpg"], {"1/b.jpg": 2}),
        # Programs leave endings out, or write them in other letters; a PNG is another photo.
        (["a", "c/b.jpg", "d.png"], ["x/a.JPG", "x/b.JPG", "x/d.jpg"], {"x/a.JPG": 1, "x/b.JPG": 2}),
        (["1/a", "2/a"], ["x/2/a.jpg", "x/1/a.jpg"], {"x/2/a.jpg": 2, "x/1/a.jpg": 1}),
        (["a", "b"], ["x/a.jpg", "x/a.png", "x/b.jpg"], {"x/b.jpg": 2}),
    ],
)
def test_no_photo_gets_the_pose_of_another_of_its_name(tmp_path, images, photos, expected):
    assert places(poses_in_model(model_of(tmp_path / "model", *images), [*map(Path, photos)])) == expected


def test_a_model_of_other_photos_is_refused(tmp_path):
    with pytest.raises(DatasetError, match="none of these photos"):
        poses_in_model(model_of(tmp_path / "model", "a.jpg"), [Path("b.jpg")])


def test_photos_that_a_model_lacks_are_told(tmp_path):
    photos = [Path(f"x/{name}.jpg") for name in "abcd"]
    known = poses_in_model(model_of(tmp_path / "model", "a.jpg", "b.jpg", "d.jpg"), photos)
    assert tied_notes(Path("sparse"), photos, known) == ["3 of these photos are in sparse, under their names"]
    (few,) = tied_notes(Path("sparse"), photos[:3], known)
    assert few == "2 of these photos are in sparse, under their names: too few to tie the photos together"
    assert tied_notes(Path("sparse"), photos[:2], known) == tied_notes(None, photos, {}) == []


def test_a_copy_of_the_same_name_leaves_the_mask_to_the_original(tmp_path):
    photos = [tmp_path / folder / "a.jpg" for folder in ("card", "backup", "other")]
    for photo, content in zip(photos, (b"one", b"one", b"two"), strict=True):
        photo.parent.mkdir()
        photo.write_bytes(content)
    (tmp_path / "masks").mkdir()
    mask = tmp_path / "masks" / "a.png"
    mask.touch()
    found, reasons = masks_of(photos[:2], mask.parent)
    assert found[0] == mask
    assert reasons == {1: f"it is a copy of {photos[0]}"}
    # Of two photos it is of neither.
    _, reasons = masks_of(photos, mask.parent)
    assert [row for row in reasons if "may be of" in reasons[row]] == [0, 2]


def test_undistorted_copies_are_as_wide_as_features_are_looked_for_in(tmp_path):
    camera = Camera(2400, 600, 2000.0, 2000.0, 1200.0, 300.0, (-0.05, 0.0, 0.0, 0.0))
    cv2.imwrite(str(tmp_path / "a.jpg"), np.zeros((600, 2400, 3), np.uint8))
    request = SimpleNamespace(photo=tmp_path / "a.jpg")
    photo = SimpleNamespace(camera=camera, pinhole=pinhole_of(camera), request=request)
    copy = picture_file(photo, tmp_path / "1.jpg")
    assert cv2.imread(str(copy)).shape[1] == width_looked_at(10) == 2048


@pytest.mark.parametrize("has_masks", [True, False])
def test_the_original_of_a_numbered_copy_is_the_photo_that_masks_are_named_by(tmp_path, has_masks):
    """The copy comes first in a folder: it was kept, without a mask, and the photo was left out."""
    photos = [tmp_path / "DJI_0001 (1).JPG", tmp_path / "DJI_0001.JPG"]
    for photo in photos:
        photo.write_bytes(b"one")
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "DJI_0001.png").touch()
    _, reasons = masks_of(photos, tmp_path / "masks" if has_masks else None)
    assert reasons == {0: f"it is a copy of {photos[1]}"}


def test_a_copy_that_has_the_mask_is_kept(tmp_path):
    photos = [tmp_path / "a.JPG", tmp_path / "mapped_a.JPG"]
    for photo in photos:
        photo.write_bytes(b"one")
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "mapped_a.png").touch()
    assert masks_of(photos, tmp_path / "masks")[1] == {0: f"it is a copy of {photos[1]}"}
