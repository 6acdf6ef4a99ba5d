"""Recall, calibration and their tables over seeded views, of one city and of several."""

import json
import shutil

import pytest

from lodbench.bench import Report
from lodbench.bench.accuracy import (
    blocks_of,
    measure_accuracy,
    measure_cities,
    names_of,
    report_accuracy,
    with_prior_range,
)
from lodbench.cli import bench_views, main
from lodbench.errors import ConfigError, DatasetError
from lodbench.evaluation import PoseError
from lodbench.evaluation.metrics import ERROR, PRIOR_ERROR, queries_frame
from lodbench.evaluation.pose_errors import FAILED
from lodbench.methods.contour_alignment import ContourAlignment
from lodbench.methods.lodlocv2 import LodLocV2, LodLocV2Params
from lodbench.methods.registry import make_method
from lodbench.synthesis.views_dataset import SPLIT, ViewsParams
from tests.town import box_obj


def of_tilt(report, tilt, method="lodlocv2"):
    return report.data.query("tilt == @tilt and method == @method")


@pytest.fixture(scope="module")
def report(city):
    steps = []
    views = ViewsParams(str(city), num_views=2)
    report = measure_accuracy(views, [0], [LodLocV2()], lambda *step: steps.append(step))
    assert steps == [(1, 2), (2, 2)]
    return report


class TestMeasure:
    def test_two_blocks_of_every_view(self, report):
        assert list(of_tilt(report, "truth")["query"]) == ["view_0000.png", "view_0001.png"]
        assert list(of_tilt(report, "prior")["query"]) == ["view_0000.png", "view_0001.png"]
        assert (report.data["hypotheses"] == 2425).all()
        assert (report.data["score"] > 0.5).all()

    def test_both_tilts_try_the_same_moves(self, city):
        exact = ViewsParams(str(city), num_views=1, tilt_deg=0.0)
        errors = measure_accuracy(exact, [0], [LodLocV2()], threads=1).data[list(ERROR)].to_numpy()
        assert errors[0] == pytest.approx(errors[1], abs=1e-6)

    def test_does_not_depend_on_threads(self, city, report):
        one = measure_accuracy(ViewsParams(str(city), num_views=1), [0], [LodLocV2()], threads=1)
        for tilt in ("truth", "prior"):
            errors = [of_tilt(run, tilt).iloc[0][list(ERROR)].tolist() for run in (one, report)]
            assert errors[0] == errors[1]

    def test_text_says_what_was_drawn(self, report):
        for part in (
            "tilt=truth  prior",
            "tilt=prior  lodlocv2",
            "602 x 448",
            "IoU 0.88",
            "seed 0",
            "2 views",
        ):
            assert part in report.text


@pytest.fixture(scope="module")
def several(city):
    views = ViewsParams(str(city), num_views=1, tilt_deg=0.5)
    return measure_accuracy(views, [0, 1], [LodLocV2(LodLocV2Params(steps=1)), ContourAlignment()], threads=1)


class TestSeveral:
    def test_every_method_runs_every_view_of_every_seed_under_both_tilts(self, several):
        assert len(several.data) == 8
        for method in ("lodlocv2", "contour_alignment"):
            for tilt in ("truth", "prior"):
                assert list(of_tilt(several, tilt, method)["seed"]) == [0, 1]

    def test_seeds_draw_views_of_their_own(self, several):
        assert of_tilt(several, "prior")["prior_translation_error_m"].nunique() == 2

    def test_only_who_says_a_probability_is_judged_by_it(self, several):
        assert "seeds 0, 1" in several.text
        names = [figure.to_json()["figure"] for figure in several.figures]
        assert len(set(names)) == len(names)
        for what in ("mean probability", "calibration error"):
            assert [name for name in names if name.startswith(what)] == [
                f"{what} contour_alignment tilt=truth",
                f"{what} contour_alignment tilt=prior",
            ]

    def test_calibration_is_drawn(self, several, report, tmp_path):
        several.write_pictures(tmp_path / "new")
        assert sorted(path.name for path in (tmp_path / "new").iterdir()) == [
            "calibration.png",
            "calibration.svg",
        ]
        report.write_pictures(tmp_path / "none")
        assert not (tmp_path / "none").exists()

    def test_methods_are_told_the_width_of_the_tilt(self):
        told = with_prior_range(ContourAlignment(), ViewsParams("city.obj", tilt_deg=0.3).prior())
        assert told.params.range_tilt_deg == pytest.approx(0.6)
        wide = ViewsParams("city.obj", range_m=50.0).prior()
        assert with_prior_range(told, wide).params.range_z_m == 100


def test_masks_of_one_level_are_found_in_the_map_of_another(tmp_path):
    boxes = [[-30, -20, 5, 10, 0, 12], [20, -35, 50, -5, 0, 20], [-10, 25, 30, 45, 0, 9]]
    city = tmp_path / "city.json"
    city.write_text(json.dumps(two_levels(boxes)))
    views = ViewsParams(str(city), num_views=1, mask_iou=1.0, mask_lod="2", lod="1")
    report = measure_accuracy(views, [0], [ContourAlignment()], threads=1)
    assert "(masks LoD2, map LoD1)" in report.text
    # The map's roofs are 3 m too low: with masks of its own level the fit would be perfect.
    assert 0.5 < of_tilt(report, "truth", "contour_alignment")["score"].iloc[0] < 0.99


def two_levels(boxes):
    """Returns CityJSON of boxes whose level 1 is 3 m lower than level 2."""
    vertices, objects = [], {}
    for number, (west, south, east, north, base, top) in enumerate(boxes):
        geometry = []
        for lod, roof in (("1", top - 3), ("2", top)):
            first = len(vertices)
            corners = ((west, south), (east, south), (east, north), (west, north))
            vertices += [[x, y, z] for z in (base, roof) for x, y in corners]
            sides = [(first + i, first + (i + 1) % 4) for i in range(4)]
            walls = [[[left, right, right + 4, left + 4]] for left, right in sides]
            surfaces = [*walls, [[first + 4 + i for i in range(4)]]]
            geometry.append({"type": "MultiSurface", "lod": lod, "boundaries": surfaces})
        objects[f"b{number}"] = {"type": "Building", "geometry": geometry}
    return {
        "type": "CityJSON",
        "version": "2.0",
        "transform": {"scale": [1, 1, 1], "translate": [0, 0, 0]},
        "CityObjects": objects,
        "vertices": vertices,
    }


def outcome(tilt, error, score=0.9, hypotheses=2425):
    rows = {
        "query": "v",
        "split": SPLIT,
        "tilt": tilt,
        "score": score,
        "hypotheses": hypotheses,
        "mask_iou": 0.88,
    }
    pairs = [*zip(ERROR, error, strict=True), *zip(PRIOR_ERROR, (15.0, 4.0), strict=True)]
    return {**rows, **dict(pairs), "failure": "" if error != FAILED else "lost"}


class TestReport:
    QUERIES = queries_frame(
        (
            outcome("truth", PoseError(0.5, 0.1)),
            outcome("truth", PoseError(9.0, 0.1), score=0.5),
            outcome("prior", PoseError(2.5, 0.1)),
            outcome("prior", FAILED, score=None, hypotheses=0),
        )
    ).assign(method="lodlocv2", seed=0, seconds=0.5)

    def test_failures_count(self):
        truth, prior = (block.summary for block in blocks_of(self.QUERIES))
        assert truth.recall["2m-2deg"] == 50
        assert prior.recall["3m-3deg"] == 50
        assert prior.num_failed == 1
        assert prior.hypotheses_per_query == 2425

    def test_text_tells_search_from_ambiguity(self):
        text = report_accuracy(self.QUERIES, "protocol").text
        assert "tilt=truth: 1 not within (2 m, 2 deg); in 1 of them the truth fits" in text

    def test_figures_are_json(self):
        figures = [figure.to_json() for figure in report_accuracy(self.QUERIES, "protocol").figures]
        json.dumps(figures, allow_nan=False)
        names = [figure["figure"] for figure in figures]
        assert len(set(names)) == len(names)
        recall = next(f for f in figures if f["figure"] == "recall 2m-2deg tilt=truth")
        assert [recall[key] for key in ("value", "unit", "peer", "peer_value")] == [50.0, "%", "prior", 0]
        median = next(f for f in figures if f["figure"] == "median_translation_m tilt=prior")
        assert median["value"] is None


@pytest.mark.parametrize("seeds", [[], [1, 1]])
def test_seeds_that_make_no_sense(city, seeds):
    with pytest.raises(ConfigError, match="seeds"):
        measure_accuracy(ViewsParams(str(city)), seeds, [LodLocV2()])


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
