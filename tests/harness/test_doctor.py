"""The doctor says what works, names what to install, and survives what it examines."""

import json
import subprocess
import sys
from importlib.metadata import PackageNotFoundError
from importlib.resources import files

import cv2
import pytest

from lodbench.errors import LodbenchError
from lodbench.findings import OK, Check
from lodbench.harness import doctor
from lodbench.harness.doctor import ABSENT, BROKEN, is_base_broken, run_probe
from lodbench.plugins import plugin_names
from tests.site_packages import write_package


@pytest.fixture
def probe(monkeypatch, tmp_path):
    """Runs a probe whose process runs the given Python code instead."""

    def run(code, name="pyrender", is_base=False, timeout_s=60.0):
        real = subprocess.run

        def instead(command, **options):
            return real([sys.executable, "-c", code], **options)

        monkeypatch.setattr(doctor.subprocess, "run", instead)
        return run_probe("renderers", name, is_base, timeout_s)

    return run


def test_a_probe_that_works():
    check = run_probe("renderers", "raster", True, 120.0)
    assert check.status == OK, check
    assert "identical to the reference" in check.detail


def test_every_renderer_is_tried():
    assert set(doctor.RENDERER_TRIALS) == set(plugin_names("renderers"))


@pytest.mark.slow
def test_every_network_of_the_package_is_tried():
    packaged = {path.stem for path in (files("lodbench.segmentation") / "weights").glob("*.onnx")}
    assert set(doctor.NETWORKS) == packaged
    for name in packaged:
        check = run_probe("networks", name, True, 120.0)
        assert check.status == OK, check


def test_a_network_that_opencv_cannot_read_is_reported(monkeypatch):
    monkeypatch.setattr("cv2.dnn.readNetFromONNX", lambda *_: (_ for _ in ()).throw(cv2.error("no Reshape")))
    with pytest.raises(LodbenchError, match="not an ONNX network that OpenCV can read"):
        doctor.try_network("compact")


def test_a_crash_is_reported(probe):
    check = probe("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    assert (check.status, check.detail) == (BROKEN, "crashed (SIGSEGV)")


def test_a_hang_is_reported(probe):
    check = probe("import time; time.sleep(60)", timeout_s=0.5)
    assert check.status == BROKEN
    assert "no answer" in check.detail


def test_an_exit_without_an_answer_is_reported(probe):
    check = probe("import sys; sys.exit('no display')")
    assert (check.status, check.detail) == (BROKEN, "ended with code 1: no display")
    assert probe("pass").status == BROKEN


@pytest.mark.parametrize("noise", ["print('bye')", "import os; os.write(1, bytes([10, 255]))"])
def test_noise_of_a_library_is_no_answer(probe, noise):
    answer = """print('{"ok": true, "detail": "draws", "hint": ""}', flush=True)"""
    check = probe(f"print('hello from a driver'); {answer}; {noise}")
    assert (check.status, check.detail) == (OK, "draws")


@pytest.mark.parametrize(
    ("name", "is_base", "is_found", "status"),
    [("open3d", False, False, ABSENT), ("open3d", False, True, BROKEN), ("raster", True, False, BROKEN)],
)
def test_absent_is_what_is_optional_and_not_installed(probe, monkeypatch, name, is_base, is_found, status):
    monkeypatch.setattr(doctor, "find_spec", lambda _name: object() if is_found else None)
    check = probe(
        """print('{"ok": false, "detail": "cannot be imported", "hint": "apt-get"}')""", name, is_base
    )
    assert (check.status, check.hint) == (status, "apt-get")
    assert is_base_broken([check]) == is_base


def test_packages_missing_and_old(monkeypatch):
    real = doctor.version

    def version(name):
        if name == "open3d":
            raise PackageNotFoundError(name)
        return "1.0" if name == "numpy" else real(name)

    monkeypatch.setattr(doctor, "version", version)
    checks = {check.name: check for check in doctor._packages()}
    assert checks["numpy"].status == BROKEN
    assert checks["numpy"].is_base
    assert "1.0" in checks["numpy"].detail
    assert checks["numpy"].hint.startswith("pip install 'numpy")
    assert checks["lxml"].status == OK
    assert checks["render"].status == ABSENT
    assert not checks["render"].is_base
    assert checks["render"].hint == "pip install 'lodbench[render]'"
    assert "open3d is not installed" in checks["render"].detail


def test_plug_ins_of_one_name_are_reported_with_their_packages(monkeypatch, tmp_path, capsys):
    for package in ("first", "second"):
        write_package(tmp_path, package, {"fits": {"same": f"{package}:Fit", package: "math:sqrt"}})
    monkeypatch.syspath_prepend(tmp_path)
    names = [name for name, _ in doctor._plugins_of_others() if name.startswith("fit ")]
    assert sorted(names) == ["fit first", "fit same of first 1.0", "fit same of second 1.0", "fit second"]
    for name in names:
        doctor.main(name)
        reported = json.loads(capsys.readouterr().out)
        assert reported["ok"] == ("same" not in name)
        if " of " in name:
            package = name.partition(" of ")[2]
            assert f"of the package {package} is broken" in reported["detail"]


def test_a_folder_that_cannot_be_written_to(monkeypatch, tmp_path):
    monkeypatch.setenv("LODBENCH_DATA", str(tmp_path / "not" / "there" / "yet"))
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path / "file" / "below"))
    data, cache = doctor._folders()
    assert (data.status, data.hint) == (OK, "")
    assert (cache.status, cache.is_base) == (BROKEN, True)
    assert "LODBENCH_CACHE" in cache.hint
    assert not (tmp_path / "not").exists()


def test_torchvision_that_does_not_fit_torch_is_explained(tmp_path):
    # As PyPI's torchvision does beside a CPU torch: a RuntimeError, no ImportError.
    for name, body in (
        ("torch", "__version__ = '2.13.0+cpu'"),
        ("torchvision", "raise RuntimeError('operator torchvision::nms does not exist')"),
    ):
        (tmp_path / f"{name}.py").write_text(body)
    (tmp_path / "torchvision-0.28.0.dist-info").mkdir()
    (tmp_path / "torchvision-0.28.0.dist-info" / "METADATA").write_text(
        "Name: torchvision\nVersion: 0.28.0\n"
    )
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
    code += "from lodbench.harness.doctor import main\n"
    done = subprocess.run(
        [sys.executable, "-c", code + "main('torchvision')"], capture_output=True, text=True, timeout=120
    )
    assert "torchvision 0.28.0 does not fit torch 2.13.0+cpu" in done.stdout, done
    assert "pip uninstall torchvision" in done.stdout


def test_only_the_base_decides():
    optional, base = Check("renderers", "open3d", ABSENT, ""), Check("machine", "numba", OK, "", "", True)
    assert not is_base_broken([optional, base])
    assert is_base_broken([optional, Check("machine", "numba", BROKEN, "", "", True)])


def test_an_extra_of_extras_is_as_ready_as_they_are() -> None:
    from packaging.requirements import Requirement

    from lodbench.harness.doctor import _wanted_by

    lines = ["numpy", "dask; extra == 'cluster'", "torch; extra == 'torch'"]
    lines += ["lodbench[cluster,torch]; extra == 'all'", "onnx; extra == 'other'"]
    found = _wanted_by("all", [Requirement(line) for line in lines])
    assert [requirement.name for requirement in found] == ["dask", "torch"]


def test_only_extras_that_users_can_want_are_listed() -> None:
    extras = {check.name for check in doctor._packages() if check.section == "extras"}
    assert {"vector", "torch", "rerun"} <= extras
    assert not extras & {"all", "docs", "test"}
