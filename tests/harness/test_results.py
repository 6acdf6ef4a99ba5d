"""Runs from Python, as a notebook makes and shows them."""

from __future__ import annotations

import re

import lodbench
from tests.town import write_dataset


def test_a_run_from_python_is_one_that_verifies_and_shows_itself(tmp_path, capsys):
    root, city = write_dataset(tmp_path / "town", count=2)
    run = lodbench.run_method("contour_alignment", root, city=city, runs=tmp_path / "runs")
    assert repr(run).startswith("StoredRun(contour_alignment on folder, 2 queries")
    assert run.queries["translation_error_m"].max() < 2.0
    assert "<table" in run._repr_html_()
    (name, picture), *_ = run.overlays.items()
    assert "view_0" in name
    assert picture._repr_png_().startswith(b"\x89PNG")
    assert len(repr(picture)) < 200
    for found in run.predictions.values():
        assert found.mask_png
        assert len(repr(found)) < 800
        assert re.fullmatch(r"Pose\(center=\([-\d., ]+\), pitch=.*, roll=.*, yaw=.* deg\)", repr(found.pose))
    from lodbench.cli import main

    assert main(["verify", str(run.folder)]) == 0, capsys.readouterr().out
    # The same again resumes into the same folder; another setting has another.
    runs = tmp_path / "runs"
    assert lodbench.run_method("contour_alignment", root, city=city, runs=runs).folder == run.folder
    assert lodbench.run_method("prior_only", root, city=city, runs=runs).folder != run.folder


def test_the_public_names_are_there():
    assert issubclass(lodbench.QueryFault, lodbench.LodbenchError)
    assert {"QueryFault", "run_method", "load_run"} <= set(lodbench.__all__)


def test_no_object_prints_its_arrays(tmp_path):
    _, city = write_dataset(tmp_path / "town", count=1)
    scene = lodbench.open_scene(city)
    assert len(repr(scene)) < 200
