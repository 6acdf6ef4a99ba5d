"""Silhouettes worked out by hand, pixel by pixel."""

import numpy as np
import pytest
from hostile_scenes import box, scene_of, straight_down

from lodbench.geometry import Camera
from lodbench.rendering.reference import ReferenceRenderer
from lodbench.rendering.silhouette import SilhouetteRenderer

RENDERERS = [ReferenceRenderer, lambda scene: SilhouetteRenderer(scene, 1)]


@pytest.mark.parametrize("make", RENDERERS, ids=["reference", "engine"])
class TestByHand:
    def test_a_unit_cube_from_above(self, make):
        # Its roof is 10 m below the camera: 40 px / 10 m, so 4 x 4 pixels right of and above the centre.
        mask = make(scene_of(box([0, 0, 0], [1, 1, 1]))).render(
            Camera(16, 16, 40, 40, 8, 8), straight_down(11.0)
        )
        expected = np.zeros((16, 16), dtype=bool)
        expected[4:8, 8:12] = True
        np.testing.assert_array_equal(mask, expected)

    @pytest.mark.parametrize("floor", [True, False])
    def test_roof_and_walls_of_a_cube_seen_aslant(self, make, floor):
        # Roof at 10 m: columns 40 to 80, rows 0 to 40 above the centre. Base at 20 m: columns 20 to
        # 40, rows 0 to 20. The outline between them runs along column = row, through pixel centres,
        # and as a left edge it keeps the pixels it meets.
        scene = scene_of(box([10, 0, 0], [10, 10, 10], floor=floor))
        mask = make(scene).render(Camera(100, 60, 40, 40, 0, 50), straight_down(20.0))
        expected = np.zeros((60, 100), dtype=bool)
        for above in range(40):
            expected[49 - above, max(20, above) : 80] = True
        np.testing.assert_array_equal(mask, expected)

    def test_the_inside_of_an_open_box_is_a_hole(self, make):
        # Four walls, no roof and no floor, from straight above: the opening at the base shows through.
        faces = box([-1, -1, 0], [2, 2, 10])
        normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
        walls = faces[normals[:, 2] == 0]
        mask = make(scene_of(walls)).render(Camera(32, 32, 40, 40, 16, 16), straight_down(20.0))
        expected = np.zeros((32, 32), dtype=bool)
        expected[12:20, 12:20] = True  # the rim, 40 px / 10 m * 1 m = 4 pixels each way
        expected[14:18, 14:18] = False  # the base, half as large
        np.testing.assert_array_equal(mask, expected)

    def test_neighbours_leave_no_gap_and_no_overlap(self, make):
        # Two triangles of a square whose corners lie on pixel centres: half-open edges give 8 x 8.
        square = np.array([[[0, 0, 0], [2, 0, 0], [2, 2, 0]], [[0, 0, 0], [2, 2, 0], [0, 2, 0]]], dtype=float)
        mask = make(scene_of(square)).render(Camera(24, 24, 40, 40, 8.5, 16.5), straight_down(10.0))
        expected = np.zeros((24, 24), dtype=bool)
        expected[8:16, 8:16] = True
        np.testing.assert_array_equal(mask, expected)

    def test_everything_behind_the_camera_is_empty(self, make):
        scene = scene_of(box([-5, -5, 30], [10, 10, 10]))
        assert not make(scene).render(Camera(20, 20, 10, 10, 10, 10), straight_down(20.0)).any()

    def test_a_wall_around_the_camera_fills_the_picture(self, make):
        scene = scene_of(box([-5, -5, -5], [10, 10, 10]))
        assert make(scene).render(Camera(70, 20, 10, 10, 35, 10), straight_down(0.0)).all()
