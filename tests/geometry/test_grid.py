import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodbench.errors import LodbenchError
from lodbench.geometry import AxisRange, EulerAngles, Pose, PoseGrid

PRIOR = Pose.from_euler(EulerAngles(40.0, 1.0, 30.0), (100.0, 200.0, 150.0))


class TestAxis:
    def test_ends_are_included(self):
        np.testing.assert_allclose(AxisRange(60.0, 7).offsets(), [-30, -20, -10, 0, 10, 20, 30])

    def test_one_sample_is_the_centre(self):
        assert AxisRange(60.0, 1).offsets().tolist() == [0.0]

    @given(st.floats(0, 1e3), st.integers(2, 50))
    def test_spans_the_width_evenly(self, width, count):
        offsets = AxisRange(width, count).offsets()
        assert len(offsets) == count
        np.testing.assert_allclose(offsets, np.linspace(-width / 2, width / 2, count), atol=1e-9)

    @pytest.mark.parametrize(("width", "count"), [(10, 0), (-1, 3), (math.nan, 3)])
    def test_nonsense_is_refused(self, width, count):
        with pytest.raises(LodbenchError, match="grid axis"):
            AxisRange(width, count)


def test_order_is_yaw_x_y_z_with_z_fastest():
    grid = PoseGrid(AxisRange(20, 3), AxisRange(40, 2), AxisRange(60, 2), AxisRange(15, 2))
    centers, yaws = grid.around(PRIOR)
    assert len(grid) == len(centers) == len(yaws) == 24
    expected = [
        (30 + dyaw, 100 + dx, 200 + dy, 150 + dz)
        for dyaw in (-7.5, 7.5)
        for dx in (-10, 0, 10)
        for dy in (-20, 20)
        for dz in (-30, 30)
    ]
    np.testing.assert_allclose(np.column_stack([yaws, centers]), expected, atol=1e-9)


def test_a_grid_of_one_is_the_prior():
    one = AxisRange(0.0, 1)
    centers, yaws = PoseGrid(one, one, one, one).around(PRIOR)
    np.testing.assert_array_equal(centers, [PRIOR.center])
    assert yaws.tolist() == [PRIOR.euler.yaw_deg]
