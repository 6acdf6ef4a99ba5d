"""Workers that processes fork from leave Ctrl-C to the process that was asked."""

import os
import signal
import subprocess
import sys
import threading

import pytest

from lodbench.errors import WorkersGone
from lodbench.execution import fan_out
from lodbench.execution import fan_out as ctrl_c
from lodbench.execution.fan_out import ctrl_c_for_this_thread, start_tracker

# The server imports a module that tells whether Ctrl-C would reach it.
_MODULE = (
    "import signal, sys; sys.stderr.write(f'blocked: {signal.SIGINT in signal.pthread_sigmask(0, ())}\\n')"
)
_SCRIPT = """
import multiprocessing, time
from lodbench.execution.fan_out import expect_workers
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


def test_what_cannot_go_to_another_process_is_said_in_a_line():
    held = threading.Lock()
    with pytest.raises(WorkersGone, match="cannot go to another process: cannot pickle") as fault:
        list(fan_out.fan_out(str, [1, 2], 2, print, (held,)))
    assert "executor=serial" in fault.value.hint


def test_where_no_signal_can_be_blocked_workers_start_all_the_same(monkeypatch):
    monkeypatch.delattr(signal, "pthread_sigmask")
    monkeypatch.setattr(ctrl_c.resource_tracker, "ensure_running", lambda: pytest.fail("Windows has none"))
    start_tracker()
    with ctrl_c_for_this_thread():
        pass


def test_the_tracker_runs_before_workers_where_there_is_no_server_too(monkeypatch):
    """As on macOS: the first worker would start it, and Ctrl-C would come through."""
    begun = []
    monkeypatch.setattr(fan_out, "_START", "spawn")
    monkeypatch.setattr(ctrl_c.resource_tracker, "ensure_running", lambda: begun.append(True))
    fan_out.expect_workers(("told",))
    assert begun
