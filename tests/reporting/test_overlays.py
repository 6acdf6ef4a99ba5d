import numpy as np

from lodbench.citymodel import open_scene
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.reporting.overlays import ESTIMATE_COLOUR, OverlayInput, draw_overlay, write_picture
from tests.town import CAMERA, box_obj, prior_of, true_poses


def test_overlay_shows_outline_mask_and_caption(tmp_path):
    import cv2

    (tmp_path / "city.obj").write_text(box_obj())
    renderer = SilhouetteRenderer(open_scene(tmp_path / "city.obj"), threads=1)
    (pose,) = true_poses(1).values()
    mask = renderer.render(CAMERA, pose)
    shown = OverlayInput(CAMERA, mask, None, prior_of(pose), pose, None, "a caption")
    picture = draw_overlay(shown, renderer)
    assert picture.shape == (CAMERA.height + 48, CAMERA.width, 3)
    # Lines are smoothed, so near the colour is enough.
    distance = np.abs(picture[: CAMERA.height].astype(int) - ESTIMATE_COLOUR).max(axis=2)
    drawn = distance < 60
    # The estimate's outline runs along the mask's edge.
    padded = np.pad(mask.astype(np.uint8), 3)
    edge = cv2.morphologyEx(padded, cv2.MORPH_GRADIENT, np.ones((5, 5), np.uint8))[3:-3, 3:-3] > 0
    assert drawn.sum() > 100
    assert (drawn & edge).sum() > 0.95 * drawn.sum()
    write_picture(tmp_path / "a.png", picture)
    assert np.array_equal(cv2.imread(str(tmp_path / "a.png")), picture)


def test_nothing_but_a_camera_is_enough(tmp_path):
    (tmp_path / "city.obj").write_text(box_obj())
    renderer = SilhouetteRenderer(open_scene(tmp_path / "city.obj"), threads=1)
    picture = draw_overlay(OverlayInput(CAMERA, None, None, None, None, None, "no poses"), renderer)
    assert picture[: CAMERA.height].std() == 0
    # The legend names nothing that is not there.
    assert (picture[CAMERA.height + 24 :] == picture[-1, -1]).all()
