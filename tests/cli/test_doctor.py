"""`lodbench doctor` as a user runs it."""

from __future__ import annotations

import json

import pytest


@pytest.mark.slow
def test_report_for_people(lodbench):
    done = lodbench("doctor")
    assert done.returncode == 0, done.stdout + done.stderr
    for word in ("Python", "numba", "numpy", "silhouette", "raster", "open3d", "pyrender"):
        assert word in done.stdout
    assert "The base install works." in done.stdout


def test_report_for_machines_and_a_broken_base(lodbench, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("lodbench.harness.doctor.doctor.RENDERER_TRIALS", {"raster": True})
    monkeypatch.setattr("lodbench.harness.doctor.doctor.NETWORKS", ())
    done = lodbench("doctor", "--json", LODBENCH_CACHE=str(tmp_path / "file"))
    checks = {check["name"]: check for check in map(json.loads, done.stdout.splitlines())}
    assert done.returncode == 1
    assert (checks["cache"]["status"], checks["cache"]["is_base"]) == ("broken", True)
    assert "LODBENCH_CACHE" in checks["cache"]["hint"]
    assert checks["raster"]["status"] == "ok"
    assert set(checks["raster"]) == {"section", "name", "status", "detail", "hint", "is_base"}


def test_it_starts_where_numpy_does_not(lodbench_process, tmp_path):
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "numpy.py").write_text("raise ImportError('numpy is broken here')")
    done = lodbench_process("doctor", PYTHONPATH=str(tmp_path / "broken"))
    assert done.returncode == 1, done.stderr
    assert "The base install is broken" in done.stdout
    assert "numpy is broken here" in done.stdout
