"""Does a method keep to the protocol? Its class, and its answers to a trial, looked at rule by rule."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from lodbench.checks import FAULT, OK, Check, fault_of
from lodbench.errors import STOPPED
from lodbench.methods.conformance import life
from lodbench.methods.conformance.rules import (
    Violation,
    answered,
    counted_hypotheses,
    finite_pose,
    frozen_parameters,
    known_inputs,
    near_the_prior,
    plain_score,
    right_name,
    right_prior_params,
    sound_uncertainty,
    whole_configuration,
)
from lodbench.methods.conformance.trial import Trial, TrialAnswers, ask, make_trial
from lodbench.methods.protocol import Method, SupportsTrial

_NO_ANSWER = "Where there is no answer, raise QueryFault with the reason."


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
    yield _checked("plug-in", "inputs", lambda: known_inputs(kind))
    parameters = _checked("plug-in", "parameters", lambda: frozen_parameters(kind, name))
    yield parameters
    if parameters.status == OK:
        yield _checked("plug-in", "configuration", lambda: whole_configuration(kind, load(), read, where))


def check_answers(make: Callable[[], Method]) -> Iterator[Check]:
    """Yields what there is to say of a method's answers to the trial."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            method = make()
            if isinstance(method, SupportsTrial):
                kind: Any = type(method)
                params = method.params_for_trial()
                make = partial(kind, params)
                yield trial_settings(asdict(method.params), asdict(params))
                method = make()
            trial = make_trial(Path(folder), method)
            answers = _collect(make, trial)
        except STOPPED:
            raise
        except BaseException as error:  # a method may raise anything: that is the finding
            yield fault_of(error, "answers", "answers", _NO_ANSWER)
            return
        first = _checked("answers", "answers", lambda: answered(answers))
        yield first
        if first.status == OK:
            yield from _look_closer(make, answers)


def trial_settings(own: Mapping[str, Any], tried: Mapping[str, Any]) -> Check:
    """Returns what is tried in place of a method's own settings, which is all that is judged."""
    changes = [
        f"{name}={value} instead of {own.get(name)}"
        for name, value in tried.items()
        if value != own.get(name)
    ]
    return Check("answers", "settings", OK, "; ".join(changes) or "the method's own")


def _look_closer(make: Callable[[], Method], answers: TrialAnswers) -> Iterator[Check]:
    """Yields the checks that need an estimate to look at."""
    trial = answers.trial
    pose = _checked("answers", "pose", lambda: finite_pose(answers))
    yield pose
    if pose.status == OK:
        yield _checked("answers", "frame", lambda: near_the_prior(answers))
    yield _checked("answers", "score", lambda: plain_score(answers))
    yield _checked("answers", "hypotheses", lambda: counted_hypotheses(answers))
    yield _checked("answers", "uncertainty", lambda: sound_uncertainty(answers))

    def prepared() -> Method:
        return trial.prepared(make())

    untouched = _checked("answers", "query", lambda: life.untouched_queries(prepared(), answers))
    yield untouched
    again = _checked("answers", "same again", lambda: life.same_again(prepared(), answers))
    yield again
    if again.status == OK:
        yield _checked("answers", "any order", lambda: life.any_order(prepared(), answers))
        yield _checked("answers", "preparation", lambda: life.preparation_resumes(make, answers))
        yield _checked("answers", "batches", lambda: life.batches_answer_alike(prepared(), answers))
    yield _checked("answers", "another seed", lambda: life.another_seed(prepared(), answers))
    if untouched.status == OK:
        yield _checked("answers", "empty mask", lambda: life.empty_mask(prepared(), answers), _NO_ANSWER)
    yield _checked("answers", "weights", lambda: life.weights_are_there(make()))
    yield _checked("answers", "prior width", lambda: right_prior_params(make()))


def _checked(section: str, title: str, rule: Callable[[], str], on_purpose: str = "") -> Check:
    """Returns how a rule is kept; what to do if something else was raised on purpose is in its hint."""
    try:
        return Check(section, title, OK, rule())
    except Violation as violation:
        return Check(section, title, FAULT, str(violation), violation.hint)
    except STOPPED:
        raise
    except BaseException as error:  # of the method, or of values that are not what they should be
        return fault_of(error, section, title, on_purpose)


def _collect(make: Callable[[], Method], trial: Trial) -> TrialAnswers:
    """Returns a method's answers, once another like it was asked, so that all is compiled."""
    ask(trial.prepared(make()), trial, trial.queries[0])
    method = trial.prepared(make())
    started = time.perf_counter()
    by_name = {query.name: ask(method, trial, query) for query in trial.queries}
    return TrialAnswers(trial, by_name, (time.perf_counter() - started) / len(trial.queries))
