"""Bins and numbers by a benchmark's name, against slow sums; and the way from a dataset to tables."""

import json
import math

import numpy as np
import pytest

from lodbench.citymodel import open_scene
from lodbench.datasets.query import Entry
from lodbench.errors import ConfigError
from lodbench.evaluation.metrics import (
    COLUMNS,
    EAST_NORTH,
    GROUND,
    PROTOCOLS,
    protocol_named,
    queries_csv,
    summarize_queries,
)
from lodbench.evaluation.predictions import Prediction, encoded_mask, evaluate
from lodbench.geometry import EulerAngles, Pose
from lodbench.rendering import make_renderer
from tests.town import CAMERA, box_obj, write_dataset

# East, north, up in metres, and yaw in degrees, that estimates are off by; None for no answer.
OFF = [(0.1, -0.2, 0.1, 0.5), (1.0, 1.0, 8.0, 1.0), (3.0, 3.9, 0.0, 6.0), (-30.0, 0.0, 0.0, 40.0), None]


def rows(columns=(), scorer=None):
    truth, predictions, entries = {}, {}, []
    for k, off in enumerate(OFF):
        entry = Entry(f"{k}.jpg", "a", CAMERA, None, None, None)
        pose = Pose.from_euler(EulerAngles(30, 0, 20 * k), (5.0, -3.0, 120.0))
        entries.append(entry)
        truth[entry.key] = pose
        guess = None
        if off is not None:
            turned = Pose.from_euler(EulerAngles(30, 0, 20 * k + off[3]), pose.center)
            guess = turned.shifted(off[:3])
        predictions[entry.key] = Prediction(guess, "" if guess else "lost")
    return evaluate(entries, predictions, truth, {}, scorer, columns=columns)


def test_bins_outliers_and_means_of_egenioussbench():
    summary, _ = summarize_queries(rows(EAST_NORTH), "a", PROTOCOLS["egeniouss"])
    assert summary.recall == {"0.5m-2deg": 20.0, "2m-5deg": 20.0, "5m-10deg": 40.0}
    numbers = summary.metrics
    # The one without an answer is beyond every bin.
    assert numbers["beyond_5m_10deg_percent"] == 60.0
    distances = [math.sqrt(e * e + n * n + u * u) for e, n, u, _ in OFF[:4]]
    assert numbers["rmse_translation_m"] == pytest.approx(math.sqrt(sum(d * d for d in distances) / 4))
    assert numbers["mean_translation_m"] == pytest.approx(sum(distances) / 4)
    assert numbers["rmse_east_m"] == pytest.approx(math.sqrt((0.01 + 1 + 9 + 900) / 4))
    assert numbers["rmse_vertical_m"] == pytest.approx(math.sqrt((0.01 + 64) / 4))
    # Medians count the query without an answer, as those of all errors do.
    assert numbers["median_east_m"] == pytest.approx(3.0)
    assert numbers["median_north_m"] == pytest.approx(1.0)


def test_distances_in_plan_are_included_and_heights_do_not_count():
    summary, prior = summarize_queries(rows(), "a", PROTOCOLS["anyvisloc"])
    assert summary.recall == prior.recall == {}
    found = {most: summary.metrics[f"horizontal_{most}m_percent"] for most in (1, 3, 5, 10, 20)}
    assert found == {1: 20.0, 3: 40.0, 5: 60.0, 10: 60.0, 20: 60.0}
    assert "beyond" not in " ".join(summary.metrics)
    table = rows().assign(horizontal_error_m=[5.0, np.nextafter(5.0, 6), 10, 10, math.inf])
    at_bounds = PROTOCOLS["anyvisloc"].numbers(table)
    assert (at_bounds["horizontal_5m_percent"], at_bounds["horizontal_10m_percent"]) == (20.0, 80.0)


def test_the_place_on_the_ground_that_the_photo_s_centre_shows(tmp_path):
    (tmp_path / "city.obj").write_text(box_obj([(-400, -400, -390, -390, 0, 9), (300, 300, 310, 310, 0, 9)]))
    scorer = make_renderer("silhouette", open_scene(tmp_path / "city.obj"), None)
    table = rows((GROUND,), scorer)
    for off, error in zip(OFF, table[GROUND], strict=True):
        if off is None:
            assert math.isinf(error)
            continue

        def place(yaw_deg, e, n, u):
            # A ray through the middle of the picture, by hand: it is not quite the principal point.
            right = (CAMERA.width / 2 - CAMERA.cx) / CAMERA.fx
            down = (CAMERA.height / 2 - CAMERA.cy) / CAMERA.fy
            tilt, turn = math.radians(30), math.radians(yaw_deg)
            ahead = math.sin(tilt) - down * math.cos(tilt)
            drop = math.cos(tilt) + down * math.sin(tilt)
            scale = (120.0 + u) / drop
            x, y = scale * right, scale * ahead
            return np.array(
                [e + x * math.cos(turn) - y * math.sin(turn), n + x * math.sin(turn) + y * math.cos(turn)]
            )

        k = OFF.index(off)
        expected = np.linalg.norm(place(20 * k + off[3], *off[:3]) - place(20 * k, 0, 0, 0))
        assert error == pytest.approx(expected, abs=1e-3)


def test_columns_of_others_stay_as_they_are():
    assert list(rows().columns) == list(COLUMNS)
    assert list(rows(EAST_NORTH).columns) == [*COLUMNS, *EAST_NORTH]
    assert queries_csv(rows(EAST_NORTH)).splitlines()[-1].endswith(",,")
    assert PROTOCOLS["lodloc"].numbers(rows()) == {}


def test_an_unknown_protocol_is_one_line():
    with pytest.raises(ConfigError, match="no protocol 'egenious'") as caught:
        protocol_named("egenious")
    assert "egeniouss" in caught.value.hint


@pytest.fixture
def run_folder(tmp_path, monkeypatch):
    """Returns a finished run over a folder whose dataset.json names a protocol."""
    from lodbench.cli import main

    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)

    def run(protocol):
        root, city = write_dataset(tmp_path / protocol, 4)
        (root / "dataset.json").write_text(json.dumps({"protocol": protocol}))
        words = [f"dataset.root={root}", f"city={city}", f"paths.runs={tmp_path / protocol / 'runs'}"]
        assert main(["run", "dataset=folder", "method=prior_only", "segmenter=none", *words]) == 0
        return next((tmp_path / protocol / "runs").glob("*/*/*"))

    return run


@pytest.mark.parametrize("protocol", ["egeniouss", "anyvisloc", "uavd4l"])
def test_a_run_compare_verify_and_the_leaderboard_read_it(run_folder, capsys, tmp_path, protocol):
    from lodbench.cli import main

    folder = run_folder(protocol)
    printed = capsys.readouterr().out
    wanted = {"egeniouss": "0.5m-2deg", "anyvisloc": "horizontal 3m", "uavd4l": "beyond 5m 5deg"}[protocol]
    assert wanted in printed
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["protocol"]["bins"] == protocol
    assert main(["verify", str(folder)]) == 0
    assert main(["compare", str(folder), "--format", "csv"]) == 0
    assert wanted.split()[0] in capsys.readouterr().out.replace("horizontal_3m", "horizontal 3m")
    assert main(["compare", str(folder), "--thresholds", "lodlocv3"]) == 0
    assert "10m-15deg" in capsys.readouterr().out
    (tmp_path / "board").mkdir()
    assert main(["leaderboard", "add", str(folder), "--map", "boxes", "--root", str(tmp_path / "board")]) == 0
    assert main(["leaderboard", "build", "--root", str(tmp_path / "board")]) == 0
    (board,) = [p for p in (tmp_path / "board").glob("*.md") if p.stem != "index"]
    assert wanted in board.read_text().replace("_", " ")


POSE = Pose.from_euler(EulerAngles(40.0, 1.0, 170.0), [10.0, 20.0, 100.0])


def test_a_prediction_comes_back_as_it_was_stored():
    mask = np.random.default_rng(0).random((37, 61)) < 0.3
    made = Prediction(
        POSE, "", 0.75, 2425, {"grid": 0.5}, {"beams": (0.1, 0.2)}, 0.9, (1.0, 2.0), encoded_mask(mask),
        (POSE.shifted([1.0, 0.0, 0.0]),), (0.1,), ("far",),
    )  # fmt: skip
    again = Prediction.from_json(json.loads(json.dumps(made.to_json(), allow_nan=False)))
    np.testing.assert_array_equal(again.pose.cam_from_world, POSE.cam_from_world)
    np.testing.assert_array_equal(again.mask, mask)
    np.testing.assert_array_equal(again.alternatives[0].cam_from_world, made.alternatives[0].cam_from_world)
    names = ("notes", "failure", "score", "hypotheses", "seconds", "trace", "probability", "covariance")
    for name in (*names, "alternative_probabilities"):
        assert getattr(again, name) == getattr(made, name)


def test_a_mask_takes_about_a_bit_a_pixel_at_most():
    noise = np.random.default_rng(1).random((448, 602)) < 0.5
    assert len(encoded_mask(noise)) < 448 * 602 / 8 * 4 / 3 * 1.05


@pytest.mark.parametrize("shape", [(1, 1), (1, 602), (448, 1)])
def test_masks_of_any_size_are_kept(shape):
    mask = np.ones(shape, dtype=np.bool_)
    np.testing.assert_array_equal(Prediction(None, "no match", mask_png=encoded_mask(mask)).mask, mask)
