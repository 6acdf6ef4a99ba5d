"""Children that die, hang or write nonsense; messages come back as they went, and no other for them."""

import io
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
from hypothesis import given, settings
from hypothesis import strategies as st

from lodbench.errors import RenderingError, WorkersGone
from lodbench.geometry import Camera, Pose
from lodbench.harness.remote.child import Pipe
from lodbench.harness.remote.process import Child, MalformedMessage, ProcessFault, packed, unpacked

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


def test_what_goes_wrong_with_a_question_is_reported_to_who_asked():
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
    "head",
    [
        [{"array": 0}, [["|O", [1]]], 0],
        [{"array": 0}, [["<f8", [-1]]], 0],
        [{"array": 0}, [["<f8", [1 << 40]]], 0],
        [{"array": 3}, [], 0],
        [{"class": "Popen", "fields": {}}, [], 0],
        [{"class": "Camera", "fields": {"system": 1}}, [], 0],
        [{"class": "Camera", "fields": {**LENS, "distortion": {"tuple": [1.0]}}}, [], 0],
        [{"reduce": 1}, [], 0],
        [{"a": 1, "b": 2}, [], 0],
        [None, [["|u1", [0]]], 1],
        [None, []],
        {"no": "list"},
        7,
    ],
)
def test_nonsense_is_reported_and_makes_nothing(head):
    head = json.dumps(head).encode()
    with pytest.raises((MalformedMessage, EOFError)):
        unpacked(reader(len(head).to_bytes(8, "little") + head))
    deep = b"[" * 100_000
    with pytest.raises(MalformedMessage):
        unpacked(reader(len(deep).to_bytes(8, "little") + deep))


def test_a_hint_reaches_who_asked():
    fault = io.BytesIO(
        packed({"number": 1, "fault": "no such lens", "hint": "undo it", "kind": "RenderingError"})
    )
    with pytest.raises(RenderingError, match="no such lens") as caught:
        Pipe(fault, io.BytesIO()).ask("draw")
    assert caught.value.hint == "undo it"


QUERIES = 3
# What a right child says in turn: it asks once per query, and answers with numbers of that query.
RIGHT = [
    packed({"number": 2 * query + turn + 1, **said})
    for query in range(QUERIES)
    for turn, said in enumerate(({"ask": ["q", query]}, {"done": (query, np.full(4, float(query)))}))
]
# Of the next message and others: whole, cut short, or from their middle.
PIECE = st.tuples(st.integers(0, len(RIGHT) - 1), st.integers(0, 400), st.booleans())


class Scripted(Child):
    """A child whose pipe holds what a script says after each message that it is sent."""

    def __init__(self, script: list[list[bytes]]) -> None:
        self._number, self._errors, self._err_is_open = 0, b"", False
        self._script, self._waiting, self._exit = list(script), b"", 3
        self.is_closed = False

    def _has_unrequested(self) -> bool:
        return bool(self._waiting)

    def _write(self, content: bytes, deadline: float) -> None:
        assert content[8:]
        self._waiting += b"".join(self._script.pop(0)) if self._script else b""

    def _read(self, count: int, deadline: float) -> bytes:
        if len(self._waiting) < count:
            raise EOFError
        found, self._waiting = self._waiting[:count], self._waiting[count:]
        return found

    def _exit_code(self) -> int:
        return self._exit

    def close(self) -> None:
        self.is_closed = True


def answers(script: list[list[bytes]]) -> list[object]:
    """Returns the answers to the queries, None from the first that failed."""
    child, found = Scripted(script), []
    for query in range(QUERIES):
        try:
            said = child.call({"do": [query]}, lambda words, query=query: query, time.monotonic() + 60.0)
        except ProcessFault:
            assert child.is_closed
            return found + [None] * (QUERIES - len(found))
        found.append(said["done"])
    return found


def test_right_messages_are_the_answers():
    found = answers([[message] for message in RIGHT])
    assert [query for query, _ in found] == [0, 1, 2]
    assert all((values == query).all() for query, values in found)


@settings(max_examples=400, deadline=None)
@given(st.lists(st.lists(PIECE, max_size=3), min_size=2 * QUERIES, max_size=2 * QUERIES), st.data())
def test_no_message_becomes_anothers_answer(pieces, data):
    script = [
        [RIGHT[at][:cut] if is_start else RIGHT[at][cut:] for at, cut, is_start in said] for said in pieces
    ]
    # Right so far, so that what follows is looked at.
    for turn in range(data.draw(st.integers(0, 2 * QUERIES - 1))):
        script[turn][:0] = [RIGHT[turn]]
    for query, answer in enumerate(answers(script)):
        if answer is not None:
            assert answer[0] == query
            np.testing.assert_array_equal(answer[1], np.full(4, float(query)))
