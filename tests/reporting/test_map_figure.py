from __future__ import annotations

import re

import numpy as np
import pytest

from lodbench.reporting.map_figure import Spot, draw_map


@pytest.mark.parametrize(("count", "classes"), [(199, "map"), (200, "map many"), (1000, "map many crowd")])
def test_many_cameras_are_drawn_smaller(count, classes):
    spots = [Spot(f"a/{n}", np.array([n, 0.0]), np.array([n, 5.0]), None) for n in range(count)]
    assert re.match('<div class="([^"]*)"', draw_map(spots, None, None))[1] == classes
