"""Errors of poses and recalls, against computations that share no code with ours."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest

from lodbench.datasets.pose_text import format_pose
from lodbench.evaluation import DEFAULT_THRESHOLDS, PoseError, Threshold, pose_error, summarize
from lodbench.evaluation.pose_errors import FAILED, error_parts, wilson_interval
from lodbench.geometry import EulerAngles, Pose

angles = st.tuples(st.floats(-180, 180), st.floats(-89, 89), st.floats(-180, 180))
points = st.tuples(*[st.floats(-1e3, 1e3)] * 3)


def pose_of(euler, center=(0.0, 0.0, 0.0)) -> Pose:
    return Pose.from_euler(EulerAngles(*euler), center)


@given(angles, angles, points, points)
def test_against_scipy(a, b, center_a, center_b):
    estimate, truth = pose_of(a, center_a), pose_of(b, center_b)
    error = pose_error(estimate, truth)
    turn = Rotation.from_matrix(estimate.rotation) * Rotation.from_matrix(truth.rotation).inv()
    assert error.rotation_deg == pytest.approx(math.degrees(turn.magnitude()), abs=1e-6)
    assert error.translation_m == pytest.approx(math.dist(center_a, center_b), abs=1e-9)


@given(angles, angles)
def test_against_the_textbook_arccos(a, b):
    estimate, truth = pose_of(a), pose_of(b)
    cosine = (np.trace(truth.rotation.T @ estimate.rotation) - 1) / 2
    expected = math.degrees(math.acos(min(1.0, max(-1.0, cosine))))
    # arccos loses half the digits near 0 and 180 degrees.
    assert pose_error(estimate, truth).rotation_deg == pytest.approx(expected, abs=2e-5)


@given(angles, angles, points)
def test_is_symmetric_and_within_half_a_turn(a, b, center):
    one, two = pose_of(a, center), pose_of(b)
    forth, back = pose_error(one, two), pose_error(two, one)
    assert forth == pytest.approx(back, abs=1e-9)
    assert 0 <= forth.rotation_deg <= 180


@given(angles, points)
def test_a_pose_has_no_error_against_itself(a, center):
    error = pose_error(pose_of(a, center), pose_of(a, center))
    assert error.translation_m == 0
    assert error.rotation_deg < 1e-13


@pytest.mark.parametrize("turn_deg", [1e-9, 1e-6, 1e-3, 1.0, 90.0, 179.999, 180.0])
def test_tiny_and_half_turns_keep_their_digits(turn_deg):
    truth = pose_of((40.0, 0.0, 0.0))
    error = pose_error(pose_of((40.0, 0.0, turn_deg)), truth)
    assert error.rotation_deg == pytest.approx(turn_deg, rel=1e-6)


@given(st.floats(-170, 170), st.integers(-3, 3))
def test_whole_turns_of_yaw_do_not_count(yaw, turns):
    error = pose_error(pose_of((40, 1, yaw + 360 * turns)), pose_of((40, 1, yaw)))
    assert error.rotation_deg < 1e-9


def test_the_centres_are_compared_not_the_translations():
    turned = pose_of((40.0, 0.0, 90.0), (500.0, 600.0, 150.0))
    truth = pose_of((40.0, 0.0, 0.0), (500.0, 600.0, 153.0))
    assert pose_error(turned, truth).translation_m == pytest.approx(3.0)


def test_no_answer_is_infinitely_far_and_half_a_turn_off():
    assert FAILED == (math.inf, 180.0)


errors = st.lists(
    st.builds(PoseError, st.floats(0, 20), st.floats(0, 20)) | st.just(FAILED), min_size=1, max_size=40
)


class TestRecall:
    def test_by_hand(self):
        summary = summarize(
            [PoseError(0.5, 0.1), PoseError(2.5, 0.1), PoseError(0.5, 4.0), FAILED], hypotheses=[10, 20, 30]
        )
        assert summary.recall == {"2m-2deg": 25.0, "3m-3deg": 50.0, "5m-5deg": 75.0}
        assert (summary.num_queries, summary.num_failed) == (4, 1)
        assert summary.median_translation_m == 1.5
        assert summary.median_rotation_deg == pytest.approx(2.05)
        assert summary.hypotheses_per_query == 20

    @pytest.mark.parametrize("error", [PoseError(2.0, 0.0), PoseError(0.0, 2.0), PoseError(2.0, 2.0)])
    def test_thresholds_are_strict(self, error):
        assert summarize([error]).recall["2m-2deg"] == 0
        assert summarize([PoseError(*np.nextafter(error, -1))]).recall["2m-2deg"] == 100

    def test_labels_and_other_thresholds(self):
        summary = summarize([PoseError(0.2, 0.3)], thresholds=[Threshold(0.25, 2), Threshold(10, 0.2)])
        assert summary.recall == {"0.25m-2deg": 100.0, "10m-0.2deg": 0.0}
        assert [t.label for t in DEFAULT_THRESHOLDS] == ["2m-2deg", "3m-3deg", "5m-5deg"]

    @given(errors, st.floats(0, 20), st.floats(0, 20), st.floats(0, 5), st.floats(0, 5))
    def test_wider_thresholds_never_lower_it(self, rows, metres, degrees, more_metres, more_degrees):
        narrow = Threshold(metres, degrees)
        wide = Threshold(metres + more_metres, degrees + more_degrees)
        found = [next(iter(summarize(rows, thresholds=[t]).recall.values())) for t in (narrow, wide)]
        assert found[0] <= found[1]

    @given(errors, st.randoms(use_true_random=False))
    def test_order_of_queries_does_not_matter(self, rows, random):
        shuffled = random.sample(rows, len(rows))
        assert summarize(rows).to_json() == summarize(shuffled).to_json()

    @given(errors)
    def test_another_failure_never_raises_it(self, rows):
        before, after = summarize(rows), summarize([*rows, FAILED])
        assert after.num_queries == before.num_queries + 1
        assert after.num_failed == before.num_failed + 1
        for label, percent in before.recall.items():
            assert after.recall[label] <= percent

    @given(errors)
    def test_against_counting(self, rows):
        for t in DEFAULT_THRESHOLDS:
            hits = sum(e.translation_m < t.translation_m and e.rotation_deg < t.rotation_deg for e in rows)
            assert summarize(rows).recall[t.label] == pytest.approx(100 * hits / len(rows))


class TestMedians:
    def test_failures_enter_them(self):
        summary = summarize([PoseError(1, 1), FAILED, FAILED])
        assert summary.median_translation_m == math.inf
        assert summary.median_rotation_deg == 180

    def test_half_failures_give_an_infinite_median_and_no_warning(self):
        assert summarize([PoseError(1, 1), FAILED]).median_translation_m == math.inf
        assert summarize([FAILED, FAILED]).median_translation_m == math.inf


class TestNothing:
    def test_an_empty_split_has_no_numbers(self):
        summary = summarize([])
        assert summary.num_queries == 0
        assert all(math.isnan(v) for v in summary.recall.values())
        assert math.isnan(summary.median_translation_m)

    def test_json_holds_null_where_nothing_is_finite(self):
        text = json.dumps(summarize([FAILED]).to_json(), allow_nan=False)
        values = json.loads(text)
        assert values["median_translation_m"] is None
        assert values["hypotheses_per_query"] is None
        assert values["recall"]["2m-2deg"] == 0


class TestInterval:
    @pytest.mark.parametrize(("hits", "count"), [(5, 20), (100, 200), (190, 200), (30, 40)])
    def test_is_close_to_the_normal_approximation(self, hits, count):
        low, high = wilson_interval(np.arange(count) < hits)
        share = hits / count
        half = 196 * math.sqrt(share * (1 - share) / count)
        assert low == pytest.approx(100 * share - half, abs=0.3 * half + 200 / count)
        assert high == pytest.approx(100 * share + half, abs=0.3 * half + 200 / count)

    @given(st.lists(st.booleans(), min_size=1, max_size=60), st.randoms(use_true_random=False))
    def test_holds_the_mean_and_is_the_same_every_time(self, hits, random):
        values = np.array(hits)
        low, high = wilson_interval(values)
        assert 0 <= low <= 100 * values.mean() <= high <= 100
        assert wilson_interval(np.array(random.sample(hits, len(hits)))) == (low, high)

    @pytest.mark.parametrize(("hits", "count"), [(200, 200), (0, 10), (15, 148), (1, 1), (73, 200)])
    def test_against_scipy(self, hits, count):
        low, high = binomtest(hits, count).proportion_ci(method="wilson")
        assert wilson_interval(np.arange(count) < hits) == pytest.approx((100 * low, 100 * high))

    @pytest.mark.parametrize("is_found", [False, True])
    def test_all_and_none_end_on_it(self, is_found):
        ends = [wilson_interval(np.full(n, is_found))[int(is_found)] for n in range(1, 100)]
        assert set(ends) == {100.0 if is_found else 0.0}

    def test_more_queries_narrow_it(self):
        widths = [np.diff(wilson_interval(np.arange(n) < n * 0.75))[0] for n in (20, 200, 2000)]
        assert widths[0] > widths[1] > widths[2]

    def test_of_nothing(self):
        assert all(math.isnan(v) for v in wilson_interval(np.zeros(0, dtype=bool)))


class TestMoreThanThePaper:
    @given(errors)
    def test_the_area_is_the_integral_of_recall(self, rows):
        steps = (np.arange(2000) + 0.5) / 2000
        for t in DEFAULT_THRESHOLDS:
            recalls = [
                np.mean(
                    [
                        e.translation_m < s * t.translation_m and e.rotation_deg < s * t.rotation_deg
                        for e in rows
                    ]
                )
                for s in steps[::40]
            ]
            coarse = 100 * np.mean(recalls)
            assert summarize(rows).auc[t.label] == pytest.approx(coarse, abs=2.1)

    def test_by_hand(self):
        rows = [PoseError(1.0, 0.2), PoseError(4.0, 1.0), FAILED]
        found = summarize(rows)
        assert found.answered_recall == {"2m-2deg": 50.0, "3m-3deg": 50.0, "5m-5deg": 100.0}
        assert found.auc["2m-2deg"] == pytest.approx(100 * 0.5 / 3)
        assert found.auc["5m-5deg"] == pytest.approx(100 * (0.8 + 0.2) / 3)

    def test_parts_come_from_the_poses(self):
        truth = Pose.from_euler(EulerAngles(40, 1, 179), [10, 20, 100])
        estimate = Pose.from_euler(EulerAngles(40, 1, -179), [13, 24, 98])
        parts = error_parts(estimate, truth)
        assert parts == pytest.approx((5.0, -2.0, 2.0))
        assert pose_error(estimate, truth).translation_m == pytest.approx(math.hypot(*parts[:2]))


def poses(count: int, seed: int) -> list[Pose]:
    generator = np.random.default_rng(seed)
    return [
        Pose.from_euler(
            EulerAngles(*generator.uniform((20, -2, -180), (60, 2, 180))), generator.uniform(-500, 500, 3)
        )
        for _ in range(count)
    ]


def disturbed(truth: Pose, generator: np.random.Generator) -> Pose:
    pitch, roll, yaw = truth.euler
    turn = generator.normal(0, 1.5, 3)
    return Pose.from_euler(
        EulerAngles(pitch + turn[0], roll + turn[1], yaw + turn[2]), truth.center + generator.normal(0, 2, 3)
    )


def test_a_slow_reading_of_the_text_gives_the_same_table():
    """From the text lines alone: scipy's rotations, arccos of the trace, counting by hand."""
    generator = np.random.default_rng(8)
    truths = poses(50, 1)
    estimates = [disturbed(truth, generator) for truth in truths]
    fast = summarize([pose_error(e, t) for e, t in zip(estimates, truths, strict=True)] + [FAILED] * 3)
    distances, angles = [], []
    for estimate, truth in zip(estimates, truths, strict=True):
        rows = [[float(word) for word in format_pose("q", pose).split()[1:]] for pose in (estimate, truth)]
        (r1, c1), (r2, c2) = (
            (r, -r.T @ np.array(t)) for r, t in ((matrix(row[:4]), row[4:]) for row in rows)
        )
        distances.append(math.sqrt(sum((a - b) ** 2 for a, b in zip(c1, c2, strict=True))))
        angles.append(math.degrees(math.acos(min(1.0, (np.trace(r2.T @ r1) - 1) / 2))))
    distances += [math.inf] * 3
    angles += [180.0] * 3
    for metres, degrees in ((2, 2), (3, 3), (5, 5)):
        found = sum(d < metres and a < degrees for d, a in zip(distances, angles, strict=True))
        assert fast.recall[f"{metres}m-{degrees}deg"] == pytest.approx(100 * found / 53)
    assert fast.median_translation_m == pytest.approx(sorted(distances)[26])
    assert fast.median_rotation_deg == pytest.approx(sorted(angles)[26], abs=1e-5)


def matrix(quat_wxyz: list[float]) -> np.ndarray:
    w, x, y, z = quat_wxyz
    return Rotation.from_quat([x, y, z, w]).as_matrix()


def test_evo_agrees_on_the_translation_errors_of_a_trajectory(tmp_path):
    file_interface = pytest.importorskip("evo.tools.file_interface")
    metrics = pytest.importorskip("evo.core.metrics")
    generator = np.random.default_rng(4)
    truths = poses(30, 2)
    estimates = [disturbed(truth, generator) for truth in truths]
    trajectories = []
    for name, trajectory in (("truth", truths), ("estimate", estimates)):
        path = tmp_path / f"{name}.tum"
        path.write_text("".join(tum_line(i, pose) for i, pose in enumerate(trajectory)))
        trajectories.append(file_interface.read_tum_trajectory_file(str(path)))
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data(tuple(trajectories))
    ours = [pose_error(e, t).translation_m for e, t in zip(estimates, truths, strict=True)]
    np.testing.assert_allclose(ours, ape.error, atol=1e-7)
    turns = metrics.APE(metrics.PoseRelation.rotation_angle_deg)
    turns.process_data(tuple(trajectories))
    ours = [pose_error(e, t).rotation_deg for e, t in zip(estimates, truths, strict=True)]
    np.testing.assert_allclose(ours, turns.error, atol=1e-5)


def tum_line(time: int, pose: Pose) -> str:
    w, x, y, z = pose.quat_wxyz
    center = " ".join(repr(float(v)) for v in pose.center)
    return f"{time} {center} {-x!r} {-y!r} {-z!r} {w!r}\n"


def test_parts_make_up_the_whole():
    generator = np.random.default_rng(9)
    for truth in poses(20, 3):
        estimate = disturbed(truth, generator)
        parts, whole = error_parts(estimate, truth), pose_error(estimate, truth)
        assert math.hypot(parts.horizontal_m, parts.vertical_m) == pytest.approx(whole.translation_m)
