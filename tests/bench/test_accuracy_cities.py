import math
import shutil

import numpy as np
import pandas as pd
import pytest

from lodbench.bench.accuracy import measure_cities, names_of, share_rejectable, share_rejected
from lodbench.bench.report import Report
from lodbench.cli import bench_views, main
from lodbench.errors import DatasetError
from lodbench.evaluation.queries import ERROR
from lodbench.methods.contour_alignment import ContourAlignment
from lodbench.methods.registry import make_method
from lodbench.synthesis.views_dataset import ViewsParams
from tests.town import box_obj


def answers(*rows):
    errors, given = np.array([row[0] for row in rows]), [row[1] for row in rows]
    return pd.DataFrame({ERROR[0]: errors, ERROR[1]: np.zeros(len(rows)), "probability": given})


class TestRejected:
    def test_wrong_answers_below_nine_tenths_of_the_right_ones(self):
        right = [(0.5, 0.1 * k) for k in range(1, 11)]
        # 90 % of the right ones are kept from 0.19 on.
        assert share_rejected(
            answers(*right, (5.0, 0.18), (5.0, 0.2), (math.inf, math.nan))
        ) == pytest.approx(2 / 3)

    def test_nothing_to_say_without_right_or_without_wrong_ones(self):
        assert math.isnan(share_rejected(answers((0.5, 0.9))))
        assert math.isnan(share_rejected(answers((5.0, 0.9))))


class TestRejectable:
    def test_answers_as_sure_as_each_other_cannot_be_told_apart(self):
        assert share_rejectable(answers(*10 * [(0.5, 0.5)])) == pytest.approx(0.1)
        assert share_rejectable(answers(*5 * [(0.5, 1.0)], *5 * [(9.0, 0.0)])) == 1.0
        assert math.isnan(share_rejectable(answers((0.5, 1.0))))

    def test_is_what_is_rejected_where_answers_are_right_as_often_as_they_say(self):
        generator = np.random.default_rng(7)
        given = generator.beta(1.5, 0.7, 40_000)
        errors = np.where(generator.random(len(given)) < given, 0.5, 9.0)
        drawn = answers(*zip(errors, given, strict=True))
        assert share_rejectable(drawn) == pytest.approx(share_rejected(drawn), abs=0.01)
        assert 0.3 < share_rejectable(drawn) < 0.9


def test_cities_whose_files_are_called_alike_are_told_apart():
    """A folder per town with a `city.gml` in each: their views were one row."""
    cities = [ViewsParams(path) for path in ("a/city.gml", "b/city.gml", "b/other.gml")]
    assert list(names_of(cities).values()) == ["a/city.gml", "b/city.gml", "other.gml"]


def test_a_row_for_every_city_and_the_reason_for_one_that_has_none(city, tmp_path):
    twin = tmp_path / city.name
    shutil.copy(city, twin)
    views = [ViewsParams(str(path), num_views=1) for path in (city, twin, tmp_path / "absent.gml")]
    report = measure_cities(views, [0], [ContourAlignment()], threads=1)
    assert list(report.data["city"]) == 2 * [str(city), str(twin)]
    for part in (str(city), str(twin), "mean of 2", "absent.gml is left out: "):
        assert part in report.text
    means = {f.figure: f.value for f in report.figures if f.figure.startswith("mean recall")}
    # The same views of the same city, twice.
    alone = {f.figure: f.value for f in report.figures if f.figure.endswith(str(city))}
    assert list(means.values()) == list(alone.values())
    with pytest.raises(DatasetError, match="No city is left"):
        measure_cities(views[2:], [0], [ContourAlignment()])


def test_a_city_or_a_method_named_twice_counts_once(city, monkeypatch):
    asked = []
    monkeypatch.setattr(bench_views, "measure_accuracy", lambda *given: asked.append(given) or Report("", []))
    words = ["bench", "accuracy", "--city", str(city), "--city", str(city), "--method", "region,region"]
    assert main([*words, "--views", "1", "--look", "hard"]) == 0
    ((views, _, methods, *_),) = asked
    assert (views.city_model, [method.name for method in methods]) == (str(city), ["region"])
    assert views.look == "hard"


def test_a_lone_house_is_flown_over_lower(tmp_path, capsys):
    house = tmp_path / "house.obj"
    house.write_text(box_obj([(0, 0, 10, 8, 0, 6)]))
    words = ["bench", "accuracy", "--city", str(house), "--views", "1", "--method", "prior_only"]
    assert main(words) == 2
    assert "hint: Set --camera-height [40,80] to fly lower" in capsys.readouterr().err
    low = ["--camera-height", "[30,50]", "--building-share", "0.02,0.8"]
    assert main([*words, *low]) == 0
    assert "1 view (" in capsys.readouterr().out


@pytest.mark.slow
def test_pixels_and_masks_are_measured_side_by_side_on_the_same_views(city):
    views = ViewsParams(str(city), num_views=1, look="plain")
    report = measure_cities([views], [0], [make_method("region"), ContourAlignment()], threads=1)
    table = report.data.set_index(["tilt", "method"])
    assert set(table.index) == {(t, m) for t in ("truth", "prior") for m in ("region", "contour_alignment")}
    for _, of_tilt in table.groupby("tilt"):
        assert of_tilt["prior_translation_error_m"].nunique() == 1
