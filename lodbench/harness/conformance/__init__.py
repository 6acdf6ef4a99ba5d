"""Does a plug-in conform to the protocol of its kind? Checks by kind; those of methods: ``methods``."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from lodbench.errors import STOPPED, ConfigError, LodbenchError
from lodbench.findings import FAULT, OK, Check
from lodbench.harness.conformance import data, pictures
from lodbench.harness.conformance.trial import Rules, Tried, check_in_order, trial_dataset
from lodbench.params import to_params
from lodbench.plugins import PlugIn

CHECKED: dict[str, Callable[[Tried], Rules]] = {
    "segmenters": pictures.segmenter_rules,
    "feature_extractors": pictures.extractor_rules,
    "matchers": pictures.matcher_rules,
    "retrievals": pictures.retrieval_rules,
    "pose_solvers": pictures.solver_rules,
    "datasets": data.dataset_rules,
    "priors": data.prior_rules,
    "pose_formats": data.pose_format_rules,
    "export_formats": data.export_rules,
    "city_readers": data.reader_rules,
    "renderers": data.renderer_rules,
    "fits": data.fit_rules,
    "metrics": data.metric_rules,
    "commands": data.command_rules,
}
# Kinds with a file conf/<section>/NAME.yaml, by which a command chooses them.
CONFIGURED = {"segmenters": "segmenter", "datasets": "dataset", "priors": "prior"}


def check_plugin(
    plug_in: PlugIn, config: Mapping[str, Any] | None = None, sample: Path | None = None
) -> Iterator[Check]:
    """Yields what there is to say of a plug-in, up to the first fault that others would follow from.

    Args:
        plug_in: The plug-in.
        config: What its file of configuration says; None where there is none.
        sample: A file in the format that a reader reads.
    """
    try:
        part = plug_in.load()
    except LodbenchError as error:
        yield Check("plug-in", "entry point", FAULT, error.message)
        return
    yield Check("plug-in", "entry point", OK, f"{plug_in.point.value} of {plug_in.package}")
    section = CONFIGURED.get(plug_in.group)
    if section is not None:
        where = f"conf/{section}/{plug_in.name}.yaml"
        if config is None:
            hint = "Write it: name, and every setting with its default; docs/plugins.md shows where."
            yield Check("plug-in", "configuration", FAULT, f"there is no {where}", hint)
            return
        yield Check("plug-in", "configuration", OK, where)
    params_type = _params_type_of(plug_in.group, part)
    if params_type is not None:
        parameters = _parameters(params_type)
        yield parameters
        if parameters.status != OK:
            return
    with tempfile.TemporaryDirectory() as folder:
        scene, dataset = trial_dataset(Path(folder))

        def make() -> Any:
            params = _params_of(params_type, config or {}, section or plug_in.name)
            return params if plug_in.group == "priors" else part(params)

        tried = Tried(part, plug_in.name, config, make, Path(folder), scene, dataset, sample)
        yield from check_in_order(CHECKED[plug_in.group](tried))


def require_settings(plug_in: PlugIn, config: Mapping[str, Any]) -> None:
    """Makes sure that a plug-in has settings: wrong ones are no fault of its.

    Raises:
        ConfigError: One is unknown, or its value is not to be had.
    """
    try:
        params_type = _params_type_of(plug_in.group, plug_in.load())
    except LodbenchError:  # reported by the checks
        return
    if params_type is None or _parameters(params_type).status != OK:
        return
    try:
        _params_of(params_type, config, CONFIGURED[plug_in.group])
    except ConfigError:
        raise
    except STOPPED:
        raise
    except BaseException:  # a plug-in may raise anything: reported with its answers
        return


def _params_type_of(group: str, part: Any) -> Any:
    """Returns the class of a plug-in's parameters; None where it has none, as datasets' functions."""
    return part if group == "priors" else getattr(part, "params_type", None)


def _params_of(params_type: Any, config: Mapping[str, Any], section: str) -> Any:
    return to_params(
        {key: value for key, value in config.items() if _has(params_type, key)}, params_type, section
    )


def _has(params_type: Any, key: str) -> bool:
    """Tells whether a setting is one of the parameters; a prior's name is its class's."""
    return key != "name" or key in {field.name for field in fields(params_type)}


def _parameters(kind: Any) -> Check:
    if not (isinstance(kind, type) and is_dataclass(kind)):
        return Check("plug-in", "parameters", FAULT, f"{kind!r} is no dataclass", "Use a frozen dataclass.")
    if not kind.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        return Check(
            "plug-in", "parameters", FAULT, f"{kind.__name__} is not frozen", "@dataclass(frozen=True)"
        )
    return Check("plug-in", "parameters", OK, f"{kind.__name__}, frozen, fields: {len(fields(kind))}")
