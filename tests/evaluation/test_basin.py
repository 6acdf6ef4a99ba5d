import pytest

from lodbench.errors import ConfigError
from lodbench.evaluation.basin import basin_steps, protocol_lines


def test_steps_are_both_tables_widest_last():
    steps = basin_steps([100, 30], [60.0], [None])
    assert [step.label for step in steps] == ["Delta 30 m", "Delta 100 m", "Delta 60 deg"]
    far, turned = steps[1].prior(), steps[2].prior()
    assert (far.x_m, far.y_m, far.z_m, far.yaw_deg) == (100, 100, 100, 7.5)
    assert (turned.x_m, turned.y_m, turned.z_m, turned.yaw_deg) == (10, 10, 30, 60)


def test_limits_follow_their_ranges():
    steps = basin_steps([200, 30], [], [25, 100])
    assert [(step.half_width, step.limit) for step in steps] == [(30, 100), (200, 25)]


@pytest.mark.parametrize(
    ("ranges", "yaws", "limits", "said"),
    [
        ([0], [], [None], r"ranges=0 is not in \(0, 10000\]"),
        ([float("nan")], [], [None], r"ranges=nan is not in \(0, 10000\]"),
        ([], [181], [None], r"yaw_ranges=181 is not in \(0, 180\]"),
        ([30, 30], [], [None], "occurs twice"),
        ([], [], [None], "no range"),
        ([30, 50, 100], [], [10, 10], "2 limits"),
    ],
)
def test_bad_ranges_stop_before_any_work(ranges, yaws, limits, said):
    with pytest.raises(ConfigError, match=said):
        basin_steps(ranges, yaws, limits)


def test_the_protocol_says_which_tilt_and_that_no_pose_is_dropped():
    text = " ".join(protocol_lines("truth", 3, True))
    assert "oracle" in text
    assert "no pose is dropped" in text
    assert "seed 3" in text
