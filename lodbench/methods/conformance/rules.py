"""The rules of the method protocol: each returns what was found, or raises what is wrong."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from typing import Any

import numpy as np

from lodbench.datasets.inputs import Input, declared_inputs
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.errors import ConfigError, QueryFault
from lodbench.geometry import Pose
from lodbench.methods.conformance.trial import TrialAnswers
from lodbench.methods.localize import uncertainty_fault
from lodbench.methods.protocol import Estimate, Method, SupportsPriorWidth
from lodbench.storage.paths import path_name

# The priors are 9 m and 3 degrees off; answers beyond these are in another frame or turned round.
_FURTHEST_M, _FURTHEST_DEG = 300.0, 60.0


class Violation(Exception):
    """A rule is not kept."""

    def __init__(self, detail: str, hint: str = "") -> None:
        super().__init__(detail)
        self.hint = hint


def known_inputs(kind: Any) -> str:
    """A class says what it needs, in words that runs know."""
    if not hasattr(kind, "requires"):
        raise Violation(
            "the class does not say what it requires", "Set requires = frozenset({'mask'}), or others."
        )
    requires = declared_inputs(kind, "requires")
    words = ", ".join(sorted(requires)) or "needs nothing but the prior and the map"
    return f"{words}: an oracle, which no leaderboard ranks" if Input.TRUE_PIXELS in requires else words


def right_name(kind: Any, name: str) -> str:
    """A class is called what its entry point is: runs are stored under that name."""
    found = getattr(kind, "name", None)
    if found != name:
        raise Violation(f"the class says {found!r}", f"Set name = {name!r}, as the entry point does.")
    try:
        return path_name("method", name)
    except ConfigError as error:
        raise Violation(error.message, error.hint) from error


def frozen_parameters(kind: Any, name: str) -> str:
    """Parameters are a frozen dataclass that says the method's name."""
    params = getattr(kind, "params_type", None)
    if not (isinstance(params, type) and is_dataclass(params)):
        raise Violation(f"params_type is {params!r}", "Set params_type to a frozen dataclass.")
    if not params.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        raise Violation(f"{params.__name__} is not frozen", "Use @dataclass(frozen=True).")
    if "name" not in {each.name for each in fields(params)}:
        raise Violation(f"{params.__name__} has no field name", f"Add name: str = {name!r}.")
    return f"{params.__name__}, frozen, fields: {len(fields(params))}"


def whole_configuration(
    kind: Any, config: Mapping[str, Any] | None, read: Callable[[Mapping[str, Any]], Any], where: str
) -> str:
    """The configuration says every parameter, with the class's default."""
    if config is None:
        raise Violation(f"there is no {where}", "Write it: name, and every parameter with its default.")
    known = {each.name: each for each in fields(kind.params_type)}
    for word, names in (
        ("lacks", known.keys() - config.keys()),
        ("has no use for", config.keys() - known.keys()),
    ):
        if names:
            raise Violation(f"it {word} {', '.join(sorted(names))}", f"{where} holds what params_type does.")
    stated = read(config)
    for each in known.values():
        default = each.default if each.default_factory is MISSING else each.default_factory()
        value = getattr(stated, each.name)
        if default is not MISSING and value != default:
            raise Violation(
                f"{each.name} is {value!r} in {where}, {default!r} in the class", "Make them the same."
            )
    return f"{where}, every default as in the class"


def answered(answers: TrialAnswers) -> str:
    """There is an answer, of the right type, to at least one query."""
    for found in answers.by_name.values():
        if not isinstance(found, Estimate | QueryFault):
            raise Violation(
                f"localize returned {type(found).__name__}", "Return an Estimate, or raise QueryFault."
            )
    reasons = "; ".join(
        sorted({str(found) for found in answers.by_name.values() if isinstance(found, QueryFault)})
    )
    told = f"{len(answers.estimates)} of {len(answers.by_name)} queries" + (
        f" ({reasons})" if reasons else ""
    )
    if not answers.estimates:
        raise Violation(told, "The queries have exact masks and photos: one at least should be answered.")
    return f"{told}, {answers.seconds:.3f} s each"


def finite_pose(answers: TrialAnswers) -> str:
    """A pose is a Pose, finite, its rotation one."""
    for name, found in answers.estimates.items():
        if not isinstance(found.pose, Pose):
            raise Violation(
                f"{name}: pose is a {type(found.pose).__name__}", "Make it with Pose.from_matrix."
            )
        if not np.isfinite(found.pose.cam_from_world).all():
            raise Violation(f"{name}: the pose is not finite", "Raise QueryFault where there is no answer.")
        Pose.from_matrix(found.pose.cam_from_world)
    return "finite, rotations orthonormal"


def near_the_prior(answers: TrialAnswers) -> str:
    """A pose is in the query's frame, world to camera."""
    errors, prior_errors = [], []
    for query, truth in zip(answers.trial.queries, answers.trial.truths, strict=True):
        if query.name not in answers.estimates:
            continue
        pose = answers.estimates[query.name].pose
        away_m, turned_deg = _distance_m(pose, query.prior), _turn_deg(pose, query.prior)
        if not away_m < _FURTHEST_M:
            raise Violation(
                f"{query.name}: {away_m:.0f} m from the prior",
                "Answer in the frame of query.prior and city_map.scene; the city's origin is added later.",
            )
        if not turned_deg < _FURTHEST_DEG:
            raise Violation(
                f"{query.name}: turned by {turned_deg:.0f} deg from the prior",
                "A pose is world to camera, x right, y down, z forward.",
            )
        errors.append(_distance_m(pose, truth))
        prior_errors.append(_distance_m(query.prior, truth))
    return (
        f"at most {max(errors):.2f} m from the truth, the priors {max(prior_errors):.2f} m (information only)"
    )


def _distance_m(a: Pose, b: Pose) -> float:
    return float(np.linalg.norm(a.center - b.center))


def _turn_deg(a: Pose, b: Pose) -> float:
    cosine = (np.trace(a.rotation.T @ b.rotation) - 1.0) / 2.0
    return math.degrees(math.acos(min(1.0, max(-1.0, cosine))))


def counted_hypotheses(answers: TrialAnswers) -> str:
    """Hypotheses are counted by the map; information only."""
    counts = [found.hypotheses for found in answers.estimates.values()]
    return f"{max(counts)} at most, counted by the map"


def plain_score(answers: TrialAnswers) -> str:
    """A score is a finite number, or NaN where a method has none; times and traces are finite."""
    for name, found in answers.estimates.items():
        if not isinstance(found.score, float | np.floating) or math.isinf(found.score):
            raise Violation(f"{name}: score is {found.score!r}", "A float, higher is better; NaN for none.")
        values = [*found.seconds.values(), *(v for steps in found.trace.values() for v in steps)]
        if (
            not np.isfinite(np.array(values, dtype=np.float64)).all()
            or min(found.seconds.values(), default=0) < 0
        ):
            raise Violation(
                f"{name}: seconds or trace hold {values}", "Finite numbers; seconds are not negative."
            )
    scores = [found.score for found in answers.estimates.values() if not math.isnan(found.score)]
    return f"{min(scores):.3f} to {max(scores):.3f}" if scores else "none is given"


def sound_uncertainty(answers: TrialAnswers) -> str:
    """A covariance, if given, is one; a probability lies in [0, 1]."""
    hint = "Leave it None, or see Estimate in lodbench/methods/protocol.py."
    for name, found in answers.estimates.items():
        fault = uncertainty_fault(found)
        if fault:
            raise Violation(f"{name}: {fault}", hint)
    given = next(iter(answers.estimates.values()))
    parts = {"covariance": given.covariance, "probability": given.probability}
    return ", ".join(name for name, value in parts.items() if value is not None) or "none is given"


def right_prior_params(method: Method) -> str:
    """A method that offers ``params_for_prior`` answers parameters of its own type."""
    if not isinstance(method, SupportsPriorWidth):
        return "not offered: `lodbench basin` runs the method as it is"
    kind = type(method).params_type  # type: ignore[attr-defined]
    found = method.params_for_prior(UniformPrior(50.0, 50.0, 50.0))
    if not isinstance(found, kind):
        raise Violation(f"params_for_prior returned {type(found).__name__}", f"Return {kind.__name__}.")
    return f"returns {kind.__name__}"
