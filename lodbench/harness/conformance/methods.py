"""The rules of the method protocol: a method's class, its answers to a trial, and what it may keep."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, asdict, fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lodbench.datasets.inputs import Input, declared_inputs
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Query
from lodbench.errors import STOPPED, ConfigError, QueryFault
from lodbench.evaluation import pose_error
from lodbench.findings import OK, Check, fault_of
from lodbench.geometry import Pose
from lodbench.harness.conformance.trial import (
    Killed,
    Rule,
    TrialAnswers,
    Violation,
    WatchedWorkspace,
    ask,
    check_rules,
    make_trial,
    require,
    streams_of,
)
from lodbench.methods.localize import localize_queries, uncertainty_fault, weight_files
from lodbench.methods.protocol import (
    Estimate,
    Method,
    SupportsBatches,
    SupportsPrepare,
    SupportsPriorWidth,
    SupportsTrial,
)
from lodbench.storage.paths import path_name

Answer = Estimate | QueryFault

_NO_ANSWER = "Where there is no answer, raise QueryFault with the reason."
_STREAMS_HINT = "Draw random numbers from streams only; keep nothing in the class or module."
_STATE_HINT = "Keep no state between queries: what localize learns stays in it."
# The priors are 9 m and 3 degrees off; answers beyond these are in another frame or turned round.
_FURTHEST_M, _FURTHEST_DEG = 300.0, 60.0


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
    rules = [
        Rule("name", lambda: right_name(kind, name)),
        Rule("inputs", lambda: known_inputs(kind)),
        Rule("parameters", lambda: _frozen_parameters(kind, name)),
        Rule("configuration", lambda: _whole_configuration(kind, load(), read, where), "parameters"),
    ]
    return check_rules(rules, "plug-in")


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
            answers = _collect(make, Path(folder), method)
        except STOPPED:
            raise
        except BaseException as error:  # a method may raise anything: that is the finding
            yield fault_of(error, "answers", "answers", _NO_ANSWER)
            return
        yield from check_rules(_rules(make, answers))


def trial_settings(own: Mapping[str, Any], tried: Mapping[str, Any]) -> Check:
    """Returns what is tried in place of a method's own settings, which is all that is assessed."""
    changed = {name: value for name, value in tried.items() if value != own.get(name)}
    words = [f"{name}={value} instead of {own.get(name)}" for name, value in changed.items()]
    return Check("answers", "settings", OK, "; ".join(words) or "the method's own")


def _collect(make: Callable[[], Method], folder: Path, method: Method) -> TrialAnswers:
    """Returns a method's answers, once another like it was asked, so that all is compiled."""
    trial = make_trial(folder, method)
    ask(trial.prepared(make()), trial, trial.queries[0])
    method = trial.prepared(make())
    started = time.perf_counter()
    by_name = {query.name: ask(method, trial, query) for query in trial.queries}
    return TrialAnswers(trial, by_name, (time.perf_counter() - started) / len(trial.queries))


def _rules(make: Callable[[], Method], answers: TrialAnswers) -> Sequence[Rule]:
    def prepared() -> Method:
        return answers.trial.prepared(make())

    return [
        Rule("answers", lambda: _answered(answers), ends=True),
        Rule("pose", lambda: _finite_pose(answers)),
        Rule("frame", lambda: _near_the_prior(answers), "pose"),
        Rule("score", lambda: _plain_score(answers)),
        Rule("hypotheses", lambda: _counted_hypotheses(answers)),
        Rule("uncertainty", lambda: _sound_uncertainty(answers)),
        Rule("query", lambda: _untouched_queries(prepared(), answers)),
        Rule("same again", lambda: _same_again(prepared(), answers)),
        Rule("any order", lambda: _any_order(prepared(), answers), "same again"),
        Rule("preparation", lambda: _preparation_resumes(make, answers), "same again"),
        Rule("batches", lambda: _batches_answer_alike(prepared(), answers), "same again"),
        Rule("another seed", lambda: _another_seed(prepared(), answers)),
        Rule("empty mask", lambda: _empty_mask(prepared(), answers), "query", _NO_ANSWER),
        Rule("weights", lambda: ", ".join(file.name for file in weight_files(make())) or "none"),
        Rule("prior width", lambda: _right_prior_params(make())),
    ]


def known_inputs(kind: Any) -> str:
    """A class says what it needs, in words that runs know."""
    hint = "Set requires = frozenset({'mask'}), or others."
    require(hasattr(kind, "requires"), "the class does not say what it requires", hint)
    requires = declared_inputs(kind, "requires")
    words = ", ".join(sorted(requires)) or "needs nothing but the prior and the map"
    return f"{words}: an oracle, which no leaderboard ranks" if Input.TRUE_PIXELS in requires else words


def right_name(kind: Any, name: str) -> str:
    """A class is called what its entry point is: runs are stored under that name."""
    label = getattr(kind, "name", None)
    require(label == name, f"the class says {label!r}", f"Set name = {name!r}, as the entry point does.")
    try:
        return path_name("method", name)
    except ConfigError as error:
        raise Violation(error.message, error.hint) from error


def _frozen_parameters(kind: Any, name: str) -> str:
    """Parameters are a frozen dataclass that says the method's name."""
    params = getattr(kind, "params_type", None)
    if not (isinstance(params, type) and is_dataclass(params)):
        raise Violation(f"params_type is {params!r}", "Set params_type to a frozen dataclass.")
    is_frozen = params.__dataclass_params__.frozen  # type: ignore[attr-defined]
    require(is_frozen, f"{params.__name__} is not frozen", "Use @dataclass(frozen=True).")
    has_name = "name" in {each.name for each in fields(params)}
    require(has_name, f"{params.__name__} has no field name", f"Add name: str = {name!r}.")
    return f"{params.__name__}, frozen, fields: {len(fields(params))}"


def _whole_configuration(
    kind: Any, config: Mapping[str, Any] | None, read: Callable[[Mapping[str, Any]], Any], where: str
) -> str:
    """The configuration says every parameter, with the class's default."""
    if config is None:
        raise Violation(f"there is no {where}", "Write it: name, and every parameter with its default.")
    known = {each.name: each for each in fields(kind.params_type)}
    differing = {"lacks": known.keys() - config.keys(), "has no use for": config.keys() - known.keys()}
    for word, names in differing.items():
        require(not names, f"it {word} {', '.join(sorted(names))}", f"{where} holds what params_type does.")
    stated = read(config)
    for each in known.values():
        default = each.default if each.default_factory is MISSING else each.default_factory()
        value = getattr(stated, each.name)
        words = f"{each.name} is {value!r} in {where}, {default!r} in the class"
        require(default is MISSING or value == default, words, "Make them the same.")
    return f"{where}, every default as in the class"


def _answered(answers: TrialAnswers) -> str:
    """There is an answer, of the right type, to at least one query."""
    hint = "Return an Estimate, or raise QueryFault."
    for answer in answers.by_name.values():
        require(isinstance(answer, Estimate | QueryFault), f"localize returned {type(answer).__name__}", hint)
    faults = {str(answer) for answer in answers.by_name.values() if isinstance(answer, QueryFault)}
    reasons = f" ({'; '.join(sorted(faults))})" if faults else ""
    reported = f"{len(answers.estimates)} of {len(answers.by_name)} queries{reasons}"
    hint = "The queries have exact masks and photos: one at least should be answered."
    require(bool(answers.estimates), reported, hint)
    return f"{reported}, {answers.seconds:.3f} s each"


def _finite_pose(answers: TrialAnswers) -> str:
    """A pose is a Pose, finite, its rotation one."""
    for name, estimate in answers.estimates.items():
        words = f"{name}: pose is a {type(estimate.pose).__name__}"
        require(isinstance(estimate.pose, Pose), words, "Make it with Pose.from_matrix.")
        is_finite = np.isfinite(estimate.pose.cam_from_world).all()
        require(is_finite, f"{name}: the pose is not finite", "Raise QueryFault where there is no answer.")
        Pose.from_matrix(estimate.pose.cam_from_world)
    return "finite, rotations orthonormal"


def _near_the_prior(answers: TrialAnswers) -> str:
    """A pose is in the query's frame, world to camera."""
    errors, prior_errors = [], []
    for query, truth in zip(answers.trial.queries, answers.trial.truths, strict=True):
        if query.name not in answers.estimates:
            continue
        pose = answers.estimates[query.name].pose
        away_m, turned_deg = pose_error(pose, query.prior)
        hint = "Answer in the frame of query.prior and city_map.scene; the city's origin is added later."
        require(away_m < _FURTHEST_M, f"{query.name}: {away_m:.0f} m from the prior", hint)
        words = f"{query.name}: turned by {turned_deg:.0f} deg from the prior"
        hint = "A pose is world to camera, x right, y down, z forward."
        require(turned_deg < _FURTHEST_DEG, words, hint)
        errors.append(pose_error(pose, truth).translation_m)
        prior_errors.append(pose_error(query.prior, truth).translation_m)
    best = f"at most {max(errors):.2f} m from the truth"
    return f"{best}, the priors {max(prior_errors):.2f} m (information only)"


def _counted_hypotheses(answers: TrialAnswers) -> str:
    """Hypotheses are counted by the map; information only."""
    return f"{max(answer.hypotheses for answer in answers.estimates.values())} at most, counted by the map"


def _plain_score(answers: TrialAnswers) -> str:
    """A score is a finite number, or NaN where a method has none; times and traces are finite."""
    for name, estimate in answers.estimates.items():
        is_number = isinstance(estimate.score, float | np.floating) and not math.isinf(estimate.score)
        require(is_number, f"{name}: score is {estimate.score!r}", "A float, higher is better; NaN for none.")
        values = [*estimate.seconds.values(), *(v for steps in estimate.trace.values() for v in steps)]
        is_finite = np.isfinite(np.array(values, dtype=np.float64)).all()
        is_sound = bool(is_finite) and min(estimate.seconds.values(), default=0) >= 0
        words = f"{name}: seconds or trace hold {values}"
        require(is_sound, words, "Finite numbers; seconds are not negative.")
    scores = [estimate.score for estimate in answers.estimates.values() if not math.isnan(estimate.score)]
    return f"{min(scores):.3f} to {max(scores):.3f}" if scores else "none is given"


def _sound_uncertainty(answers: TrialAnswers) -> str:
    """A covariance, if given, is one; a probability lies in [0, 1]."""
    hint = "Leave it None, or see Estimate in lodbench/methods/protocol.py."
    for name, estimate in answers.estimates.items():
        fault = uncertainty_fault(estimate)
        require(not fault, f"{name}: {fault}", hint)
    given = next(iter(answers.estimates.values()))
    parts = {"covariance": given.covariance, "probability": given.probability}
    return ", ".join(name for name, value in parts.items() if value is not None) or "none is given"


def _right_prior_params(method: Method) -> str:
    """A method that offers ``params_for_prior`` answers parameters of its own type."""
    if not isinstance(method, SupportsPriorWidth):
        return "not offered: `lodbench basin` runs the method as it is"
    kind = type(method).params_type  # type: ignore[attr-defined]
    params = method.params_for_prior(UniformPrior(50.0, 50.0, 50.0))
    words = f"params_for_prior returned {type(params).__name__}"
    require(isinstance(params, kind), words, f"Return {kind.__name__}.")
    return f"returns {kind.__name__}"


def _untouched_queries(method: Method, answers: TrialAnswers) -> str:
    """A query is read, never written to: others use its mask afterwards."""
    for query in answers.trial.queries:
        if query.building_probability is None:
            return "there is no mask to write to"
        # Queries show it read-only; who makes it writable again is detected here.
        mask = query.building_probability.copy()
        with suppress(QueryFault):
            given = replace(query, building_probability=mask)
            method.localize(given, answers.trial.city_map, streams_of(query))
        is_same = np.array_equal(mask, query.building_probability)
        require(is_same, f"{query.name}: the mask was written to", "Work on a copy of the mask.")
    return "masks are as they were"


def _same_again(method: Method, answers: TrialAnswers) -> str:
    """The same queries and streams give the same answers to the bit."""
    for query in answers.trial.queries:
        answer = ask(method, answers.trial, query)
        _require_same(answer, answers, query, "another answer from the same streams", _STREAMS_HINT)
    return "the same streams, the same answers to the bit"


def _any_order(method: Method, answers: TrialAnswers) -> str:
    """An answer does not depend on the queries before it: runs resume, and share out their work."""
    for query in (*reversed(answers.trial.queries), answers.trial.queries[-1]):
        answer = ask(method, answers.trial, query)
        _require_same(answer, answers, query, "another answer where other queries came before", _STATE_HINT)
    return "backwards and twice, the same answers"


def _preparation_resumes(make: Callable[[], Method], answers: TrialAnswers) -> str:
    """What was prepared is there again, whole, also after a kill; and answers do not depend on it."""
    trial = answers.trial

    def prepared_in(workspace: WatchedWorkspace) -> Method | None:
        method = make()
        if not isinstance(method, SupportsPrepare):
            return None
        method.prepare(trial.city_map, trial.references, workspace)
        return method

    again, resumed = WatchedWorkspace(trial.folder / "workspace"), trial.folder / "interrupted"
    if prepared_in(again) is None:
        return "not offered"
    if again.made:
        raise Violation(f"{again.made[0]} was made anew", "A part's name depends on nothing but its content.")
    if again.requested:
        with suppress(Killed):
            prepared_in(WatchedWorkspace(resumed, len(again.requested) - 1))
    rest = WatchedWorkspace(resumed)
    method = prepared_in(rest)
    assert method is not None  # noqa: S101 - as before
    if len(set(rest.made)) > 1:
        raise Violation(f"{rest.made[0]} was made again after a kill", "Use workspace.part for all.")
    for query in trial.queries:
        words, hint = "another answer after a kill", "Keep all in the workspace."
        _require_same(ask(method, trial, query), answers, query, words, hint)
    return f"{len(set(again.requested))} parts, found again after a kill"


def _batches_answer_alike(method: Method, answers: TrialAnswers) -> str:
    """A batch gives the answers that its queries get one by one."""
    trial = answers.trial
    if not isinstance(method, SupportsBatches):
        return "not offered"
    require(method.batch_size >= 1, f"batch_size is {method.batch_size}", "It is at least 1.")
    streams = [streams_of(query) for query in trial.queries]
    batch = localize_queries(method, trial.queries, trial.city_map, streams)
    for query, answer in zip(trial.queries, batch, strict=True):
        _require_same(answer, answers, query, "another answer in a batch", "Let both share their code.")
    return f"up to {method.batch_size} at a time, the same answers"


def _another_seed(method: Method, answers: TrialAnswers) -> str:
    """Another seed is no fault; its answer may differ."""
    query = answers.trial.queries[0]
    is_same = _values(ask(method, answers.trial, query, seed=1)) == _values(answers.by_name[query.name])
    return "same answer (no random numbers used)" if is_same else "differs by seed (allowed)"


def _empty_mask(method: Method, answers: TrialAnswers) -> str:
    """A mask without a building is a fault of the query, unless no mask is looked at or others place it."""
    query = answers.trial.queries[0]
    if query.building_probability is None:
        return "no mask is required"
    answer = ask(method, answers.trial, replace(query, building_probability=np.zeros_like(query.mask)))
    if isinstance(answer, QueryFault):
        return f"QueryFault: {answer.message}"
    if query.reconstructed is not None:
        return "its flight's reconstruction places it"
    if _values(answer) == _values(answers.by_name[query.name]):
        raise Violation("the same answer: the mask is not looked at", "Set requires = frozenset().")
    raise Violation("it is answered", "Raise QueryFault('the mask holds no building').")


def _require_same(answer: Answer, answers: TrialAnswers, query: Query, words: str, hint: str) -> None:
    """Requires the answer that a query had, to the bit."""
    require(_values(answer) == _values(answers.by_name[query.name]), f"{query.name}: {words}", hint)


def _values(answer: Answer) -> tuple[Any, ...]:
    """Returns an answer as values that are equal if it is the same to the bit; times are left out."""
    if isinstance(answer, QueryFault):
        return (answer.message,)
    covariance = b"" if answer.covariance is None else np.asarray(answer.covariance).tobytes()
    return (answer.pose.cam_from_world.tobytes(), repr(float(answer.score)), answer.probability, covariance)
