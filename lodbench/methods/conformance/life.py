"""The rules of a method's life: what it may keep, and what its answers may depend on."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lodbench.errors import QueryFault
from lodbench.methods.conformance.rules import Violation
from lodbench.methods.conformance.trial import TrialAnswers, ask, streams_of
from lodbench.methods.localize import localize_queries, weight_files
from lodbench.methods.protocol import Estimate, Method, SupportsBatches, SupportsPrepare, Workspace

_STREAMS_HINT = "Draw random numbers from streams only; keep nothing in the class or module."
_STATE_HINT = "Keep no state between queries: what localize learns stays in it."


class _Killed(Exception):
    """Stands for the end of a process in the middle of a part."""


class _Interrupted(Workspace):
    """A workspace whose process ends within the part of a number, counted from 0."""

    def __init__(self, folder: Path, at: int) -> None:
        super().__init__(folder)
        self._at = at

    def part(self, name: str, make: Callable[[Path], None]) -> Path:
        """Returns a part; does not come back from the one of the number."""

        def half(path: Path) -> None:
            make(path)
            raise _Killed

        self._at -= 1
        return super().part(name, half if self._at < 0 else make)


class _Watched(Workspace):
    """A workspace that notes which parts were asked for, and which were made."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.asked: list[str] = []
        self.made: list[str] = []

    def part(self, name: str, make: Callable[[Path], None]) -> Path:
        """Returns a part, and notes it."""
        self.asked.append(name)
        if not (self.folder / name).exists():
            self.made.append(name)
        return super().part(name, make)


def untouched_queries(method: Method, answers: TrialAnswers) -> str:
    """A query is read, never written to: others use its mask afterwards."""
    for query in answers.trial.queries:
        if query.building_probability is None:
            return "there is no mask to write to"
        # Queries show it read-only; who makes it writable again is found here.
        mask = query.building_probability.copy()
        given = replace(query, building_probability=mask)
        with suppress(QueryFault):
            method.localize(given, answers.trial.city_map, streams_of(query))
        if not np.array_equal(mask, query.building_probability):
            raise Violation(f"{query.name}: the mask was written to", "Work on a copy of the mask.")
    return "masks are as they were"


def same_again(method: Method, answers: TrialAnswers) -> str:
    """The same queries and streams give the same answers to the bit."""
    for query in answers.trial.queries:
        if _values(ask(method, answers.trial, query)) != _values(answers.by_name[query.name]):
            raise Violation(f"{query.name}: another answer from the same streams", _STREAMS_HINT)
    return "the same streams, the same answers to the bit"


def any_order(method: Method, answers: TrialAnswers) -> str:
    """An answer does not depend on the queries before it: runs resume, and share out their work."""
    for query in (*reversed(answers.trial.queries), answers.trial.queries[-1]):
        if _values(ask(method, answers.trial, query)) != _values(answers.by_name[query.name]):
            raise Violation(f"{query.name}: another answer where other queries came before", _STATE_HINT)
    return "backwards and twice, the same answers"


def preparation_resumes(make: Callable[[], Method], answers: TrialAnswers) -> str:
    """What was prepared is found again, whole, also after a kill; and answers do not depend on it."""
    trial, method = answers.trial, make()
    if not isinstance(method, SupportsPrepare):
        return "not offered"
    again = _Watched(trial.folder / "workspace")
    method.prepare(trial.city_map, trial.references, again)
    if again.made:
        raise Violation(f"{again.made[0]} was made anew", "A part's name depends on nothing but its content.")
    resumed = trial.folder / "interrupted"
    last = len(again.asked) - 1
    if again.asked:
        try:
            broken = make()
            assert isinstance(broken, SupportsPrepare)  # noqa: S101
            broken.prepare(trial.city_map, trial.references, _Interrupted(resumed, last))
        except _Killed:
            pass
    rest, method = _Watched(resumed), make()
    assert isinstance(method, SupportsPrepare)  # noqa: S101
    method.prepare(trial.city_map, trial.references, rest)
    if len(set(rest.made)) > 1:
        raise Violation(f"{rest.made[0]} was made again after a kill", "Use workspace.part for all.")
    for query in trial.queries:
        if _values(ask(method, trial, query)) != _values(answers.by_name[query.name]):
            raise Violation(f"{query.name}: another answer after a kill", "Keep all in the workspace.")
    return f"{len(set(again.asked))} parts, found again after a kill"


def batches_answer_alike(method: Method, answers: TrialAnswers) -> str:
    """A batch gives the answers that its queries get one by one."""
    trial = answers.trial
    if not isinstance(method, SupportsBatches):
        return "not offered"
    if method.batch_size < 1:
        raise Violation(f"batch_size is {method.batch_size}", "It is at least 1.")
    streams = [streams_of(query) for query in trial.queries]
    for query, found in zip(
        trial.queries, localize_queries(method, trial.queries, trial.city_map, streams), strict=True
    ):
        if _values(found) != _values(answers.by_name[query.name]):
            raise Violation(f"{query.name}: another answer in a batch", "Let both share their code.")
    return f"up to {method.batch_size} at a time, the same answers"


def another_seed(method: Method, answers: TrialAnswers) -> str:
    """Another seed is no fault; its answer may differ."""
    query = answers.trial.queries[0]
    is_same = _values(ask(method, answers.trial, query, seed=1)) == _values(answers.by_name[query.name])
    return "same answer (no random numbers used)" if is_same else "differs by seed (allowed)"


def empty_mask(method: Method, answers: TrialAnswers) -> str:
    """A mask without a building is a fault of the query, unless the method looks at no mask."""
    query = answers.trial.queries[0]
    if query.building_probability is None:
        return "no mask is required"
    empty = replace(query, building_probability=np.zeros_like(query.mask))
    found = ask(method, answers.trial, empty)
    if isinstance(found, QueryFault):
        return f"QueryFault: {found.message}"
    if _values(found) == _values(answers.by_name[query.name]):
        raise Violation("the same answer: the mask is not looked at", "Set requires = frozenset().")
    raise Violation("it is answered", "Raise QueryFault('the mask holds no building').")


def weights_are_there(method: Method) -> str:
    """Files that a method says it reads exist."""
    files = weight_files(method)
    return ", ".join(file.name for file in files) or "none"


def _values(found: Estimate | QueryFault) -> tuple[Any, ...]:
    """Returns an answer as values that are equal if it is the same to the bit; times are left out."""
    if isinstance(found, QueryFault):
        return (found.message,)
    covariance = b"" if found.covariance is None else np.asarray(found.covariance).tobytes()
    return (found.pose.cam_from_world.tobytes(), repr(float(found.score)), found.probability, covariance)
