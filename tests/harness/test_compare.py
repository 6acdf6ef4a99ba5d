"""Paired tests of runs, from their rows."""

import warnings
from types import SimpleNamespace

from lodbench.evaluation.pose_errors import DEFAULT_THRESHOLDS, FAILED, PoseError
from lodbench.evaluation.queries import ERROR, NO_TRUTH, queries_frame
from lodbench.geometry import Pose
from lodbench.harness.runs.compare import agreement, paired_comparison, require_same_queries


def run(*errors: PoseError) -> SimpleNamespace:
    rows = [
        {"query": f"{i}", "split": "a", **dict(zip(ERROR, error, strict=True))}
        for i, error in enumerate(errors)
    ]
    rows.append({"query": "0", "split": "without_truth", "failure": NO_TRUTH})
    return SimpleNamespace(queries=queries_frame(rows), summary={"splits": {"a": {}, "without_truth": {}}})


def test_rows_are_paired_by_name_and_a_split_without_a_truth_is_left_out():
    first, second = run(PoseError(1.0, 0.5), FAILED), run(PoseError(4.0, 0.5), PoseError(1.0, 1.0))
    second.queries = second.queries[::-1]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tests = paired_comparison(first, second, DEFAULT_THRESHOLDS)
    assert {row.split for row in tests} == {"a"}
    strict = tests[0]
    # One query is lost and one gained: nothing to choose between them.
    assert (strict.first, strict.second, strict.test.difference, strict.test.p) == (50.0, 50.0, 0.0, 1.0)
    assert tests[2].test.difference == 50.0


def answered(place_m: float, version: str = "1", error: PoseError | None = None) -> SimpleNamespace:
    """A run of one query, answered at a place along x; without an error the truth is not known."""
    found = {"failure": NO_TRUTH} if error is None else dict(zip(ERROR, error, strict=True))
    return SimpleNamespace(
        poses={"a/0": Pose.from_quaternion([1, 0, 0, 0], [place_m, 0, 0])},
        summary={"dataset": {"name": "town", "version": version}},
        queries=queries_frame([{"query": "0", "split": "a", **found}]),
    )


def test_answers_to_other_datasets_are_not_said_to_agree():
    assert agreement(answered(0.0), answered(0.0)).within == 1
    assert agreement(answered(0.0), answered(0.0, "2")) is None


def test_answers_to_photos_of_one_name_that_are_not_the_same_are_not_compared():
    """Two orbits of dataset=flights have the same names, and other truths 160 m apart."""
    near = PoseError(1.0, 0.0)
    assert agreement(answered(0.0, error=near), answered(160.0, error=near)) is None
    assert agreement(answered(0.0, error=near), answered(2.0, error=near)).median_m == 2.0
    # One of them far off, and where nobody knows the truth: that may be.
    assert agreement(answered(0.0, error=near), answered(160.0, error=PoseError(160.5, 0.0))).answered == 1
    assert agreement(answered(0.0), answered(160.0)).answered == 1


def test_runs_on_other_photos_are_not_tested():
    by_day, by_night, masks = (answered(0.0, error=PoseError(1.0, 0.0)) for _ in range(3))
    by_day.summary["dataset"]["images"], by_night.summary["dataset"]["images"] = "d", "n"
    assert require_same_queries(by_day, by_night) == "the photos differ"
    assert require_same_queries(by_day, masks) == require_same_queries(masks, by_night) == ""
