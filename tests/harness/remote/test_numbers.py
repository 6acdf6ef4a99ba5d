"""No prefix, repetition or reordering of valid messages becomes another query's answer."""

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lodbench.harness.remote.process import Child, ProcessFault
from lodbench.harness.remote.wire import packed

pytestmark = pytest.mark.attack

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

    def _has_said(self) -> bool:
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
