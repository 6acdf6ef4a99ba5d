"""From settings as plain values to a frozen parameter dataclass, names and types checked: the one place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, TypeVar, cast

from lodbench.errors import ConfigError, nearest_names

T = TypeVar("T")


def to_params(values: Mapping[str, Any], params_type: type[T], prefix: str) -> T:
    """Returns a frozen Params made from plain values; what they leave out keeps its default.

    One name stands for a list of one: ``split=in_place``, or ``split=1``.

    Args:
        values: Settings by name.
        params_type: A dataclass of types that OmegaConf knows.
        prefix: What settings are called with on a command line, as ``method`` in ``method.steps``.

    Raises:
        ConfigError: A name is unknown or a value has the wrong type.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

    types = {f.name: f.type for f in fields(params_type)}  # type: ignore[arg-type]
    for name in values:
        if name not in types:
            raise ConfigError(f"{_dotted(prefix, name)} is not a setting.", nearest_names(name, types))
    given = {name: _as_typed(value, types[name]) for name, value in values.items()}
    try:
        merged = OmegaConf.merge(_writable(OmegaConf.structured(params_type)), _literal(given))
        return cast(T, OmegaConf.to_object(merged))
    except MissingMandatoryValue as error:
        name = _dotted(prefix, str(error.full_key))
        raise ConfigError(f"{name} is not set.", f"Add {name}=VALUE.") from error
    except OmegaConfBaseException as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"{_dotted(prefix, str(error.full_key))}: {reason}") from error


def read_settings(text: str) -> dict[str, Any]:
    """Returns the settings of a YAML text by name, as plain values."""
    from omegaconf import OmegaConf

    return cast(dict[str, Any], OmegaConf.to_container(OmegaConf.create(text)))


def _as_typed(value: Any, wanted: object) -> Any:
    """Returns a value with words as they were typed: a ``true`` where a name is wanted is no boolean."""
    if isinstance(value, bool) and wanted in ("str", "str | None", "list[str]"):
        value = str(value).lower()
    return [str(value)] if isinstance(value, str | int | float) and wanted == "list[str]" else value


def _dotted(prefix: str, name: str) -> str:
    return f"{prefix}.{name}" if prefix else name


def _writable(node: Any) -> Any:
    """Returns the tree of a structured config whose groups take values: those of frozen classes take none."""
    from omegaconf import OmegaConf

    OmegaConf.set_readonly(node, False)
    for key in node:
        if not OmegaConf.is_missing(node, key) and OmegaConf.is_dict(node[key]):
            _writable(node[key])
    return node


def _literal(value: Any) -> Any:
    """Returns values whose strings are taken as they stand: they are resolved already."""
    if isinstance(value, str):
        return value.replace("${", "\\${")
    if isinstance(value, dict):
        return {key: _literal(item) for key, item in value.items()}
    return [_literal(item) for item in value] if isinstance(value, list | tuple) else value
