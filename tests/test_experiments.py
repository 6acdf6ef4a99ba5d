"""Experiments run from a checkout: one each, over a few boxes."""

import json
import runpy
import sys

import cv2
import numpy as np
import pytest

from experiments.guided_masks.silhouettes import Disturbance, disturbed
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
    "heights_by_photos": (
        "--city CITY --photos 8 --path orbit",
        {"median error of a height, orbit 0", "heights measured, orbit 0"},
    ),
    "city_make": ("--buildings 90 --side-m 100", {"city make", "buildings made", "heights within 0.5 m"}),
    "files_run": ("--city CITY", {"open_scene: files whose functions are called"}),
    "flight_workers": ("--photos 2", {"photos a minute"}),
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
        runpy.run_module(f"experiments.{name}", run_name="__main__", alter_sys=True)
    assert left.value.code == 0
    figures = {
        each["figure"]: each["value"] for each in map(json.loads, capsys.readouterr().out.splitlines())
    }
    assert expected <= set(figures)
    assert figures.get("hypotheses that count differently, footprint in the core", 0) == 0
    assert figures.get("flights placed", 1) == 1
    assert figures.get("buildings made", 90) == 90


def test_a_fault_is_one_line_and_a_hint(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["causes", "--limit", "3"])
    with pytest.raises(SystemExit) as left:
        runpy.run_module("experiments.causes", run_name="__main__", alter_sys=True)
    assert left.value.code == 2
    assert "hint: Write --limit 200." in capsys.readouterr().err


@pytest.fixture
def experiment(monkeypatch):
    """Runs an experiment with some words; returns its exit code."""

    def run(name, *words):
        monkeypatch.setattr(sys, "argv", [name, *words])
        with pytest.raises(SystemExit) as left:
            runpy.run_module(f"experiments.{name}", run_name="__main__", alter_sys=True)
        return left.value.code

    return run


@pytest.mark.parametrize(
    ("value", "words"),
    [("20", "is not PX,DEG"), ("2000,1", "is not within"), ("20,2 --draws 0", "--draws 0")],
)
def test_silhouettes_that_cannot_be(experiment, tmp_path, capsys, value, words):
    assert experiment("guided_masks", "--photos", str(tmp_path), "--guided-by", *value.split()) == 2
    assert words in capsys.readouterr().err


@pytest.fixture
def farm(tmp_path):
    """A photo of two houses on grass, 240 x 180, and one without any."""
    folder = tmp_path / "farm"
    (folder / "photos").mkdir(parents=True)
    (folder / "masks").mkdir()
    mask = np.zeros((180, 240), np.uint8)
    mask[40:90, 50:110], mask[100:150, 140:180] = 255, 255
    for name, shown in (("houses", mask), ("meadow", 0 * mask)):
        photo = np.where(shown[..., None] > 0, (60, 70, 170), (60, 120, 90))
        photo = photo + np.random.default_rng(0).normal(0, 10, photo.shape)
        cv2.imwrite(str(folder / "photos" / f"{name}.png"), np.clip(photo, 0, 255).astype(np.uint8))
        cv2.imwrite(str(folder / "masks" / f"{name}.png"), shown)
    return tmp_path


@pytest.mark.slow
def test_guided_masks_mend_what_their_silhouettes_got_wrong(farm, experiment, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["--photos", str(farm), "--guided-by", "60,4", "--blocks", "--draws", "2", "--grabcut"]
    assert experiment("guided_masks", *words, "--json", "--pictures", str(out)) == 0
    figures = {row["figure"]: row for row in map(json.loads, capsys.readouterr().out.splitlines())}
    moved = figures["IoU guided by 60 px, 4 deg, mean over photos"]
    assert moved["value"] > 0.93
    assert 0.3 < moved["peer_value"] <= 1.0
    assert figures["IoU guided by 60 px, 4 deg, blocks, mean over places"]["value"] > 0.75
    assert len(list(out.glob("*/farm/houses.png"))) == 2
    assert experiment("guided_masks", *words[:-4], "--draws", "1") == 0
    assert "1 photos without buildings left out" in capsys.readouterr().out


def test_silhouettes_are_off_by_what_was_requested():
    mask = np.zeros((300, 400), bool)
    mask[100:200, 150:250] = True
    (still,) = disturbed(mask, Disturbance(0.0, 0.0), 1, 0, "photo")
    assert np.array_equal(still, mask)
    first, second = disturbed(mask, Disturbance(60.0, 0.0), 2, 0, "photo")
    for guide in (first, second):
        away = np.argwhere(guide).mean(axis=0) - np.argwhere(mask).mean(axis=0)
        assert np.hypot(*away) == pytest.approx(20.0, abs=0.7)  # 60 px of 1200 are 20 of 400
    assert not np.array_equal(first, second)
    blocks = list(disturbed(mask, Disturbance(0.0, 0.0, is_blocks=True), 40, 0, "photo"))
    gone = sum(not guide.any() for guide in blocks)
    added = sum(guide.sum() > 1.3 * mask.sum() for guide in blocks)
    assert 0 < gone < 10
    assert 0 < added < 10
