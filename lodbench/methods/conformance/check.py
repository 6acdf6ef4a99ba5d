"""Does a method keep to the protocol? Its class, and its answers to a trial, looked at rule by rule."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lodbench.checks import FAULT, OK, Check
from lodbench.errors import LodbenchError, QueryFault
from lodbench.methods.conformance.rules import (
    AnswersByName,
    TrialAnswers,
    Violation,
    answered,
    counted_hypotheses,
    finite_pose,
    frozen_parameters,
    near_the_prior,
    plain_score,
    right_name,
    right_prior_params,
    sound_uncertainty,
    whole_configuration,
)
from lodbench.methods.conformance.trial import CountingScorer, Trial, ask, make_trial
from lodbench.methods.protocol import Estimate, Method

_STREAMS_HINT = "Draw random numbers from streams only; keep nothing in the class or module."


def check_class(
    kind: Any,
    name: str,
    load: Callable[[], Mapping[str, Any] | None],
    read: Callable[[Mapping[str, Any]], Any],
    where: str,
) -> Iterator[Check]:
    """Yields what there is to say of a method's class, its parameters and its configuration.

    Args:
        kind: What the entry point names.
        name: The entry point's name.
        load: Returns the method's section of a run's configuration; None if there is none.
        read: Makes parameters from such a section.
        where: The file that should hold it.
    """
    yield _checked("plug-in", "name", lambda: right_name(kind, name))
    parameters = _checked("plug-in", "parameters", lambda: frozen_parameters(kind, name))
    yield parameters
    if parameters.status == OK:
        yield _checked("plug-in", "configuration", lambda: whole_configuration(kind, load(), read, where))


def check_answers(make: Callable[[], Method]) -> Iterator[Check]:
    """Yields what there is to say of a method's answers to the trial.

    Args:
        make: Makes the method anew, as a run does.
    """
    with tempfile.TemporaryDirectory() as folder:
        trial = make_trial(Path(folder))
        masks = [query.mask.copy() for query in trial.queries]
        try:
            answers = _collect(make, trial)
        except Exception as error:  # a method may raise anything: that is what is told
            yield Check(
                "answers", "answers", FAULT, _words(error), "Raise QueryFault where there is no answer."
            )
            return
        first = _checked("answers", "answers", lambda: answered(answers))
        yield first
        if first.status == OK:
            yield from _look_closer(make, answers, masks)


def _look_closer(make: Callable[[], Method], answers: TrialAnswers, masks: Sequence[Any]) -> Iterator[Check]:
    """Yields the checks that need an estimate to look at."""
    pose = _checked("answers", "pose", lambda: finite_pose(answers))
    yield pose
    if pose.status == OK:
        yield _checked("answers", "frame", lambda: near_the_prior(answers))
    yield _checked("answers", "score", lambda: plain_score(answers))
    yield _checked("answers", "hypotheses", lambda: counted_hypotheses(answers))
    yield _checked("answers", "uncertainty", lambda: sound_uncertainty(answers))
    yield _checked("answers", "query", lambda: _untouched(answers.trial, masks))
    again = _checked("answers", "same again", lambda: _same_again(make(), answers))
    yield again
    if again.status == OK:
        yield _checked("answers", "any order", lambda: _any_order(make(), answers))
    yield _checked("answers", "another seed", lambda: _another_seed(make(), answers))
    yield _checked("answers", "empty mask", lambda: _empty_mask(make(), answers))
    yield _checked("answers", "prior width", lambda: right_prior_params(make()))


def _checked(section: str, title: str, rule: Callable[[], str]) -> Check:
    """Returns how a rule is kept."""
    try:
        return Check(section, title, OK, rule())
    except Violation as violation:
        return Check(section, title, FAULT, str(violation), violation.hint)
    except LodbenchError as error:
        return Check(section, title, FAULT, error.message, error.hint)
    except Exception as error:  # of the method, or of values that are not what they should be
        return Check(section, title, FAULT, _words(error))


def _words(error: Exception) -> str:
    return error.message if isinstance(error, LodbenchError) else f"{type(error).__name__}: {error}"


def _collect(make: Callable[[], Method], trial: Trial) -> TrialAnswers:
    """Returns what a method says, once another like it was asked, so that all is compiled."""
    ask(make(), trial.scorer, trial.queries[0])
    method = make()
    answers: AnswersByName = {}
    rendered = {}
    started = time.perf_counter()
    for query in trial.queries:
        counting = CountingScorer(trial.scorer)
        answers[query.name] = ask(method, counting, query)
        rendered[query.name] = counting.count
    return TrialAnswers(trial, answers, rendered, (time.perf_counter() - started) / len(trial.queries))


def _untouched(trial: Trial, masks: Sequence[Any]) -> str:
    """A query is read, never written to: the evaluator uses its mask afterwards."""
    for query, mask in zip(trial.queries, masks, strict=True):
        if not np.array_equal(query.mask, mask):
            raise Violation(
                f"{query.name}: the mask was written to", "Work on a copy of building_probability."
            )
    return "masks are as they were"


def _same_again(method: Method, answers: TrialAnswers) -> str:
    """The same queries and streams give the same answers to the bit."""
    for query in answers.trial.queries:
        if _as_values(ask(method, answers.trial.scorer, query)) != _as_values(answers.by_name[query.name]):
            raise Violation(f"{query.name}: another answer from the same streams", _STREAMS_HINT)
    return "the same streams, the same answers to the bit"


def _any_order(method: Method, answers: TrialAnswers) -> str:
    """An answer does not depend on the queries before it: runs resume, and share out their work."""
    for query in (*reversed(answers.trial.queries), answers.trial.queries[-1]):
        if _as_values(ask(method, answers.trial.scorer, query)) != _as_values(answers.by_name[query.name]):
            raise Violation(
                f"{query.name}: another answer where other queries came before",
                "Keep no state between queries: what localize learns stays in it.",
            )
    return "backwards and twice, the same answers"


def _another_seed(method: Method, answers: TrialAnswers) -> str:
    """Another seed is no fault; its answer may differ."""
    query = answers.trial.queries[0]
    is_same = _as_values(ask(method, answers.trial.scorer, query, seed=1)) == _as_values(
        answers.by_name[query.name]
    )
    return "the same answer: no random numbers matter" if is_same else "another answer, as it may"


def _empty_mask(method: Method, answers: TrialAnswers) -> str:
    """A mask without a building is a fault of the query, unless the method looks at no mask."""
    query = answers.trial.queries[0]
    empty = replace(query, building_probability=np.zeros_like(query.mask))
    found = ask(method, answers.trial.scorer, empty)
    if isinstance(found, QueryFault):
        return f"QueryFault: {found.message}"
    if _as_values(found) == _as_values(answers.by_name[query.name]):
        return "the same answer: the mask is not looked at"
    raise Violation("it is answered", "Raise QueryFault('the mask holds no building').")


def _as_values(found: Estimate | QueryFault) -> tuple[Any, ...]:
    """Returns an answer as values that are equal if it is the same to the bit; times are left out."""
    if isinstance(found, QueryFault):
        return (found.message,)
    covariance = b"" if found.covariance is None else np.asarray(found.covariance).tobytes()
    numbers = (repr(float(found.score)), int(found.hypotheses), found.probability)
    return (found.pose.cam_from_world.tobytes(), *numbers, covariance)
