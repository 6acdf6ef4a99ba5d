"""Redrawn priors: who starts where, what is counted, and the command from end to end."""

from __future__ import annotations

import json
import math

import numpy as np
import pandas as pd
import pytest

from lodbench.bench.real_report import flagged, found, held, report_real
from lodbench.cli.bench import main
from lodbench.evaluation.queries import ERROR
from lodbench.evaluation.recall import Threshold
from tests.town import write_dataset


def trials(*ends):
    """Returns trials of one method that end so many metres and degrees off, with their probabilities."""
    rows = [dict(zip((*ERROR, "probability"), end, strict=True)) for end in ends]
    common = {
        "photo": "photo.jpg",
        "prior": "0",
        "score": 0.1,
        "seconds": 1.0,
        "cpu_seconds": 1.0,
        "surprise": math.nan,
        "failure": "",
    }
    common |= {"prior_translation_error_m": 20.0, "prior_rotation_error_deg": 3.0}
    return pd.DataFrame(rows).assign(method="m", **common)


class TestTheReport:
    def test_wrong_answers_are_flagged_by_what_right_ones_pass(self):
        right = [(1.0, 0.1, p) for p in np.linspace(0.5, 1.0, 11)]
        # The lowest tenth of the right ones lies below 0.55.
        wrong = [(9.0, 0.1, p) for p in (0.1, 0.2, 0.54, 0.9)]
        assert flagged(trials(*right, *wrong)) == 0.75
        assert flagged(trials(*right)) is None
        assert flagged(trials(*right, (9.0, 0.1, math.nan))) is None

    def test_places_are_held_by_what_was_said_of_them(self):
        ends = trials(*[(1.0, 0.1, 0.5)] * 4)
        assert held(ends) is None
        assert "places within" not in str(report_real(ends, "data").figures)
        # Squared standard deviations in three directions: 95 % stay below 7.81; one answer said nothing.
        said = ends.assign(surprise=[0.5, 7.8, 7.9, math.nan])
        assert held(said).tolist() == [True, True, False]
        report = report_real(said, "data")
        figures = {f.figure: f.value for f in report.figures}
        assert figures["m: places within the said 95 %"] == pytest.approx(200 / 3)
        assert "67 %" in report.text

    def test_intervals_are_over_photos(self):
        ends = trials((1.0, 0.1, 0.5), (1.0, 0.1, 0.5), (9.0, 0.1, 0.5), (9.0, 0.1, 0.5))
        one, two = (
            report_real(each, "data").text.splitlines()
            for each in (
                ends,
                ends.assign(photo=["a", "a", "b", "b"]),
            )
        )
        # One photo says nothing of others; of two that are wholly right and wholly wrong, all may be.
        assert " to " not in one[2]
        assert "0 to 100 %" in two[2]

    def test_limits_are_strict_and_failures_count(self):
        ends = trials((1.9, 0.1, 0.5), (2.0, 0.1, 0.5), (1.0, 1.5, 0.5), (math.inf, 180.0, 0.0))
        assert found(ends, Threshold(2, 1)).tolist() == [True, False, False, False]
        assert found(ends, Threshold(2, 2)).tolist() == [True, False, True, False]
        figures = {f.figure: f.value for f in report_real(ends, "data").figures}
        assert figures["m: recall 2m-2deg"] == 50.0
        assert figures["m: priors"] == 4.0


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("real"))


@pytest.mark.slow
def test_methods_start_from_the_same_priors_and_better_ones_end_nearer(town, tmp_path, capsys):
    root, city = town
    asked = ["real", "--query", str(root), "--city", str(city), "--priors", "2", "--pictures", str(tmp_path)]
    assert main([*asked, "--method", "prior_only,lodlocv2", "--json"]) == 0
    lines = capsys.readouterr().out.splitlines()
    figures = {
        f["figure"]: f["value"] for f in map(json.loads, (line for line in lines if line.startswith("{")))
    }
    # Two drawn priors and the published one, for each of three photos.
    assert figures["prior_only: priors"] == 9
    assert figures["prior_only: recall 2m-1deg"] == 0
    assert figures["lodlocv2: priors"] == 9
    assert figures["lodlocv2: median translation"] < figures["prior_only: median translation"] / 2
    assert (tmp_path / "basins.png").read_bytes().startswith(b"\x89PNG")
    assert main([*asked, "--method", "prior_only", "--prior-range", "50"]) == 0
    text = capsys.readouterr().out
    assert "+-50/50/30 m" in text
    assert "published" not in text


def test_what_is_refused(town, tmp_path, capsys):
    root, city = town
    from lodbench.cli import main as lodbench

    for wrong, words in (
        (["--city", str(tmp_path / "none.gml")], "does not exist"),
        (["--city", str(city), "--priors", "0"], "not a number of priors"),
        (["--city", str(city), "--method", "nobody"], "nobody"),
    ):
        assert lodbench(["bench", "real", "--query", str(root), *wrong]) == 2
        assert words in capsys.readouterr().err
