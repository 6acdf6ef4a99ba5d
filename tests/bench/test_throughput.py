"""`lodbench bench evaluation` and `training-data`, from end to end."""

import pytest

from lodbench.bench.throughput import (
    EvaluationOptions,
    TrainingDataOptions,
    measure_evaluation,
    measure_training_data,
)
from lodbench.errors import ConfigError
from tests.town import box_obj


def test_the_bench_scores_reads_and_reports():
    steps = []
    report = measure_evaluation(EvaluationOptions(30, 2), lambda *step: steps.append(step))
    assert steps == [(1, 2), (2, 2)]
    assert all(figure.value > 0 for figure in report.figures)
    assert "30 queries, 2 methods" in report.text


def test_nothing_to_measure_is_refused():
    with pytest.raises(ConfigError):
        EvaluationOptions(0, 5)


@pytest.mark.slow
def test_the_bench_reports_every_figure(tmp_path):
    city = tmp_path / "city.obj"
    city.write_text(box_obj())
    report = measure_training_data(city, TrainingDataOptions(views=2, workers=1))
    titles = [figure.figure for figure in report.figures]
    assert len(titles) == len(set(titles)) == 7
    assert all(figure.value > 0 for figure in report.figures if figure.unit in ("/s", "ms"))
    assert "pyrender" in report.figures[0].peer
    assert all(title in report.text for title in titles)
