import pytest

from lodbench.bench.evaluation import EvaluationOptions, measure_evaluation
from lodbench.errors import ConfigError


def test_the_bench_scores_reads_and_reports():
    steps = []
    report = measure_evaluation(EvaluationOptions(30, 2), lambda *step: steps.append(step))
    assert steps == [(1, 2), (2, 2)]
    assert all(figure.value > 0 for figure in report.figures)
    assert "30 queries, 2 methods" in report.text


def test_nothing_to_measure_is_refused():
    with pytest.raises(ConfigError):
        EvaluationOptions(0, 5)
