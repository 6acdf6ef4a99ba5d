import pytest

from lodbench.bench.training_data import TrainingDataOptions, measure_training_data
from tests.town import box_obj


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
