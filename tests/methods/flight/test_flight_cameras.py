"""How well a flight takes its camera to be known, by where the numbers of its photos come from."""

from lodbench.geometry.camera import CALIBRATED, MAKER, STATED, UNKNOWN, CameraSigmas
from lodbench.methods.flight.params import FlightParams


def test_a_camera_less_known_than_usual_widens_what_is_solved_for():
    edges = FlightParams(single="region")
    found = edges.with_cameras([MAKER, UNKNOWN, None])
    assert found.focal == 0.01 * UNKNOWN.focal_percent > edges.focal
    assert found.distortion == UNKNOWN.k1 > edges.distortion
    assert found.center == 0.01 * UNKNOWN.center_percent


def test_calibrations_and_makers_numbers_narrow_nothing():
    for cameras in ([], [None], [CALIBRATED], [CALIBRATED, MAKER]):
        found = FlightParams().with_cameras(cameras)
        assert (found.focal, found.distortion) == (FlightParams().focal, FlightParams().distortion)


def test_what_a_person_states_is_taken_as_it_is():
    found = FlightParams(single="region").with_cameras([CameraSigmas(0.1, 0.2, 0.001, STATED)])
    assert (found.focal, found.distortion, found.center) == (0.001, 0.001, 0.002)


def test_what_a_person_leaves_out_is_as_usual():
    found = FlightParams(single="region").with_cameras([CameraSigmas(3.0, 0.0, 0.0, STATED)])
    assert (found.focal, found.distortion) == (0.03, FlightParams().distortion)


def test_masks_hold_the_principal_point():
    assert FlightParams().with_cameras([UNKNOWN]).center == 0.0
