import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from lodbench.evaluation import DEFAULT_THRESHOLDS, PoseError, Threshold, pose_error, summarize
from lodbench.evaluation.errors import FAILED, error_parts
from lodbench.evaluation.statistics import wilson_interval
from lodbench.geometry import EulerAngles, Pose

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
