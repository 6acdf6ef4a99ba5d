from __future__ import annotations

import json
import math

import numpy as np
import pytest

from lodbench.bench.accuracy import draw_views, measure_accuracy, open_scenes, told_width
from lodbench.bench.accuracy_options import AccuracyOptions
from lodbench.bench.accuracy_report import AccuracyReport
from lodbench.errors import ConfigError
from lodbench.evaluation import PoseError
from lodbench.evaluation.errors import FAILED
from lodbench.evaluation.queries import ERROR, PRIOR_ERROR, queries_frame
from lodbench.methods.contour_alignment import ContourAlignment
from lodbench.methods.lodlocv2 import LodLocV2
from lodbench.methods.lodlocv2 import Params as LodLocV2Params
from lodbench.synthesis.mask_degradation import mask_iou
from lodbench.synthesis.view_sampling import FINE_SIZE, RGB_CAMERA


@pytest.fixture(scope="module")
def drawn(city):
    options = AccuracyOptions(num_views=3, threads=1)
    scorer, seen = open_scenes(city, options)
    return draw_views(scorer, seen, options, 0), scorer


class TestViews:
    def test_masks_are_as_wrong_as_asked(self, drawn):
        views, scorer = drawn
        for entry in views.dataset.entries:
            clean = scorer.render(RGB_CAMERA.scaled(*FINE_SIZE), views.dataset.truth[entry.key])
            mask = views.segmenter.segment(entry) >= 0.5
            assert mask.shape == (448, 602)
            assert mask_iou(mask, clean) == pytest.approx(0.88, abs=0.005)

    def test_priors_lie_in_the_asked_ranges(self, drawn):
        for entry in drawn[0].dataset.entries:
            truth = drawn[0].dataset.truth[entry.key]
            assert (np.abs(entry.prior.center - truth.center) <= np.array([10, 10, 30]) + 1e-9).all()
            turns = np.abs(np.subtract(entry.prior.euler, truth.euler))
            assert turns[0] <= 1 + 1e-6
            assert turns[1] <= 1 + 1e-6

    def test_more_views_keep_the_first_ones(self, drawn):
        views, scorer = drawn
        fewer = draw_views(scorer, scorer, AccuracyOptions(num_views=1, threads=1), 0)
        (entry,), first = fewer.dataset.entries, views.dataset.entries[0]
        np.testing.assert_array_equal(entry.prior.cam_from_world, first.prior.cam_from_world)
        np.testing.assert_array_equal(fewer.segmenter.segment(entry), views.segmenter.segment(first))

    def test_an_area_holds_what_its_views_look_at(self, drawn):
        scorer = drawn[1]
        middle_x = 0.5 * (scorer.scene.vertices[:, 0].min() + scorer.scene.vertices[:, 0].max())
        for area, sign in (("west", -1), ("east", 1)):
            options = AccuracyOptions(num_views=6, area=area, threads=1)
            for truth in draw_views(scorer, scorer, options, 0).dataset.truth.values():
                ray = truth.rotation[2]
                looked_at = truth.center + ray * (truth.center[2] / -ray[2])
                assert sign * (looked_at[0] - middle_x) > -15.0

    def test_a_true_tilt_has_no_width(self):
        prior = AccuracyOptions(tilt_deg=0.7).prior("truth")
        assert (prior.pitch_deg, prior.roll_deg) == (0.0, 0.0)
        assert AccuracyOptions(range_m=90.0, height_m=20.0).prior().z_m == 20.0


@pytest.fixture(scope="module")
def report(city):
    steps = []
    report = measure_accuracy(city, AccuracyOptions(num_views=2), lambda *step: steps.append(step))
    assert steps == [(1, 4), (2, 4), (3, 4), (4, 4)]
    return report


class TestMeasure:
    def test_two_blocks_of_every_view(self, report):
        assert list(report.of_tilt("truth")["query"]) == ["view_0000", "view_0001"]
        assert list(report.of_tilt("prior")["query"]) == ["view_0000", "view_0001"]
        assert (report.queries["hypotheses"] == 2425).all()
        assert (report.queries["score"] > 0.5).all()

    def test_does_not_depend_on_threads(self, city, report):
        one = measure_accuracy(city, AccuracyOptions(num_views=1, threads=1))
        for tilt in ("truth", "prior"):
            errors = [run.of_tilt(tilt).iloc[0][list(ERROR)].tolist() for run in (one, report)]
            assert errors[0] == errors[1]

    def test_text_says_what_was_drawn(self, report):
        text = report.to_text()
        for part in (
            "tilt=truth  prior",
            "tilt=prior  lodlocv2",
            "602 x 448",
            "IoU 0.88",
            "seed 0",
            "2 views",
        ):
            assert part in text


@pytest.fixture(scope="module")
def several(city):
    options = AccuracyOptions(num_views=1, seeds=(0, 1), tilt_deg=0.5, threads=1)
    return measure_accuracy(city, options, methods=[LodLocV2(LodLocV2Params(steps=1)), ContourAlignment()])


class TestSeveral:
    def test_every_method_runs_every_view_of_every_seed_under_both_tilts(self, several):
        assert len(several.queries) == 8
        for method in ("lodlocv2", "contour_alignment"):
            for tilt in ("truth", "prior"):
                assert list(several.of_tilt(tilt, method)["seed"]) == [0, 1]

    def test_seeds_draw_views_of_their_own(self, several):
        errors = several.of_tilt("prior", "lodlocv2")["prior_translation_error_m"]
        assert errors.nunique() == 2

    def test_only_who_says_a_probability_is_judged_by_it(self, several):
        assert list(several.calibrations()) == [
            "contour_alignment, tilt=truth",
            "contour_alignment, tilt=prior",
        ]
        assert "seeds 0, 1" in several.to_text()
        names = [figure.to_json()["figure"] for figure in several.figures()]
        assert len(set(names)) == len(names)

    def test_methods_are_told_the_width_of_the_tilt(self):
        told = told_width(ContourAlignment(), AccuracyOptions(tilt_deg=0.3).prior())
        assert told.params.range_tilt_deg == pytest.approx(0.6)
        assert told_width(told, AccuracyOptions(range_m=50.0).prior()).params.range_z_m == 100


def test_masks_of_one_level_are_found_in_the_map_of_another(tmp_path):
    boxes = [[-30, -20, 5, 10, 0, 12], [20, -35, 50, -5, 0, 20], [-10, 25, 30, 45, 0, 9]]
    city = tmp_path / "city.json"
    city.write_text(json.dumps(two_levels(boxes)))
    options = AccuracyOptions(num_views=1, mask_iou=1.0, mask_lod="2", map_lod="1", threads=1)
    report = measure_accuracy(city, options, methods=[ContourAlignment()])
    assert "(masks LoD2, map LoD1)" in report.city
    # The map's roofs are 3 m too low: with masks of its own level the fit would be perfect.
    assert 0.5 < report.of_tilt("truth")["score"].iloc[0] < 0.99


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
        "split": "all",
        "tilt": tilt,
        "score": score,
        "hypotheses": hypotheses,
        "mask_iou": 0.88,
    }
    pairs = [*zip(ERROR, error, strict=True), *zip(PRIOR_ERROR, (15.0, 4.0), strict=True)]
    return {**rows, **dict(pairs), "failure": "" if error != FAILED else "lost"}


class TestReport:
    REPORT = AccuracyReport(
        "city.obj",
        ("lodlocv2",),
        "protocol",
        3,
        queries_frame(
            (
                outcome("truth", PoseError(0.5, 0.1)),
                outcome("truth", PoseError(9.0, 0.1), score=0.5),
                outcome("prior", PoseError(2.5, 0.1)),
                outcome("prior", FAILED, score=None, hypotheses=0),
            )
        ).assign(method="lodlocv2", seed=0, seconds=0.5),
    )

    def test_failures_count(self):
        assert self.REPORT.summary("truth").recall["2m-2deg"] == 50
        assert self.REPORT.summary("prior").recall["3m-3deg"] == 50
        assert self.REPORT.summary("prior").num_failed == 1
        assert self.REPORT.summary("prior").hypotheses_per_query == 2425

    def test_text_tells_search_from_ambiguity(self):
        assert "tilt=truth: 1 not within (2 m, 2 deg); in 1 of them the truth fits" in self.REPORT.to_text()

    def test_figures_are_json(self):
        figures = [figure.to_json() for figure in self.REPORT.figures()]
        json.dumps(figures, allow_nan=False)
        names = [figure["figure"] for figure in figures]
        assert len(set(names)) == len(names)
        recall = next(f for f in figures if f["figure"] == "recall 2m-2deg tilt=truth")
        assert (recall["value"], recall["unit"], recall["peer"], recall["peer_value"]) == (
            50.0,
            "%",
            "prior",
            0,
        )
        median = next(f for f in figures if f["figure"] == "median_translation_m tilt=prior")
        assert median["value"] is None


@pytest.mark.parametrize(
    "values",
    [
        {"num_views": 0},
        {"mask_iou": 0.0},
        {"mask_iou": 1.2},
        {"tilt_deg": -1.0},
        {"tilt_deg": math.nan},
        {"seeds": ()},
        {"seeds": (1, 1)},
        {"area": "middle"},
    ],
)
def test_options_that_make_no_sense(values):
    with pytest.raises(ConfigError, match=next(iter(values))):
        AccuracyOptions(**values)
