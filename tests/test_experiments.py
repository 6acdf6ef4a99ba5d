"""Experiments run from a checkout: one each, over a few boxes."""

import json
import runpy
import sys

import pytest

from experiments.scale import slope_points
from tests.town import box_obj

# Of each: its options, and figures among those that it prints.
EXPERIMENTS = {
    "wide_priors": (
        "--city CITY --views 1 --prior-range 20 --prior-height 15",
        {"hypotheses of basins", "views whose searches end in one optimum"},
    ),
    "causes": (
        "--city CITY --views 1 --method prior_only --limit 20",
        {"found place known prior_only boxes.obj", "found best linear prior_only boxes.obj"},
    ),
    "budget": ("--city CITY --views 1", {"recall 2m-2deg of lodlocv2 at 504 hypotheses"}),
    "reconstructions": (
        "--city CITY --photos 5 --path orbit --mask-iou 0.97",
        {"median error of a camera, median of flights", "flights placed"},
    ),
    "scale": (
        "--buildings 2300 --views 2 --hypotheses 14",
        {"opening", "hypotheses that count differently, footprint in the core"},
    ),
    "scale.slopes": (
        "--hypotheses 1000 --buildings 1000 --tiled 1000 --queries 100 --workers 1",
        {
            "slope over hypotheses",
            "peak memory, image width, px 1,200",
            "slope over workers, 16,000 hypotheses",
        },
    ),
}


@pytest.fixture
def city(tmp_path):
    boxes = [
        (x - 18, y - 15, x + 10 + (x * 7 + y) % 9, y + 14, 0, 10 + (3 * x + y) % 17)
        for x in range(-150, 151, 50)
        for y in range(-150, 151, 50)
    ]
    path = tmp_path / "boxes.obj"
    path.write_text(box_obj(boxes))
    return path


@pytest.mark.nightly
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_it_prints_its_figures(name, city, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path / "cache"))
    # Processes take seconds to start.
    monkeypatch.setattr(slope_points, "_apart", slope_points._cost)
    words, expected = EXPERIMENTS[name]
    monkeypatch.setattr(sys, "argv", [name, *words.replace("CITY", str(city)).split(), "--json"])
    with pytest.raises(SystemExit) as left:
        runpy.run_module(f"experiments.{name}", run_name="__main__")
    assert left.value.code == 0
    figures = {
        each["figure"]: each["value"] for each in map(json.loads, capsys.readouterr().out.splitlines())
    }
    assert expected <= set(figures)
    assert figures.get("hypotheses that count differently, footprint in the core", 0) == 0
    assert figures.get("flights placed", 1) == 1


def test_a_fault_is_one_line_and_a_hint(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["causes", "--limit", "3"])
    with pytest.raises(SystemExit) as left:
        runpy.run_module("experiments.causes", run_name="__main__")
    assert left.value.code == 2
    assert "hint: Write --limit 200." in capsys.readouterr().err
