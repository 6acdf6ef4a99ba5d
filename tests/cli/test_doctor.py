"""`lodbench doctor` as a user runs it."""

import json

import pytest

from lodbench.findings import Check
from lodbench.harness import doctor


@pytest.mark.slow
def test_report_for_people(lodbench):
    done = lodbench("doctor", "--thorough")
    assert done.returncode == 0, done.stdout + done.stderr
    for word in ("Python", "numba", "numpy", "silhouette", "raster", "open3d", "pyrender"):
        assert word in done.stdout
    assert "The base install works." in done.stdout


def test_report_for_machines_and_a_broken_base(lodbench, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("lodbench.harness.doctor.RENDERER_TRIALS", {"raster": True})
    monkeypatch.setattr("lodbench.harness.doctor.NETWORKS", ())
    done = lodbench("doctor", "--thorough", "--json", LODBENCH_CACHE=str(tmp_path / "file"))
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


def test_without_thorough_it_says_what_is_there_and_tries_nothing(lodbench, monkeypatch):
    tried = []

    def run_probe(section, name, is_base, timeout_s):
        tried.append(name)
        return Check(section, name, "ok", "the compiled packages load", "", is_base)

    monkeypatch.setattr(doctor, "run_probe", run_probe)
    real = doctor.find_spec
    monkeypatch.setattr(doctor, "find_spec", lambda name: None if name == "pyrender" else real(name))
    monkeypatch.setattr(doctor, "NETWORKS", ("compact", "no_such_network"))
    done = lodbench("doctor", "--json")
    checks = {check["name"]: check for check in map(json.loads, done.stdout.splitlines())}
    assert tried == ["imports"]
    assert (checks["silhouette"]["status"], checks["silhouette"]["is_base"]) == ("ok", True)
    assert "--thorough" in checks["silhouette"]["detail"]
    assert (checks["pyrender"]["status"], checks["pyrender"]["is_base"]) == ("absent", False)
    assert checks["pyrender"]["hint"] == "pip install 'lodbench[render]'"
    assert checks["compact"]["status"] == "ok"
    assert (checks["no_such_network"]["status"], done.returncode) == ("broken", 1)


def test_it_says_that_nothing_was_tried(lodbench):
    done = lodbench("doctor")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "the compiled packages load" in done.stdout
    assert "The base install is complete; --thorough tries it." in done.stdout
