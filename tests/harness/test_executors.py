"""Runs over processes and over Dask: the files of a serial run, byte for byte, whoever dies."""

import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from lodbench.cli import main
from lodbench.errors import DatasetError, LodbenchError, WorkersGone
from lodbench.execution.executor import ExecutorParams, spread
from lodbench.harness.runs.predict import SharedScorer
from tests.town import write_dataset

pytestmark = pytest.mark.attack

# Times, machine facts, and answers in the order they came.
APART = {"timings.csv", "provenance.json", "predictions.jsonl", "multirun.yaml"}
SAME = ("config.yaml", "poses.txt", "queries.csv", "summary.json", "priors.txt")


def run(tmp_path: Path, name: str, *more: str) -> dict[str, bytes]:
    words = [f"dataset.root={tmp_path / 'town/data'}", f"dataset.city_model={tmp_path / 'town/city.obj'}"]
    words += ["method.steps=2", "segmenter=masks", f"paths.runs={tmp_path / name}"]
    assert main(["run", "dataset=folder", *words, *more]) == 0
    (folder,) = (tmp_path / name).glob("*/*/*")
    return {file: (folder / file).read_bytes() for file in SAME}


@pytest.fixture(scope="module")
def serial(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, bytes]]:
    folder = tmp_path_factory.mktemp("executors")
    write_dataset(folder / "town", 5)
    return folder, run(folder, "serial")


@pytest.mark.nightly
def test_two_processes(serial) -> None:
    folder, expected = serial
    assert run(folder, "process", "executor=process", "executor.workers=2") == expected


@pytest.mark.nightly
def test_dask(serial) -> None:
    pytest.importorskip("distributed")
    folder, expected = serial
    assert run(folder, "dask", "executor=dask", "executor.workers=2") == expected


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["process", "dask"])
def test_the_grid_of_one_query_of_a_wide_basin_shared_by_two_workers(serial, tmp_path, monkeypatch, name):
    made, shared = {}, []
    monkeypatch.setattr(SharedScorer, "_shared", counted(SharedScorer._shared, shared))
    words = [f"dataset.root={serial[0] / 'town/data'}", f"dataset.city_model={serial[0] / 'town/city.obj'}"]
    words += ["dataset=folder", "segmenter=masks", "method.steps=1", "yaw_ranges=[]", "limit=1"]
    for executor, more in (("serial", []), (name, ["executor.workers=2", "executor.share=hypotheses"])):
        (tmp_path / executor).mkdir()
        # Results name the folders of their runs: the same name, seen from where the command stands.
        monkeypatch.chdir(tmp_path / executor)
        assert main(["basin", *words, "ranges=[200]", "maps=false", f"executor={executor}", *more]) == 0
        files = [path for path in Path().rglob("*") if path.is_file() and path.name not in APART]
        made[executor] = {path: path.read_bytes() for path in files}
    assert any(path.name == "basin.csv" for path in made["serial"])
    assert made[name] == made["serial"]
    assert max(shared) > 500_000


def counted(function, numbers: list[int]):
    def call(self, camera, rotations, centers, *more):
        numbers.append(len(centers))
        return function(self, camera, rotations, centers, *more)

    return call


@pytest.mark.nightly
def test_training_data_over_dask(serial, tmp_path) -> None:
    pytest.importorskip("distributed")
    words = [f"city={serial[0] / 'town/city.obj'}", "pitch=[40]", "height=[90]", "size=[96,80]"]
    words += ["yaw=[0,180]", "spacing_m=60", "val_share=0", "test_share=0"]
    made = {}
    for name in ("serial", "dask"):
        more = [f"out={tmp_path / name}", f"executor={name}", *["executor.workers=2"] * (name == "dask")]
        assert main(["generate-training-data", *words, *more, "limit=6"]) == 0
        files = (path for path in (tmp_path / name).rglob("*") if path.is_file())
        made[name] = {path.relative_to(tmp_path / name): path.read_bytes() for path in files}
    assert len(made["serial"]) > 12
    assert made["dask"] == made["serial"]


@pytest.mark.nightly
def test_training_data_sends_names_over_dask_and_notices_another_world(serial, tmp_path, monkeypatch) -> None:
    sent = []

    def here(executor, work, items, prepare, prepare_with):
        sent.append(len(pickle.dumps(prepare_with)))
        params, options, digest, out, code = prepare_with
        with pytest.raises(DatasetError, match="are others for a worker"):
            prepare(params, options, digest[::-1], out, code)
        with pytest.raises(LodbenchError, match="is not the command's"):
            prepare(params, options, digest, out, code[::-1])
        prepare(*prepare_with)
        return map(work, items)

    monkeypatch.setattr("lodbench.synthesis.generate.spread", here)
    words = [
        f"city={serial[0] / 'town/city.obj'}",
        "pitch=[40]",
        "height=[90]",
        "size=[96,80]",
        "yaw=[0,180]",
    ]
    words += ["spacing_m=60", "val_share=0", "test_share=0", "limit=2", f"out={tmp_path}"]
    assert main(["generate-training-data", *words, "executor=dask"]) == 0
    assert sent[0] < 10_000


def test_a_scheduler_that_is_not_there(serial, capsys, monkeypatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("lodbench.execution.executor._CONNECT_S", 1)
    words = [f"dataset.root={serial[0] / 'town/data'}", f"dataset.city_model={serial[0] / 'town/city.obj'}"]
    more = ["segmenter=masks", f"paths.runs={serial[0] / 'none'}", "executor=dask"]
    assert main(["run", "dataset=folder", *words, *more, "executor.address=tcp://127.0.0.1:9"]) == 2
    assert "scheduler tcp://127.0.0.1:9 does not answer" in capsys.readouterr().err
    for address in ("foo", "tcp://", "http://x:1"):
        assert main(["run", "dataset=folder", *words, *more, f"executor.address={address}"]) == 2
        assert f"executor.address={address} is no address" in capsys.readouterr().err


@dataclass
class Deadly:
    """Kills the process it is prepared in at some items, as often as files can be taken away."""

    folder: Path


_deadly: list[Deadly] = []


def prepare(deadly: Deadly) -> None:
    _deadly[:] = [deadly]


def square_or_die(item: int) -> int:
    lives = _deadly[0].folder / f"{item}"
    if lives.exists():
        lives.unlink()
        os.kill(os.getpid(), signal.SIGKILL)
    return item * item


# A single worker takes all it was given with it.
@pytest.mark.parametrize(
    ("name", "workers"),
    [("process", 3), *(pytest.param("dask", count, marks=pytest.mark.nightly) for count in (3, 1))],
)
def test_what_a_dead_worker_was_at_is_done_again(tmp_path: Path, name: str, workers: int) -> None:
    if name == "dask":
        pytest.importorskip("distributed")
    for item in (3, 11):
        (tmp_path / f"{item}").touch()
    executor = ExecutorParams(name, workers=workers)
    results = sorted(spread(executor, square_or_die, range(20), prepare, (Deadly(tmp_path),)))
    assert results == [item * item for item in range(20)]
    assert not list(tmp_path.iterdir())


def die(item: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return item


def test_workers_that_keep_dying_end_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(WorkersGone, match="keep dying"):
        list(spread(ExecutorParams("process", workers=2), die, range(4), prepare, (Deadly(tmp_path),)))


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["process", "dask"])
def test_workers_that_die_over_a_shared_grid_end_the_run_and_are_no_query_s_failure(
    serial, tmp_path, monkeypatch, capsys, name
) -> None:
    monkeypatch.setattr("lodbench.harness.runs.predict._score_here", die)
    words = [f"dataset.root={serial[0] / 'town/data'}", f"dataset.city_model={serial[0] / 'town/city.obj'}"]
    words += "dataset=folder segmenter=masks method.steps=1 limit=1 ranges=[200] yaw_ranges=[]".split()
    words += ["maps=false", f"paths.runs={tmp_path}", f"executor={name}", "executor.share=hypotheses"]
    assert main(["basin", *words, "executor.workers=2"]) == 2
    assert "Workers keep dying" in capsys.readouterr().err
    assert [path.read_bytes() for path in tmp_path.rglob("predictions.jsonl")] in ([], [b""])


def cannot(reason: str) -> None:
    raise DatasetError(reason, "Look elsewhere.")


@pytest.mark.parametrize("name", ["process", pytest.param("dask", marks=pytest.mark.nightly)])
def test_workers_that_cannot_begin_say_why(name: str) -> None:
    with pytest.raises(WorkersGone, match="cannot begin: another city") as caught:
        list(spread(ExecutorParams(name, workers=2), square_or_die, range(4), cannot, ("another city",)))
    assert caught.value.hint == "Look elsewhere."


def hang_once(item: int) -> int:
    lives = _deadly[0].folder / f"{item}"
    if lives.exists():
        lives.unlink()
        time.sleep(600)
    return item * item


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["process", "dask"])
def test_what_a_hung_worker_was_at_is_done_again(tmp_path: Path, name: str) -> None:
    if name == "dask":
        pytest.importorskip("distributed")
    (tmp_path / "5").touch()
    # Longer than workers take to start, where many things run.
    executor = ExecutorParams(name, workers=2, timeout_s=8)
    results = sorted(spread(executor, hang_once, range(8), prepare, (Deadly(tmp_path),)))
    assert results == [item * item for item in range(8)]


@pytest.mark.nightly
def test_a_worker_that_dask_gives_up_is_replaced(tmp_path: Path, monkeypatch) -> None:
    """On a busy machine one that had died started too slowly; then nobody was left, and nobody said so."""
    pytest.importorskip("distributed")
    monkeypatch.setattr("lodbench.execution.executor._LOST_S", 0.01)
    monkeypatch.setattr("lodbench.execution.executor._REPLACE_S", 1)
    (tmp_path / "5").touch()
    executor = ExecutorParams("dask", workers=1)
    results = sorted(spread(executor, square_or_die, range(8), prepare, (Deadly(tmp_path),)))
    assert results == [item * item for item in range(8)]


@pytest.mark.nightly
def test_a_scheduler_that_goes_away_is_one_line(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    cluster = distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None)
    try:
        executor = ExecutorParams("dask", address=cluster.scheduler_address)
        results = spread(executor, square_or_die, range(200), prepare, (Deadly(tmp_path),))
        next(results)
        cluster.close()
        with pytest.raises(WorkersGone, match="is gone"):
            list(results)
    finally:
        cluster.close()


@pytest.mark.nightly
def test_a_run_over_three_dask_workers_of_which_two_are_killed(tmp_path) -> None:
    psutil = pytest.importorskip("psutil")
    pytest.importorskip("distributed")
    write_dataset(tmp_path / "town", 24)
    expected = run(tmp_path, "serial", "method.steps=20")
    killed: list[int] = []

    def answers() -> int:
        return sum(path.read_bytes().count(b"\n") for path in (tmp_path / "dask").rglob("predictions.jsonl"))

    def kill_twice() -> None:
        for least in (1, 8):
            while answers() < least:
                time.sleep(0.02)
            workers = [
                each for each in psutil.Process().children() if "spawn_main" in " ".join(each.cmdline())
            ]
            # Those that have worked longest are workers, and at work.
            worker = max(workers, key=lambda each: sum(each.cpu_times()[:2]))
            worker.kill()
            killed.append(worker.pid)

    killer = threading.Thread(target=kill_twice, daemon=True)
    killer.start()
    found = run(tmp_path, "dask", "method.steps=20", "executor=dask", "executor.workers=3")
    killer.join(10)
    assert len(set(killed)) == 2
    assert found == expected


_AT_WORK = """
import signal, time
from lodbench.execution.executor import dask_workers

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a parent may have had it ignored
    with dask_workers(None, 2, 60.0, print, ("begun",)) as workers:
        try:
            for number, _ in enumerate(workers.map(time.sleep, [0.05] * 500)):
                if number == 3:
                    print("at work", flush=True)
        except KeyboardInterrupt:
            print("stopped", flush=True)
"""


@pytest.mark.nightly
def test_ctrl_c_is_answered_by_the_parent_alone(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    (tmp_path / "work.py").write_text(_AT_WORK)
    work = subprocess.Popen(
        [sys.executable, "work.py"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert work.stdout is not None
    assert any("at work" in line for line in work.stdout)
    os.killpg(work.pid, signal.SIGINT)
    reported, complaints = work.communicate(timeout=60)
    assert "stopped" in reported
    assert "Process Dask Worker" not in complaints
    assert "KeyboardInterrupt" not in complaints
