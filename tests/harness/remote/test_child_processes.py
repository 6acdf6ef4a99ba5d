"""Children that die, hang or write nonsense."""

import json
import os
import re
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from lodbench.errors import WorkersGone
from lodbench.harness.remote.process import Child, ProcessFault

pytestmark = pytest.mark.attack

# What a child may do in place of an answer; it has read the question.
READ = "import os, sys, time; n = int.from_bytes(os.read(0, 8), 'little'); os.read(0, n); "


HEAD = "h = {head!r}.encode(); os.write(1, len(h).to_bytes(8, 'little') + h); "
DONE = '["number", 1], ["done", 2]'


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
        (HEAD.format(head='["done", [], 0]') + "time.sleep(60)", 20.0, "stopped, for a message is no word"),
        (
            HEAD.format(head='[{"dict": [["number", 2], ["done", 0]]}, [], 0]') + "time.sleep(60)",
            20.0,
            "stopped, for a message has the number 2 where 1 was due",
        ),
        (
            HEAD.format(head='[{"dict": [["done", 0]]}, [], 0]') + "time.sleep(60)",
            20.0,
            "stopped, for a message has the number None where 1 was due",
        ),
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


def test_what_came_before_it_was_asked_for_is_no_answer():
    """Two processes answer where a method forks: the second answer must not be the next query's."""
    twice = 2 * HEAD.format(head=f'[{{"dict": [{DONE}]}}, [], 0]')
    child = child_that(twice + "time.sleep(60)")
    assert child.call({"do": []}, lambda words: None, 20.0)["done"] == 2
    # By what comes first: the look before the question, or the number of what is read after it.
    with pytest.raises(ProcessFault, match=r"that nobody had requested|has the number 1 where 2 was due"):
        child.call({"do": []}, lambda words: None, 20.0)
    assert child._process.returncode is not None


def test_standard_error_of_any_length_is_read_and_its_end_kept():
    """Twenty million bytes: neither a disk nor the memory is filled, and nobody waits for room."""
    flood = "[os.write(2, b'x' * 99999 + b'\\n') for _ in range(100)]; "
    child = child_that(flood + HEAD.format(head=f'[{{"dict": [{DONE}]}}, [], 0]') + flood + "os._exit(5)")
    tracemalloc.start()
    assert child.call({"do": []}, lambda words: None, 60.0)["done"] == 2
    with pytest.raises(ProcessFault, match="ended with exit code 5"):
        child.call({"do": []}, lambda words: None, 60.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 22


def assert_ends(pid: int) -> None:
    for _ in range(200):
        # An orphan that has ended may wait for a moment to be taken off the list.
        state = Path(f"/proc/{pid}/stat")
        if not state.exists() or state.read_text().split()[2] == "Z":
            return
        time.sleep(0.02)
    raise AssertionError(f"process {pid} still runs")


@pytest.mark.parametrize("has_waitid", [True, False])
@pytest.mark.parametrize(
    ("ending", "timeout_s", "reason"),
    [("os._exit(4)", 20.0, "ended with exit code 4"), ("time.sleep(60)", 1.0, "gave no answer in 1 s")],
)
def test_what_a_child_started_ends_with_it(ending, timeout_s, reason, has_waitid, monkeypatch):
    """Both where it is stopped and where it died by itself; macOS has no ``waitid`` before Python 3.13."""
    if not has_waitid:
        monkeypatch.delattr(os, "waitid")
    started = "import subprocess; p = subprocess.Popen(['sleep', '60'], stdout=2); "
    started += "print(p.pid, file=sys.stderr, flush=True); "
    with pytest.raises(ProcessFault, match=reason) as caught:
        child_that(started + ending).call({"do": []}, lambda words: None, timeout_s)
    (pid,) = [int(word) for word in re.findall(r"\d+", caught.value.__notes__[0])]
    assert_ends(pid)


def test_room_is_made_for_what_came_not_for_what_is_said_to_come():
    """A head that announces an array of 7 GB, and no such bytes."""
    head = json.dumps([{"dict": [["done", {"array": 0}]]}, [["|u1", [7 << 30]]], 0])
    child = child_that(HEAD.format(head=head) + "time.sleep(60)")
    tracemalloc.start()
    with pytest.raises(ProcessFault, match="gave no answer"):
        child.call({"do": []}, lambda words: None, 0.5)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 24


def test_what_goes_wrong_with_a_question_is_told_to_who_asked():
    ask = HEAD.format(head='[{"dict": [["number", 1], ["ask", ["draw", 3]]]}, [], 0]')
    again = "n = int.from_bytes(os.read(0, 8), 'little'); os.write(2, os.read(0, n)); os._exit(3)"

    def answer(words: list) -> None:
        raise ValueError(words[1])

    with pytest.raises(ProcessFault, match=r"exit code 3: .*\[\"fault\", \"ValueError: 3\"\]"):
        child_that(ask + again).call({"do": []}, answer, 20.0)


def test_workers_that_are_gone_end_the_run_and_no_query():
    ask = HEAD.format(head='[{"dict": [["number", 1], ["ask", ["draw", 3]]]}, [], 0]')

    def answer(words: list) -> None:
        raise WorkersGone("they are gone")

    child = child_that(ask + "time.sleep(60)")
    with pytest.raises(WorkersGone, match="they are gone"):
        child.call({"do": []}, answer, 20.0)
    assert child._process.returncode is not None


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
