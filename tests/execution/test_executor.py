"""Workers leave Ctrl-C to the process that has the terminal; what goes to those of a Dask cluster."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from lodbench.errors import WorkersGone
from lodbench.execution import processes
from lodbench.execution.executor import DaskWorkers, _on_worker, dask_workers
from lodbench.execution.processes import ctrl_c_for_this_thread, start_tracker

# The server imports a module that tells whether Ctrl-C would reach it.
_MODULE = (
    "import signal, sys; sys.stderr.write(f'blocked: {signal.SIGINT in signal.pthread_sigmask(0, ())}\\n')"
)
_SCRIPT = """
import multiprocessing, time
from lodbench.execution.processes import expect_workers
if __name__ == "__main__":
    expect_workers(("told",))
    process = multiprocessing.get_context("forkserver").Process(target=time.sleep, args=(0,))
    process.start()
    process.join()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="workers fork from a server on Linux alone")
def test_ctrl_c_while_the_server_imports_is_this_process_to_answer(tmp_path):
    (tmp_path / "told.py").write_text(_MODULE)
    (tmp_path / "script.py").write_text(_SCRIPT)
    path = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    run = subprocess.run(
        [sys.executable, str(tmp_path / "script.py")],
        capture_output=True,
        text=True,
        timeout=100,
        check=True,
        env=os.environ | {"PYTHONPATH": path},
    )
    assert "blocked: True" in run.stderr


def test_where_no_signal_can_be_blocked_workers_start_all_the_same(monkeypatch):
    monkeypatch.delattr(signal, "pthread_sigmask")
    monkeypatch.setattr(processes.resource_tracker, "ensure_running", lambda: pytest.fail("Windows has none"))
    start_tracker()
    with ctrl_c_for_this_thread():
        pass


def test_the_tracker_runs_before_workers_where_there_is_no_server_too(monkeypatch):
    """As on macOS: the first worker would start it, and Ctrl-C would come through."""
    begun = []
    monkeypatch.setattr(processes, "_START", "spawn")
    monkeypatch.setattr(processes.resource_tracker, "ensure_running", lambda: begun.append(True))
    processes.expect_workers(("told",))
    assert begun


pytestmark = pytest.mark.attack


class Segmenter:
    """As those of photos: loads what no other process can be sent, once it is asked."""

    def __init__(self) -> None:
        self.network: Any = None


_at_work: list[Segmenter] = []


def load(segmenter: Segmenter) -> None:
    segmenter.network = threading.Lock()
    _at_work[:] = [segmenter]


def is_loaded(_: int) -> bool:
    return _at_work[0].network is not None


class OneWorker:
    """A client whose one worker is this process, and which keeps what it is handed."""

    def __init__(self) -> None:
        self.kept: list[Any] = []

    def nthreads(self) -> dict[str, int]:
        return {"here": 1}

    def submit(self, work: Callable[..., Any], *items: Any, **_: Any) -> Any:
        self.kept.append(work(*items))
        return self.kept[-1]


def test_what_a_worker_was_prepared_with_can_be_handed_to_the_next() -> None:
    """Workers fetch it from one another: one that could not be sent left the second waiting for ever."""
    protocol = pytest.importorskip("distributed.protocol.pickle")
    client = OneWorker()
    DaskWorkers(client, "here", load, (Segmenter(),), 1, 1.0)
    (common,) = client.kept
    assert _on_worker(common, is_loaded, 0)
    _, preparation = protocol.loads(protocol.dumps(common))
    assert isinstance(preparation, bytes)


def nothing(*_: Any) -> None:
    pass


def test_a_cluster_without_workers_says_how_they_start(caplog) -> None:
    pytest.importorskip("distributed.protocol.pickle")
    client = OneWorker()
    client.nthreads = dict
    DaskWorkers(client, "tcp://10.0.0.1:8786", nothing, (), 2, 1.0)
    assert "`dask worker tcp://10.0.0.1:8786 --nthreads 1` starts one" in caplog.text
    caplog.clear()
    DaskWorkers(client, "on this machine", nothing, (), 2, 1.0, own=object())
    assert caplog.text == ""


def test_workers_that_go_are_told_once_and_a_scheduler_that_does_not_answer_is_none(monkeypatch, caplog):
    distributed = pytest.importorskip("distributed")
    client, answers = OneWorker(), [{}, {}, {"back": 1}, {}, OSError("Timed out trying to connect")]
    workers = DaskWorkers(client, "tcp://10.0.0.1:8786", nothing, (), 1, 0.0)

    def nthreads() -> Any:
        answer = answers.pop(0)
        if isinstance(answer, OSError):
            raise answer
        return answer

    def wait(*_: Any) -> Any:
        raise TimeoutError

    client.nthreads = nthreads
    monkeypatch.setattr(distributed, "wait", wait)
    for left in (2, 0):  # by the one that is back, and by what is not known
        with pytest.raises(TimeoutError):
            workers._wait({"work"})
        assert len(answers) == left
    assert caplog.text.count("has no worker: `dask worker") == 2


def test_workers_that_come_late_are_waited_for(monkeypatch) -> None:
    """A queue gives them when it has some; nobody who is not there hangs."""
    distributed = pytest.importorskip("distributed")
    client, asked = OneWorker(), []
    client.nthreads = lambda: {"late": 1} if len(asked) > 3 else {}

    def wait(running: set[Any], *_: Any) -> Any:
        asked.append(running)
        if len(asked) < 6:
            raise TimeoutError
        return running, set()

    monkeypatch.setattr(distributed, "wait", wait)
    workers = DaskWorkers(client, "there", nothing, (), 1, 0.0)
    with pytest.raises(TimeoutError):  # by the one that has come
        workers._wait({"work"})
    assert len(asked) == 4
    assert DaskWorkers(client, "there", nothing, (), 1, 100.0)._wait({"work"}) == ({"work"}, set())


def test_a_result_that_is_lost_with_its_worker_is_waited_for_from_another(monkeypatch) -> None:
    """One that was done, but not fetched, was waited for by a run whose workers nobody replaced."""
    distributed = pytest.importorskip("distributed")
    client, replaced = OneWorker(), list[int]()
    own = SimpleNamespace(worker_spec={0: {}, 1: {}}, scale=replaced.append)

    class Future:
        status = "finished"

        def result(self, _: float) -> int:
            if not replaced or self.status == "error":
                raise TimeoutError
            return 7

    future = Future()
    client.submit = lambda *_, **__: future  # type: ignore[method-assign]
    monkeypatch.setattr(distributed, "wait", lambda *_: ([future], set()))
    assert [*DaskWorkers(client, "here", nothing, (), 1, 60.0, own).map(nothing, [0])] == [7]
    assert replaced == [2]
    replaced.clear()
    with pytest.raises(WorkersGone, match="keep dying"):
        [*DaskWorkers(client, "here", nothing, (), 1, 0.0, own).map(nothing, [0])]
    future.status = "error"  # the work's own
    with pytest.raises(TimeoutError):
        [*DaskWorkers(client, "here", nothing, (), 1, 60.0, own).map(nothing, [0])]


def folder_of(_: int) -> str:
    return str(Path.cwd())


def test_paths_are_relative_to_the_command_s_folder(tmp_path, monkeypatch) -> None:
    pytest.importorskip("distributed")
    client = OneWorker()
    monkeypatch.chdir(tmp_path)
    DaskWorkers(client, "here", nothing, (), 1, 1.0)
    monkeypatch.chdir("/")  # where the worker was started
    assert _on_worker(client.kept[0], folder_of, 0) == str(tmp_path)


_inside: list[int] = []


def stay(item: int) -> int:
    """Returns how many items this process is at."""
    _inside.append(item)
    time.sleep(0.02)
    count = len(_inside)
    _inside.remove(item)
    return count


def test_a_worker_of_several_threads_does_one_item_at_a_time() -> None:
    """They would share a map that counts the poses drawn: `dask worker` starts a thread for each core."""
    pytest.importorskip("distributed")
    client = OneWorker()
    DaskWorkers(client, "here", load, (Segmenter(),), 1, 1.0)
    with ThreadPoolExecutor(3) as threads:
        assert set(threads.map(partial(_on_worker, client.kept[0], stay), range(6))) == {1}


def test_workers_are_counted_not_their_threads(caplog) -> None:
    pytest.importorskip("distributed")
    client = OneWorker()
    client.nthreads = lambda: {"one": 4, "two": 4}  # type: ignore[method-assign]
    assert DaskWorkers(client, "here", load, (Segmenter(),), 1, 1.0).count == 2
    assert "--nthreads 1" in caplog.text


def test_the_dashboard_is_for_this_machine_alone() -> None:
    pytest.importorskip("distributed")
    with dask_workers(None, 1, 60.0, load, (Segmenter(),)) as workers:
        server = workers._client.cluster.scheduler.http_server
        listeners = [socket.getsockname()[0] for socket in server._sockets.values()]
        assert listeners
        assert set(listeners) == {"127.0.0.1"}


def test_what_cannot_go_to_another_process_is_said_in_a_line():
    held = threading.Lock()
    with pytest.raises(WorkersGone, match="cannot go to another process: cannot pickle") as fault:
        list(processes.fan_out(str, [1, 2], 2, print, (held,)))
    assert "executor=serial" in fault.value.hint
