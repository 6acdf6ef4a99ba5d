"""The real thermal query of UAVD4L, against its published LoD1 model."""

from __future__ import annotations

import csv

import pytest


@pytest.mark.slow
@pytest.mark.parametrize(("tilt", "within_m", "within_deg"), [("truth", 2.0, 0.5), ("prior", 5.0, 2.0)])
def test_every_seed_finds_the_camera(lodbench, tmp_path, shared_data, tilt, within_m, within_deg):
    folder = shared_data / "uavd4l"
    done = lodbench(
        "run",
        "--multirun",
        "dataset=folder",
        f"dataset.root={folder / 'demo'}",
        f"dataset.city_model={folder / 'UAVD4L-LoD1.obj'}",
        "segmenter=masks",
        f"tilt={tilt}",
        "seed=0,1,2,3,4",
    )
    assert done.returncode == 0, done.stderr
    tables = list((tmp_path / "runs" / "folder" / "lodlocv2").glob("*/queries.csv"))
    assert len(tables) == 5
    for table in tables:
        (row,) = csv.DictReader(table.open())
        assert float(row["prior_translation_error_m"]) == pytest.approx(21.1, abs=0.05)
        assert float(row["translation_error_m"]) < within_m
        assert float(row["rotation_error_deg"]) < within_deg


def test_six_degrees_of_freedom_find_it_with_the_sensor_s_tilt(lodbench, tmp_path, shared_data):
    folder = shared_data / "uavd4l"
    done = lodbench(
        "run",
        "method=contour_alignment",
        "dataset=folder",
        f"dataset.root={folder / 'demo'}",
        f"dataset.city_model={folder / 'UAVD4L-LoD1.obj'}",
        "segmenter=masks",
        "tilt=prior",
    )
    assert done.returncode == 0, done.stderr
    (table,) = (tmp_path / "runs" / "folder" / "contour_alignment").glob("*/queries.csv")
    (row,) = csv.DictReader(table.open())
    assert float(row["translation_error_m"]) < 2.5
    assert float(row["rotation_error_deg"]) < 1.0
    assert 0.5 < float(row["probability"]) <= 1.0
    assert len(row["covariance"].split()) == 21
