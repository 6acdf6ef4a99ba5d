"""Compiled functions never outlive the code they were compiled from."""

import hashlib
import io
import os
import pickle
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from lodbench.citymodel.scene import Scene
from lodbench.geometry import Camera, Pose
from lodbench.kernels import compiled, silhouettes
from lodbench.rendering.silhouette import SilhouetteRenderer

pytestmark = pytest.mark.attack

INNER = "from numba import njit\n\n@njit\ndef inner():\n    return {value}\n"
OUTER = (
    "from numba import njit\n\nfrom fake.inner import inner\n\n"
    "@njit(cache=True)\ndef outer():\n    return inner()\n"
)
MAIN = """
import pathlib, lodbench.kernels.compiled as cache
class Locator(cache.KernelLocator):
    package = pathlib.Path("fake").resolve()
cache.use_own_folder(Locator)
from fake.outer import outer
print(outer())
"""


@pytest.fixture
def package(tmp_path):
    folder = tmp_path / "fake"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "outer.py").write_text(OUTER)
    (folder / "inner.py").write_text(INNER.format(value=1))
    return folder


def _run(package):
    environment = {**os.environ, "PYTHONPATH": str(package.parent)}
    command = [sys.executable, "-c", MAIN]
    done = subprocess.run(
        command, cwd=package.parent, env=environment, capture_output=True, text=True, check=True
    )
    return int(done.stdout)


@pytest.mark.nightly
def test_a_change_in_a_called_file_is_seen(package):
    assert _run(package) == 1
    (first,) = package.glob("__pycache__/kernels-*")
    assert list(first.rglob("*.nbi"))
    (package / "inner.py").write_text(INNER.format(value=2))
    assert _run(package) == 2
    (second,) = package.glob("__pycache__/kernels-*")
    assert second != first


@pytest.mark.nightly
def test_a_constant_of_a_file_that_numba_does_not_compile_is_seen(package):
    (package / "rule.py").write_text("LIMIT = 1\n")
    (package / "inner.py").write_text(
        "from numba import njit\n\nfrom fake.rule import LIMIT\n\n@njit\ndef inner():\n    return LIMIT\n"
    )
    assert _run(package) == 1
    (package / "rule.py").write_text("LIMIT = 2\n")
    assert _run(package) == 2


def _own_folder(package):
    compiled.own_folder.cache_clear()
    compiled.code_digest.cache_clear()
    return compiled.own_folder(package)


def test_what_stands_outside_the_package_does_not_count(package):
    before = _own_folder(package)
    (package.parent / "other.py").write_text("from numba import njit\n")
    assert _own_folder(package) == before
    (package / "__init__.py").write_text("# another comment")
    assert _own_folder(package) != before


def _kept(package):
    return sorted(package.glob("__pycache__/kernels-*/**/*.nb[ic]"))


@pytest.mark.nightly
def test_every_damaged_file_is_compiled_again(package):
    assert _run(package) == 1
    assert len(_kept(package)) == 2
    for file in _kept(package):
        whole, times = file.read_bytes(), file.stat()
        for content in (b"", whole[: len(whole) // 2], whole[:40] + b"\xff" * 20 + whole[60:]):
            file.write_bytes(content)
            assert _run(package) == 1
            assert _run(package) == 1
        # As a disk forgets: nothing tells but the content.
        whole = file.read_bytes()
        file.write_bytes(whole[:-9] + bytes([whole[-9] ^ 255]) + whole[-8:])
        os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))
        assert _run(package) == 1


@pytest.mark.nightly
def test_what_a_killed_process_left_is_compiled_again(package):
    assert _run(package) == 1
    (folder,) = package.glob("__pycache__/kernels-*")
    (folder / "digests.json").unlink()
    for file in _kept(package):
        file.write_bytes(b"half")
    assert _run(package) == 1


@pytest.mark.nightly
def test_a_sound_file_is_not_compiled_again(package):
    assert _run(package) == 1
    before = {file: file.stat().st_mtime_ns for file in _kept(package)}
    assert _run(package) == 1
    assert {file: file.stat().st_mtime_ns for file in _kept(package)} == before


@pytest.mark.nightly
def test_a_folder_that_others_can_write_to_is_emptied(package):
    assert _run(package) == 1
    (folder,) = package.glob("__pycache__/kernels-*")
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o777)
    (stranger,) = folder.glob("*.nbi")
    stranger.write_bytes(b"cos\nsystem\n(S'touch stranger_was_here'\ntR.")
    assert _run(package) == 1
    assert folder.stat().st_mode & 0o777 == 0o700
    assert not list(package.parent.glob("stranger*"))


def test_a_folder_of_another_user_is_not_used(package, monkeypatch):
    monkeypatch.setattr("os.geteuid", lambda: 12345)
    assert _own_folder(package) is None


@pytest.mark.nightly
def test_a_folder_the_user_has_set_is_used_and_knows_called_files_too(package, monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "set"))
    for value in (1, 2):
        (package / "inner.py").write_text(INNER.format(value=value))
        assert _run(package) == value
        assert len(list((tmp_path / "set").rglob("*.nbi"))) == 1
    assert not list(package.glob("__pycache__/kernels-*"))


DRAW = """
import numpy as np
from lodbench.citymodel.extrude import scene_of_blocks
from lodbench.geometry import Camera, Pose
from lodbench.rendering.silhouette import SilhouetteRenderer
renderer = SilhouetteRenderer(scene_of_blocks([(-6.0, -6.0, 6.0, 6.0, 0.0, 25.0)]), 1)
if {draws}:
    renderer.render(Camera(64, 48, 60.0, 60.0, 32.0, 24.0), Pose.from_matrix(np.eye(4)))
"""


@pytest.mark.slow
def test_the_first_use_says_that_it_compiles_and_no_other(tmp_path):
    said = []
    for draws in (False, True, True):
        done = subprocess.run(
            [sys.executable, "-c", DRAW.format(draws=draws)],
            env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}, capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        said.append(done.stderr.splitlines())
    assert said[0] == said[2] == []
    assert said[1][0].startswith("First use: compiling kernels (silhouettes.draw_views, ...)")


def test_progress_of_compiling_names_kernels_and_not_their_parts(monkeypatch, caplog):
    now = iter((0.0, 1.0, 7.0, 7.0, 8.0))
    monkeypatch.setattr(compiled, "monotonic", lambda: next(now))
    report = compiled._Report()
    for name in ("draw_views", "score_views", "draw_instances", "draw_views"):
        kernel = SimpleNamespace(data={"dispatcher": getattr(silhouettes, name)})
        inner = SimpleNamespace(data={"dispatcher": silhouettes.draw_group})
        report.on_start(kernel)
        report.on_start(inner)
        report.on_end(inner)
        report.on_end(kernel)
    elsewhere = SimpleNamespace(data={"dispatcher": SimpleNamespace(py_func=np.median)})
    report.on_start(elsewhere)
    assert [record.getMessage() for record in caplog.records] == [
        "First use: compiling kernels (silhouettes.draw_views, ...), once: up to half a minute.",
        "2 kernels compiled, now silhouettes.draw_instances.",
    ]


def _triangle():
    corners = np.array([(0, 0, 0), (9, 0, 0), (0, 9, 5)], np.float32)
    rows, ends = np.array([(0, 1, 2)], np.int32), (np.array([0, 3]), np.array([0, 1]))
    return Scene(corners, rows, *ends, ("a",), "1", None, np.zeros(3))


def test_a_place_that_cannot_be_used_is_left_alone(package):
    folder = _own_folder(package)
    folder.rmdir()
    folder.write_text("not a folder")
    assert _own_folder(package) is None
    assert folder.read_text() == "not a folder"


def test_kernels_are_kept_by_the_digest_of_their_package_and_no_setting_of_the_process_changes():
    code = (
        "import os\nbefore = dict(os.environ)\n"
        "import numba, lodbench\nplace = numba.config.CACHE_DIR\n"
        "import lodbench.rendering.silhouette\nfrom lodbench.kernels import compiled, masks\n"
        "assert dict(os.environ) == before and numba.config.CACHE_DIR == place\n"
        "stamp = masks.count_bits._cache._impl.locator.get_source_stamp()\n"
        "assert stamp == compiled.code_digest(compiled._HERE)\n"
        "print(masks.count_bits.stats.cache_path)"
    )
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == str(compiled.own_folder(compiled._HERE))


def test_kernels_are_given_no_types_that_their_digest_does_not_know(tmp_path):
    # Of a named tuple numba keeps the class by name, and the order of its fields is compiled in.
    scene, camera = _triangle(), Camera(64, 48, 60.0, 60.0, 32.0, 24.0)
    SilhouetteRenderer(scene, 1).render(camera, Pose.from_matrix(np.eye(4)))
    kept = list(Path(silhouettes.draw_views.stats.cache_path).glob("*.nbi"))
    assert kept
    foreign = [path.name for path in kept if re.search(rb"lodbench\.(?!kernels)", path.read_bytes())]
    assert foreign == []


BROUGHT = """
import pathlib, sys
import lodbench.kernels.compiled as cache
from numba import njit
from numba.core import event
class Locator(cache.KernelLocator):
    package = pathlib.Path("fake").resolve()
cache.use_own_folder(Locator)
cache.LEVELS[sys.argv[1]] = cache.LEVELS["x86-64-v3"] if len(sys.argv) == 2 else {sys.argv[2]}
from fake.inner import inner
function = njit(cache=True)(inner.py_func)
function._cache = cache.KernelCache(inner.py_func)
with event.install_recorder("numba:compile") as compiled:
    print(function(), len(compiled.buffer))
"""


def _value_and_compiled(package, level="x86-64-v3", *needs, **environment):
    """Returns what the function gives, and whether it was compiled; its own folder is empty before."""
    shutil.rmtree(package / "__pycache__", ignore_errors=True)
    done = subprocess.run(
        [sys.executable, "-c", BROUGHT, level, *needs], cwd=package.parent, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(package.parent), **environment}, check=True,
    )  # fmt: skip
    value, events = done.stdout.split()
    return int(value), int(events) > 0


@pytest.fixture
def with_objects(package):
    """A package whose wheel brought its function for processors of the level x86-64-v3."""
    if "x86-64-v3" not in compiled.LEVELS or not _has_v3():
        pytest.skip("compiles for a level that this processor does not have")
    built = package.parent / "built"
    cpu = {"NUMBA_CPU_NAME": "x86-64-v3", "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(built)}
    assert _value_and_compiled(package, **cpu) == (1, True)
    folder = package / "compiled" / "x86-64-v3"
    folder.mkdir(parents=True)
    for file in built.rglob("*.nb[ic]"):
        shutil.copy(file, folder)
    _note(folder)
    return package


def _has_v3():
    has = {name for name, is_there in compiled.get_host_cpu_features().items() if is_there}
    return compiled.LEVELS["x86-64-v3"] <= has


def _note(folder):
    files = sorted(folder.glob("*.nb[ic]"))
    lines = [f"{hashlib.sha256(file.read_bytes()).hexdigest()} {file.name}" for file in files]
    (folder / "digests.txt").write_text("\n".join(lines))


def test_what_a_wheel_brought_is_not_compiled_and_what_is_changed_is(with_objects):
    assert _value_and_compiled(with_objects) == (1, False)
    (with_objects / "inner.py").write_text(INNER.format(value=2))
    assert _value_and_compiled(with_objects) == (2, True)


def test_another_change_of_the_package_compiles_anew(with_objects):
    (with_objects / "rule.py").write_text("LIMIT = 1\n")
    assert _value_and_compiled(with_objects) == (1, True)


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_what_a_wheel_brought_damaged_is_compiled(with_objects, ending):
    (file,) = with_objects.glob(f"compiled/*/*.{ending}")
    whole = file.read_bytes()
    file.write_bytes(whole[:-9] + bytes([whole[-9] ^ 255]) + whole[-8:])
    assert _value_and_compiled(with_objects) == (1, True)


def test_what_a_wheel_brought_for_another_processor_is_compiled(with_objects):
    assert _value_and_compiled(with_objects, "x86-64-v3", "no such feature") == (1, True)
    assert _value_and_compiled(with_objects, NUMBA_CPU_NAME="x86-64") == (1, True)


def test_what_another_numba_made_is_compiled(with_objects):
    (file,) = with_objects.glob("compiled/*/*.nbi")
    version, rest = pickle.dumps("0.0", protocol=-1), io.BytesIO(file.read_bytes())
    pickle.load(rest)  # noqa: S301 - made above
    file.write_bytes(version + rest.read())
    _note(file.parent)
    assert _value_and_compiled(with_objects) == (1, True)
