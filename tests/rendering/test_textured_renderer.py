"""A textured plane and box drawn by the raster, against an independent projection of the picture."""

import cv2
import numpy as np
import pytest

from lodbench.citymodel.mesh.textured import TexturedMesh, join_textured
from lodbench.errors import RenderingError
from lodbench.geometry import Camera, EulerAngles, Pose, rotation_from_euler
from lodbench.rendering.pyrender_textured import PyrenderTextured
from lodbench.rendering.textured import TexturedRenderer

CAMERA = Camera(200, 160, 190.0, 195.0, 101.0, 78.0)
POSE = Pose.from_euler(EulerAngles(35.0, 2.0, 20.0), [12.0, -45.0, 95.0])
# A square of ground, 120 m wide, with a picture on it.
SIZE_M, PIXELS = 120.0, 256


def smooth_picture():
    y, x = np.mgrid[0:PIXELS, 0:PIXELS] / (PIXELS - 1.0)
    waves = 0.5 + 0.3 * np.sin(9 * x + 4 * y)
    return (255 * np.stack([0.15 + 0.7 * x, 0.15 + 0.7 * y, waves], axis=2)).astype(np.uint8)


def ground(picture, size_m=SIZE_M, height_m=0.0, repeats=1.0) -> TexturedMesh:
    half = size_m / 2
    corners = np.array([(-half, -half), (half, -half), (half, half), (-half, half)])
    corners = np.column_stack([corners, np.full(4, height_m)])
    uv = repeats * np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    faces = np.array([(0, 1, 2), (0, 2, 3)])
    none = np.zeros((2, 3, 3), np.uint8)
    return TexturedMesh(corners[faces], uv[faces], np.zeros(2, np.int32), none, (picture,))


def draw(mesh, pose=POSE, camera=CAMERA, threads=1):
    return TexturedRenderer(mesh, threads).colours(camera, pose.rotation[None], pose.center[None])[0]


def test_perspective_is_that_of_the_plane():
    to_ground = np.array([[SIZE_M / PIXELS, 0, -SIZE_M / 2], [0, -SIZE_M / PIXELS, SIZE_M / 2], [0, 0, 1.0]])
    plane = np.column_stack([POSE.rotation[:, 0], POSE.rotation[:, 1], POSE.translation])
    shift = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    view = np.linalg.inv(shift) @ CAMERA.matrix @ plane @ to_ground @ shift
    size = (CAMERA.width, CAMERA.height)
    expected = cv2.warpPerspective(smooth_picture(), view, size, flags=cv2.INTER_LINEAR)
    covered = cv2.warpPerspective(np.ones((PIXELS, PIXELS), np.uint8), view, size, flags=cv2.INTER_NEAREST)
    covered = cv2.erode(covered, np.ones((5, 5), np.uint8)) > 0
    assert covered.mean() > 0.4
    off = np.abs(draw(ground(smooth_picture())).astype(float) - expected)[covered]
    assert off.mean() < 1.0
    assert np.percentile(off, 99) < 4.0


def test_a_far_view_of_a_fine_pattern_is_grey_not_moire():
    # Squares of one texel, a hundred of which fall into a pixel.
    squares = np.indices((PIXELS, PIXELS)).sum(axis=0) % 2
    picture = np.repeat((255 * squares)[:, :, None], 3, axis=2).astype(np.uint8)
    far = Pose.from_euler(EulerAngles(0.0, 0.0, 30.0), [0.0, 0.0, 400.0])
    seen = draw(ground(picture, repeats=20.0), far)
    depth = TexturedRenderer(ground(picture), 1).depths(CAMERA, far.rotation[None], far.center[None])[0]
    inside = cv2.erode((depth > 0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert inside.sum() > 1000
    assert np.abs(seen[inside].astype(float) - 127.5).max() < 12


def test_the_nearer_surface_hides_the_other_and_nothing_is_pale():
    red = np.broadcast_to(np.array([200, 10, 10], np.uint8), (8, 8, 3)).copy()
    below = ground(smooth_picture())
    both = join_textured([below, ground(red, 30.0, 20.0)])
    down = Pose.from_euler(EulerAngles(0.0, 0.0, 0.0), [0.0, 0.0, 100.0])
    seen, alone = draw(both, down), draw(below, down)
    assert (np.abs(seen[75:82, 98:104].astype(int) - [200, 10, 10]) <= 1).all()
    outside = np.ones(seen.shape[:2], dtype=bool)
    outside[30:125, 50:150] = False
    np.testing.assert_array_equal(seen[outside], alone[outside])
    up = Pose.from_euler(EulerAngles(180.0, 0.0, 0.0), [0.0, 0.0, 100.0])
    assert len(np.unique(draw(both, up).reshape(-1, 3), axis=0)) == 1


def test_colours_of_corners_are_blended_over_their_triangle():
    corners = np.array([[(-500.0, -500.0, 0.0), (500.0, -500.0, 0.0), (0.0, 800.0, 0.0)]])
    colours = np.array([[(200, 100, 50)] * 3], dtype=np.uint8)
    mesh = TexturedMesh(corners, np.zeros((1, 3, 2)), np.array([-1], np.int32), colours, ())
    np.testing.assert_allclose(draw(mesh)[80, 100], [200, 100, 50], atol=1)


@pytest.mark.parametrize("count", [1, 5])
def test_batches_and_threads_change_nothing(count):
    rng = np.random.default_rng(count)
    mesh = join_textured([ground(smooth_picture(), 40.0, float(z)) for z in rng.uniform(0, 30, 5)])
    yaws = rng.uniform(0, 360, count)
    rotations = np.array([rotation_from_euler(EulerAngles(30.0, 0.0, yaw)) for yaw in yaws])
    centers = -90 * rotations[:, 2]
    whole = TexturedRenderer(mesh, 3).colours(CAMERA, rotations, centers)
    single = TexturedRenderer(mesh, 1)
    for i in range(count):
        np.testing.assert_array_equal(single.colours(CAMERA, rotations[[i]], centers[[i]])[0], whole[i])
    assert len(np.unique(whole[0].reshape(-1, 3), axis=0)) > 100


@pytest.mark.slow
def test_pyrender_draws_the_same():
    pytest.importorskip("pyrender")
    try:
        theirs = PyrenderTextured(ground(smooth_picture())).colours(
            CAMERA, POSE.rotation[None], POSE.center[None]
        )[0]
    except RenderingError as error:
        pytest.skip(str(error))
    off = np.abs(theirs.astype(int) - draw(ground(smooth_picture()))).max(axis=2)
    assert np.median(off) <= 1
    assert (off > 12).mean() < 0.03
