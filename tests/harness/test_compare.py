"""Paired tests of runs, from their rows."""

from __future__ import annotations

import warnings
from types import SimpleNamespace

from lodbench.evaluation.errors import FAILED, PoseError
from lodbench.evaluation.queries import ERROR, NO_TRUTH, queries_frame
from lodbench.evaluation.recall import DEFAULT_THRESHOLDS
from lodbench.geometry import Pose
from lodbench.harness.runs.compare import agreement, paired_comparison


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


def test_answers_to_other_datasets_are_not_said_to_agree():
    def answered(version: str) -> SimpleNamespace:
        poses = {"a/0": Pose.from_quaternion([1, 0, 0, 0], [0, 0, 0])}
        return SimpleNamespace(poses=poses, summary={"dataset": {"name": "town", "version": version}})

    assert agreement(answered("1"), answered("1")).within == 1
    assert agreement(answered("1"), answered("2")) is None
