"""Stored runs beside each other: paired tests, lines of methods, names of rows; a run's search."""

import re
import warnings
from types import SimpleNamespace

import pandas as pd
import pytest

from lodbench.evaluation.metrics import ERROR, NO_TRUTH, queries_frame
from lodbench.evaluation.pose_errors import DEFAULT_THRESHOLDS, FAILED, PoseError
from lodbench.evaluation.predictions import Prediction
from lodbench.geometry import Pose
from lodbench.harness.runs import report as trace_pictures
from lodbench.harness.runs.artefacts import variant_of
from lodbench.harness.runs.compare import agreement, budget_panels, paired_comparison, require_same_queries
from lodbench.harness.runs.report import evidence_pictures, score_pictures


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


def run_of(recall: float | None, hypotheses: float, version: str = "1", **protocol: str) -> SimpleNamespace:
    bounds = [None, None] if recall is None else [recall - 5, recall + 5]
    scored = {
        "num_queries": 20,
        "recall": {"2m-2deg": recall},
        "recall_interval_95": {"2m-2deg": bounds},
        "hypotheses_per_query": hypotheses,
    }
    said = {"tilt": "prior", "segmenter": "masks", "lod": "1", "prior": "file", **protocol}
    method = {"name": "ours", "variant": "full", "params": {"steps": hypotheses, "fit": "iou"}}
    dataset = {"name": "town", "version": version}
    return SimpleNamespace(
        summary={"dataset": dataset, "method": method, "protocol": said, "splits": {"a": scored}}
    )


def test_runs_of_other_masks_levels_and_priors_are_other_lines():
    few, many = run_of(50, 100), run_of(90, 1000)
    assert list(budget_panels([many, few])["town, a, tilt=prior"]) == ["ours"]
    for other, name in (
        ({"segmenter": "compact"}, "compact"),
        ({"lod": "2.2"}, "LoD2.2"),
        ({"prior": "uniform around the truth"}, "priors uniform around the truth"),
    ):
        (curves,) = budget_panels([few, many, run_of(20, 500, **other)]).values()
        assert sorted(map(len, curves.values())) == [1, 2]
        assert [len(points) for line, points in curves.items() if name in line] == [1]


def test_runs_over_other_data_of_one_version_are_other_lines():
    """As views of one seed with priors of another width: their recalls are no curve."""
    near, far = run_of(90, 100), run_of(50, 100)
    for each, range_m, limit in ((near, 10.0, None), (far, 50.0, 5)):
        each.summary["settings"] = {"range_m": range_m, "limit": limit}
    assert list(budget_panels([near, far])["town, a, tilt=prior"]) == [
        "ours range_m=10.0",
        "ours range_m=50.0",
    ]


def test_two_versions_of_a_dataset_share_no_panel():
    assert list(budget_panels([run_of(50, 100), run_of(90, 1000, "2")])) == [
        "town (1), a, tilt=prior",
        "town (2), a, tilt=prior",
    ]


def test_a_split_without_a_truth_has_no_point():
    half = run_of(50, 100)
    half.summary["splits"]["b"] = run_of(None, 100).summary["splits"]["a"]
    assert list(budget_panels([half])) == ["town, a, tilt=prior"]


@pytest.mark.parametrize(
    ("method", "variant"),
    [
        ({"name": "prior_only"}, ""),
        ({"name": "lodlocv2", "variant": "full"}, "full"),
        ({"name": "uavd4l", "matcher": "sift_nn"}, "sift_nn"),
        ({"name": "mcloc", "features": "hog", "variant": "full"}, "hog"),
        ({"name": "mcloc", "features": "hog", "variant": "no_select"}, "hog no_select"),
    ],
)
def test_a_variant_names_what_differs(method, variant):
    assert variant_of(method) == variant


STEPS = {"coarse": [0.5], "fine": [0.1, 0.4, 0.6]}
EVIDENCE = {
    "coarse": [0.5],
    "evidence [nats]": [-7000.0, -7004.0, -7900.0],
    "signs [as of x]": [1.0, 2.0, 3.0],
}


@pytest.fixture
def shown(monkeypatch):
    """Returns the two pictures of one query of the gallery with a trace, as SVG; None of those not drawn."""

    def draw(trace):
        rows = pd.DataFrame(index=["a/1.jpg"])
        chosen = {"best": rows.iloc[:0], "worst": rows}
        monkeypatch.setattr(trace_pictures, "chosen_queries", lambda *_: chosen)
        monkeypatch.setattr(
            trace_pictures, "open_predictions", lambda *_, **__: {"a/1.jpg": {"trace": trace}}
        )
        kept = Prediction(None, trace={name: tuple(values) for name, values in trace.items()})
        found = (score_pictures(SimpleNamespace(), rows, ["a"]), evidence_pictures({"a/1.jpg": kept}))
        return [picture[0].content.decode() if picture else None for picture in found]

    return draw


def test_scores_are_drawn_step_by_step(shown):
    scores, evidence = shown(STEPS)
    assert ">score<" in scores
    assert evidence is None


def test_evidence_is_no_score(shown):
    scores, evidence = shown(EVIDENCE)
    assert scores is None
    assert ">nats behind the best<" in evidence
    assert "signs" not in evidence
    assert "mathdefault" not in evidence
    assert ">1.5<" not in evidence


def test_every_query_with_other_candidates_is_drawn_the_closest_call_first():
    def answer(*nats):
        return Prediction(None, trace={"evidence [nats]": nats})

    asked = {"a/far": answer(9.0, 0.0), "a/alone": answer(9.0), "a/near": answer(9.0, 8.5, 1.0)}
    (picture,) = evidence_pictures(asked)
    drawn = picture.content.decode()
    assert "a/alone" not in drawn
    assert drawn.index(">a/near<") < drawn.index(">a/far<")
    assert picture.caption.startswith("2 queries with more than one candidate, of 3:")
    many = {f"a/{number:03}": answer(9.0, 8.0 - number) for number in range(70)}
    (picture,) = evidence_pictures(many)
    assert picture.caption.startswith("The 60 closest of 70 queries with more than one candidate, of 70:")
    assert ">a/059<" in picture.content.decode()
    assert ">a/060<" not in picture.content.decode()


@pytest.mark.parametrize("behind", [2.859213, 0.136153, 10.0, 7900.0])
def test_ticks_of_evidence_are_round_numbers(behind):
    (picture,) = evidence_pictures({"a": Prediction(None, trace={"evidence [nats]": (0.0, -behind)})})
    labels = re.findall(r">(-?[\d.]+)</text>", picture.content.decode())
    assert len(labels) >= 4
    assert all(len(label.strip("0.")) <= 2 and float(label) <= behind + 2 for label in labels)
