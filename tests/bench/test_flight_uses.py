"""What is measured of georeferencing and tracking, on the tests' town."""

from __future__ import annotations

import numpy as np
import pytest

from lodbench.bench.reconstructions import Noise, measure_reconstructions
from lodbench.bench.tracking import TrackingOptions, measure_tracking
from lodbench.synthesis.flights.dataset import FlightsParams
from tests.town import box_obj


@pytest.fixture
def city(tmp_path):
    path = tmp_path / "city.obj"
    path.write_text(box_obj())
    return path


def test_a_reconstruction_is_placed_again(city):
    flights = FlightsParams(str(city), num_photos=5, path="orbit", mask_iou=0.97)
    report = measure_reconstructions(flights, [4], Noise(0.02, 0.01))
    error, placed = report.figures
    assert (placed.value, placed.peer) == (1, "of 1")
    assert error.value < 1.0
    numbers = [float(word) for word in report.text.splitlines()[1].split()[1:]]
    assert numbers[1] == pytest.approx(error.value, abs=0.01)
    # The start was far off.
    assert numbers[-1] > 3.0 * error.value


def test_frames_are_counted_whether_found_or_lost(city):
    class Blind:
        def probability(self, photo):
            assert photo.shape == (120, 160, 3)
            return np.zeros((120, 160), np.float32)

    report = measure_tracking(city, [0], Blind(), TrackingOptions(frames=3, size=(160, 120), look="plain"))
    values = {(figure.figure, figure.unit): figure.value for figure in report.figures}
    assert values["frames lost", ""] == 3
    assert values["frames within 2 m and 2 deg", "%"] == 0.0
    assert values["photos per second from pixels to pose", "1/s"] > 0
