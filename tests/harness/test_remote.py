"""Methods over pipes: the same bytes as in this process, and children that die, hang or write nonsense."""

from __future__ import annotations

import io
import json
import os
import re
import subprocess
import sys
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lodbench.cli import main
from lodbench.errors import ConfigError, LodbenchError, QueryFault, RenderingError, WorkersGone
from lodbench.geometry import Camera, Pose
from lodbench.harness.remote import RemoteMethod, RunnerParams
from lodbench.harness.remote import child as child_module
from lodbench.harness.remote.child import Pipe, RemoteMap
from lodbench.harness.remote.drawn import KINDS
from lodbench.harness.remote.method import answered
from lodbench.harness.remote.process import Child, ProcessFault
from lodbench.harness.remote.wire import MalformedMessage, packed, unpacked
from lodbench.methods import Estimate
from lodbench.methods.conformance.trial import make_trial, streams_of
from lodbench.methods.measured_calls import localize_query
from lodbench.methods.registry import make_method
from lodbench.methods.workspace import Workspace
from lodbench.rendering import IouFit
from tests.town import write_dataset

# A method whose package only the other Python finds: it asks for a little of everything.
SHAKE = """
from dataclasses import dataclass
import numpy as np
from lodbench.errors import QueryFault
from lodbench.methods import Estimate
from lodbench.rendering import IouFit
from lodbench.segmentation import binary_mask
import time
from threadpoolctl import threadpool_info

def blas_threads():
    return max(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")

@dataclass(frozen=True)
class ShakeParams:
    name: str = "shake"
    tries: int = 8
    mood: str = "fine"

class Shake:
    name = "shake"
    params_type = ShakeParams
    requires = frozenset({"mask"})

    def __init__(self, params):
        self.params = params

    def prepare(self, city_map, references, workspace):
        (workspace.folder / "blas").write_text(str(blas_threads()))
        if self.params.mood == "slow":
            time.sleep(1.0)
        if self.params.mood == "unready" and not (workspace.folder / "ready").exists():
            raise QueryFault("not yet")

    def localize(self, query, city_map, streams):
        print("what is printed is no message")
        if self.params.mood == "dies" and query.name.endswith("0.png"):
            raise RuntimeError("no more")
        if not binary_mask(query.mask, 64, 48).any():
            raise QueryFault("the mask holds no building")
        camera = query.camera.scaled(64, 48)
        moves = streams("moves", 0).normal(scale=3.0, size=(self.params.tries, 3))
        rotations = np.repeat(query.prior.rotation[None], len(moves), axis=0)
        fit = IouFit(binary_mask(query.mask, 64, 48))
        scores = city_map.fit(camera, rotations, query.prior.center + moves, fit)
        best = int(np.argmax(scores))
        seen = city_map.edges(camera, rotations[:1], query.prior.center[None], crease_deg=20.0)
        told = {"edges": (float(len(seen[0].points)), float(city_map.scene.num_buildings))}
        told["blas"] = (float(blas_threads()),)
        return Estimate(query.prior.shifted(moves[best]), float(scores[best]), trace=told)
"""


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory) -> str:
    """Another Python: this one, with a package that is installed nowhere else."""
    folder = tmp_path_factory.mktemp("elsewhere")
    (folder / "shake_method.py").write_text(SHAKE)
    info = folder / "shake-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: shake\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[lodbench.methods]\nshake = shake_method:Shake\n")
    python = folder / "python"
    python.write_text(f'#!/bin/sh\nPYTHONPATH="{folder}" exec "{sys.executable}" "$@"\n')
    python.chmod(0o755)
    return str(python)


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    return make_trial(tmp_path_factory.mktemp("trial"), make_method("lodlocv2"))


def remote(elsewhere: str, **settings) -> RemoteMethod:
    return RemoteMethod({"name": "shake", **settings}, RunnerParams("subprocess", elsewhere))


def bytes_of(estimate: Estimate) -> tuple:
    return (
        estimate.pose.cam_from_world.tobytes(),
        estimate.score,
        estimate.trace,
        estimate.probability,
        None if estimate.covariance is None else estimate.covariance.tobytes(),
        estimate.notes,
        [pose.cam_from_world.tobytes() for pose in estimate.alternatives],
        estimate.hypotheses,
    )


@pytest.mark.parametrize(
    "settings",
    [
        {"name": "lodlocv2", "steps": 3, "coarse_size": [80, 60], "fine_size": [160, 120]},
        pytest.param({"name": "contour_alignment"}, marks=pytest.mark.slow),
    ],
    ids=["lodlocv2", "contour_alignment"],
)
def test_the_answers_are_those_of_this_process_to_the_byte(settings, trial, elsewhere):
    own = make_method(**settings)
    other = RemoteMethod(settings, RunnerParams("subprocess", elsewhere))
    assert (other.name, other.requires) == (own.name, frozenset(own.requires))
    for query in trial.queries[:2]:
        found = [localize_query(m, query, trial.city_map, streams_of(query)) for m in (own, other)]
        assert bytes_of(found[0]) == bytes_of(found[1])
    other.close()


def test_a_method_that_only_the_other_python_has_draws_here(elsewhere, trial):
    method, query = remote(elsewhere, tries=5), trial.queries[1]
    found = localize_query(method, query, trial.city_map, streams_of(query))
    # Five silhouettes, and one view's edges: counted by the map here.
    assert found.hypotheses == 6
    moves = streams_of(query)("moves", 0).normal(scale=3.0, size=(5, 3))
    assert any(np.array_equal(found.pose.center, query.prior.shifted(m).center) for m in moves)
    edges, buildings = found.trace["edges"]
    assert edges > 10
    assert buildings == 7
    nowhere = replace(query, building_probability=None)
    with pytest.raises(QueryFault, match=r"^there is no mask$"):
        method.localize(nowhere, trial.city_map, streams_of(query))


def test_linear_algebra_has_one_thread_there_too(elsewhere, trial, tmp_path):
    method, query = remote(elsewhere), trial.queries[0]
    method.prepare(trial.city_map, (), Workspace(tmp_path))
    assert method.localize(query, trial.city_map, streams_of(query)).trace["blas"] == (1.0,)
    assert (tmp_path / "blas").read_text() == "1"


def test_the_folder_it_is_started_in_is_no_place_to_import_from(elsewhere, tmp_path, monkeypatch):
    (tmp_path / "numpy.py").write_text("raise SystemExit('a stranger')")
    monkeypatch.chdir(tmp_path)
    assert remote(elsewhere).name == "shake"


def test_a_process_that_could_not_prepare_is_asked_to_again(elsewhere, trial, tmp_path):
    method, query = remote(elsewhere, mood="unready"), trial.queries[0]
    with pytest.raises(QueryFault, match="not yet"):
        method.prepare(trial.city_map, (), Workspace(tmp_path))
    with pytest.raises(QueryFault, match="not yet"):
        method.localize(query, trial.city_map, streams_of(query))
    (tmp_path / "ready").touch()
    assert isinstance(method.localize(query, trial.city_map, streams_of(query)), Estimate)


def test_preparing_has_a_time_of_its_own(elsewhere, trial, tmp_path):
    settings = {"name": "shake", "mood": "slow"}
    patient = RemoteMethod(settings, RunnerParams("subprocess", elsewhere, timeout_s=0.8))
    patient.prepare(trial.city_map, (), Workspace(tmp_path))
    hasty = RemoteMethod(settings, RunnerParams("subprocess", elsewhere, prepare_timeout_s=0.5))
    with pytest.raises(ConfigError, match=r"shake cannot prepare: .* no answer in 0\.5 s"):
        hasty.prepare(trial.city_map, (), Workspace(tmp_path))


class Here:
    """Stands for the pipe: what is asked is answered in this process, and noted."""

    def __init__(self, city_map) -> None:
        self.city_map, self.asked = city_map, []

    def ask(self, *words):
        self.asked.append(words)
        return answered(list(words), None, self.city_map, None)


@pytest.mark.parametrize("kind", [*sorted(KINDS - {"render"}), "fit"])
def test_many_poses_are_asked_for_some_at_a_time(kind, trial, monkeypatch):
    camera, city_map = trial.queries[0].camera.scaled(80, 60), trial.city_map
    poses = [query.prior for query in trial.queries] * 2
    asked = np.stack([p.rotation for p in poses]), np.stack([p.center for p in poses])
    mask = np.zeros((60, 80), bool)
    mask[20:40, 30:60] = True
    more = {"counts": [mask], "fit": [IouFit(mask)]}.get(kind, [])
    about = {"name": "", "threads": 1, "is_textured": False}
    city_map.usage.take()
    monkeypatch.setattr(child_module, "_PORTION_BYTES", 40 if kind == "counts" else 1)
    pipe = Here(city_map)
    found = getattr(RemoteMap(pipe, about), kind)(camera, *asked, *more)
    assert len(pipe.asked) == (3 if kind == "counts" else 6)
    assert city_map.usage.total == 6
    assert packed(found) == packed(getattr(city_map, kind)(camera, *asked, *more))
    nothing = getattr(RemoteMap(pipe, about), kind)(camera, asked[0][:0], asked[1][:0], *more)
    assert packed(nothing) == packed(getattr(city_map, kind)(camera, asked[0][:0], asked[1][:0], *more))


def test_a_grid_of_any_size_is_drawn(trial, monkeypatch):
    """200,000 poses, 6.9 GB of silhouettes: more than goes over the pipe at a time."""
    largest = 0

    def silhouettes(camera, rotations, centers):
        nonlocal largest
        largest = max(largest, len(centers))
        return np.zeros((len(centers), 1, 1), np.uint64)

    monkeypatch.setattr(trial.city_map.scorer, "silhouettes", silhouettes)
    method_map = RemoteMap(Here(trial.city_map), {"name": "", "threads": 1, "is_textured": False})
    count, camera = 200_000, trial.queries[0].camera.scaled(602, 448)
    rotations = np.broadcast_to(np.eye(3), (count, 3, 3))
    scores = method_map.fit(camera, rotations, np.zeros((count, 3)), lambda words: np.zeros(len(words)))
    assert len(scores) == count
    assert 0 < largest * 448 * 80 <= 1 << 26


def test_what_a_method_counts_itself_is_counted_here(trial):
    trial.city_map.usage.take()
    RemoteMap(Here(trial.city_map), {"name": "", "threads": 1, "is_textured": False}).usage.add("wires", 7)
    assert trial.city_map.usage.take() == {"wires": 7}
    with pytest.raises(LodbenchError):
        answered(["count", "wires", -7], None, trial.city_map, None)


# What a child may do in place of an answer; it has read the question.
READ = "import os, sys, time; n = int.from_bytes(os.read(0, 8), 'little'); os.read(0, n); "
HEAD = "h = {head!r}.encode(); os.write(1, len(h).to_bytes(8, 'little') + h); "


def child_that(code: str) -> Child:
    return Child([sys.executable, "-S", "-c", READ + code], {})


@pytest.mark.parametrize(
    ("code", "timeout_s", "reason"),
    [
        ("print(1 / 0)", 20.0, r"ended with exit code 1: ZeroDivisionError: division by zero"),
        ("os._exit(7)", 20.0, r"ended with exit code 7$"),
        ("os.kill(os.getpid(), 11)", 20.0, r"ended with exit code -11$"),
        ("time.sleep(60)", 0.5, r"gave no answer in 0\.5 s and was stopped$"),
        ("os.write(1, bytes(7)); time.sleep(60)", 0.5, r"gave no answer in 0\.5 s"),
        (
            "os.write(1, b'\\xff' * 8); time.sleep(60)",
            20.0,
            r"stopped, for the head of a message has \d+ bytes",
        ),
        (HEAD.format(head='["done", []]') + "time.sleep(60)", 20.0, "stopped, for a message is no word"),
        (HEAD.format(head="nonsense") + "time.sleep(60)", 20.0, "stopped, for a message cannot be read"),
    ],
)
def test_a_child_that_fails_is_stopped_and_says_why(code, timeout_s, reason):
    child = child_that(code)
    with pytest.raises(ProcessFault, match=reason) as caught:
        child.call({"do": []}, lambda words: None, timeout_s)
    if "ZeroDivisionError" in reason:
        assert "Traceback" in caught.value.__notes__[0]
    child.close()


def test_a_child_that_does_not_read_is_stopped():
    child = Child([sys.executable, "-S", "-c", "import time; time.sleep(60)"], {})
    with pytest.raises(ProcessFault, match="gave no answer"):
        child.call({"do": [np.zeros(1 << 20)]}, lambda words: None, 0.5)


def assert_ends(pid: int) -> None:
    for _ in range(200):
        # An orphan that has ended may wait for a moment to be taken off the list.
        state = Path(f"/proc/{pid}/stat")
        if not state.exists() or state.read_text().split()[2] == "Z":
            return
        time.sleep(0.02)
    raise AssertionError(f"process {pid} still runs")


@pytest.mark.parametrize("ending", ["os._exit(4)", "time.sleep(60)"])
def test_what_a_child_started_ends_with_it(ending):
    """Both where it is stopped and where it died by itself."""
    started = "import subprocess; p = subprocess.Popen(['sleep', '60']); "
    started += "print(p.pid, file=sys.stderr, flush=True); "
    with pytest.raises(ProcessFault) as caught:
        child_that(started + ending).call({"do": []}, lambda words: None, 1.0)
    (pid,) = [int(word) for word in re.findall(r"\d+", caught.value.__notes__[0])]
    assert_ends(pid)


def test_room_is_made_for_what_came_not_for_what_is_said_to_come():
    """A head that announces an array of 7 GB, and no such bytes."""
    head = json.dumps([{"dict": [["done", {"array": 0}]]}, [["|u1", [7 << 30]]]])
    child = child_that(HEAD.format(head=head) + "time.sleep(60)")
    tracemalloc.start()
    with pytest.raises(ProcessFault, match="gave no answer"):
        child.call({"do": []}, lambda words: None, 0.5)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 24


def test_what_goes_wrong_with_a_question_is_told_to_who_asked():
    ask = HEAD.format(head='[{"dict": [["ask", ["draw", 3]]]}, []]')
    again = "n = int.from_bytes(os.read(0, 8), 'little'); os.write(2, os.read(0, n)); os._exit(3)"

    def answer(words: list) -> None:
        raise ValueError(words[1])

    with pytest.raises(ProcessFault, match=r"exit code 3: .*\[\"fault\", \"ValueError: 3\"\]"):
        child_that(ask + again).call({"do": []}, answer, 20.0)


def test_workers_that_are_gone_end_the_run_and_no_query():
    ask = HEAD.format(head='[{"dict": [["ask", ["draw", 3]]]}, []]')

    def answer(words: list) -> None:
        raise WorkersGone("they are gone")

    child = child_that(ask + "time.sleep(60)")
    with pytest.raises(WorkersGone, match="they are gone"):
        child.call({"do": []}, answer, 20.0)
    assert child._process.returncode is not None


def test_a_hint_reaches_who_asked():
    fault = io.BytesIO(packed({"fault": "no such lens", "hint": "undo it", "kind": "RenderingError"}))
    with pytest.raises(RenderingError, match="no such lens") as caught:
        Pipe(fault, io.BytesIO()).ask("draw")
    assert caught.value.hint == "undo it"


def test_what_a_method_started_ends_where_its_run_is_gone_without_a_word(tmp_path):
    """A worker that leaves by os._exit closes nothing but its pipes."""
    code = (
        "import os, subprocess; from lodbench.harness.remote.child import Pipe; "
        "p = subprocess.Popen(['sleep', '60']); print(p.pid, flush=True); "
        "Pipe(os.fdopen(0, 'rb'), os.fdopen(os.dup(1), 'wb')).receive()"
    )
    child = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, process_group=0
    )
    pid = int(child.stdout.readline())
    child.stdin.close()
    assert child.wait(20) == -9
    assert_ends(pid)


def test_only_what_is_offered_is_drawn_and_never_too_much(trial):
    camera, many = Camera(8000, 8000, 9e3, 9e3, 4e3, 4e3), (np.zeros((10**6, 3, 3)), np.zeros((10**6, 3)))
    for words, reason in (
        (["draw", "depth", {}, camera, *many], "too many at a time"),
        (["draw", "depth", {}, 7, *many], "with a camera and poses"),
        (["draw", "usage", {}], "no 'draw'"),
        (["true_pixels", many[1]], "no 'true_pixels'"),
        ([], "no ''"),
    ):
        with pytest.raises(LodbenchError, match=reason):
            answered(words, trial.queries[0], trial.city_map, streams_of(trial.queries[0]))


@pytest.mark.slow
def test_a_run_over_pipes_counts_a_crash_and_goes_on(elsewhere, tmp_path, capsys):
    root, city = write_dataset(tmp_path / "town", count=2)
    words = ["run", "method=shake", "dataset=folder", f"root={root}", f"city={city}"]
    words += ["runner=subprocess", f"runner.python={elsewhere}", f"paths.runs={tmp_path / 'runs'}"]
    assert main([*words, "method.mood=dies"]) == 0
    printed = capsys.readouterr().out
    assert "1 x ProcessFault: the method's process ended with exit code 1: RuntimeError: no more" in printed
    (config,) = (tmp_path / "runs").rglob("config.yaml")
    assert "runner: subprocess" in config.read_text()
    assert elsewhere not in config.read_text()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["runner=subprocess"], "needs a Python"),
        (["runner=subprocess", "runner.python=/no/python"], "/no/python cannot be started: No such file"),
        (["runner=subprocess", "runner.python=/bin/false"], "exit code 1"),
        (["runner=subprocess", f"runner.python={sys.executable}", "runner.timeout_s=0"], "no time to wait"),
        pytest.param(
            ["runner=subprocess", f"runner.python={sys.executable}", "method=shake"],
            "shake",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            ["runner=subprocess", f"runner.python={sys.executable}", "method=flight"],
            "whole flights",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_wrong_runner_is_one_line_before_any_work(words, told, capsys, tmp_path):
    assert main(["run", "dataset=demo", f"paths.runs={tmp_path}", *words]) == 2
    error = capsys.readouterr().err
    assert told in error
    assert error.startswith("lodbench: ")
    assert len(error.splitlines()) <= 2
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_check_method_asks_it_there(elsewhere, capsys):
    assert main(["check-method", "shake", f"runner.python={elsewhere}", "method.tries=6"]) == 0
    assert "keeps to the protocol" in capsys.readouterr().out
    assert main(["check-method", "shake", f"runner.python={sys.executable}"]) == 1
    assert "shake" in capsys.readouterr().out


def reader(content: bytes):
    parts = iter([content])
    rest = [next(parts)]

    def read(count: int) -> bytes:
        found, rest[0] = rest[0][:count], rest[0][count:]
        if len(found) < count:
            raise EOFError
        return found

    return read


def test_messages_come_back_as_they_went():
    generator = np.random.default_rng(1)
    values = [
        {"a": 1, "b": None, "dict": {"tuple": "x"}},
        (1.5, float("inf"), True, "ö"),
        generator.normal(size=(2, 3)).astype(np.float32),
        np.zeros((0, 4), bool),
        np.array(7, dtype=np.uint64),
        Path("/a b/c"),
        Camera(4, 3, 2.0, 2.0, 2.0, 1.5, (0.1, 0.0, 0.0, 0.0)),
        np.float64(0.1),
    ]
    found = unpacked(reader(packed(values)))
    for value, back in zip(values, found, strict=True):
        if isinstance(value, np.ndarray):
            assert (back.dtype, back.shape) == (value.dtype, value.shape)
            np.testing.assert_array_equal(back, value)
            assert back.flags.writeable or back.size == 0
        else:
            assert back == value
    pose = Pose.from_center(np.eye(3), (1.0, 2.0, 3.0))
    assert unpacked(reader(packed(pose))).cam_from_world.tobytes() == pose.cam_from_world.tobytes()
    with pytest.raises(MalformedMessage, match="object"):
        packed([object()])


LENS = {"width": 4, "height": 3, "fx": 2.0, "fy": 2.0, "cx": 2.0, "cy": 1.5}


@pytest.mark.parametrize(
    "tree_and_arrays",
    [
        [{"array": 0}, [["|O", [1]]]],
        [{"array": 0}, [["<f8", [-1]]]],
        [{"array": 0}, [["<f8", [1 << 40]]]],
        [{"array": 3}, []],
        [{"class": "Popen", "fields": {}}, []],
        [{"class": "Camera", "fields": {"system": 1}}, []],
        [{"class": "Camera", "fields": {**LENS, "distortion": {"tuple": [1.0]}}}, []],
        [{"reduce": 1}, []],
        [{"a": 1, "b": 2}, []],
        {"no": "list"},
        7,
    ],
)
def test_nonsense_is_told_and_makes_nothing(tree_and_arrays):
    head = json.dumps(tree_and_arrays).encode()
    with pytest.raises((MalformedMessage, EOFError)):
        unpacked(reader(len(head).to_bytes(8, "little") + head))
    deep = b"[" * 100_000
    with pytest.raises(MalformedMessage):
        unpacked(reader(len(deep).to_bytes(8, "little") + deep))


@pytest.mark.slow
def test_nothing_of_this_pythons_environment_goes_along(elsewhere, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.devnull)
    method = remote(elsewhere)
    assert method.params == {"name": "shake", "tries": 8, "mood": "fine"}
    method.close()
    with pytest.raises(ConfigError, match="tires"):
        remote(elsewhere, tires=3)


@pytest.mark.slow
def test_check_method_there_takes_the_settings_that_a_method_has_for_the_trial(capsys):
    """Of a matcher that finds nothing on plain blocks all but the matcher is judged, and that is said."""
    assert main(["check-method", "cadloc", f"runner.python={sys.executable}"]) == 0
    printed = capsys.readouterr().out
    assert "matcher=oracle instead of sift_nn" in printed
    assert "cadloc keeps to the protocol" in printed


@pytest.mark.slow
def test_a_method_that_counts_poses_itself_answers_there_too():
    assert main(["check-method", "lodloc", f"runner.python={sys.executable}"]) == 0
