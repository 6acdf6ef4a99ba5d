"""A checker for the part of JSON Schema that lodbench's own schemas use; an unknown keyword is an error."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Any

_TYPES: dict[str, tuple[type, ...]] = {
    "object": (dict,),
    "array": (list,),
    "string": (str,),
    "number": (int, float),
    "integer": (int,),
    "boolean": (bool,),
    "null": (type(None),),
}
_KEYWORDS = {
    "$schema", "$id", "title", "description", "$defs", "$ref", "type", "const", "enum", "required",
    "properties", "additionalProperties", "items", "minItems", "maxItems", "pattern", "minimum", "maximum",
}  # fmt: skip


def schema_faults(value: Any, schema: dict[str, Any], root: dict[str, Any] | None = None) -> list[str]:
    """Returns a line for each place where a JSON value breaks a schema; the empty list if it holds.

    Raises:
        ValueError: The schema uses a keyword that is not understood: ignoring it would accept too much.
    """
    return list(_faults(value, schema, root or schema, "entry"))


def _faults(value: Any, schema: dict[str, Any], root: dict[str, Any], where: str) -> Iterator[str]:
    unknown = set(schema) - _KEYWORDS
    if unknown:
        raise ValueError(f"JSON Schema keyword {min(unknown)!r} is not understood.")
    if "$ref" in schema:
        yield from _faults(value, root["$defs"][schema["$ref"].removeprefix("#/$defs/")], root, where)
        return
    if "type" in schema and not _is_of(value, schema["type"]):
        yield f"{where} is no {schema['type']}"
        return
    if "const" in schema and value != schema["const"]:
        yield f"{where} is not {schema['const']!r}"
    if "enum" in schema and value not in schema["enum"]:
        yield f"{where} is {value!r}, none of {schema['enum']}"
    if isinstance(value, dict):
        yield from _object_faults(value, schema, root, where)
    elif isinstance(value, list):
        yield from _array_faults(value, schema, root, where)
    else:
        yield from _scalar_faults(value, schema, where)


def _scalar_faults(value: Any, schema: dict[str, Any], where: str) -> Iterator[str]:
    if isinstance(value, str):
        if "pattern" in schema and not re.search(schema["pattern"], value):
            yield f"{where} is {value!r}, against {schema['pattern']}"
    elif isinstance(value, int | float):
        # Written so that a number that is not one is out of range.
        if not schema.get("minimum", -math.inf) <= value <= schema.get("maximum", math.inf):
            yield f"{where} is {value!r}, out of range"


def _is_of(value: Any, names: str | list[str]) -> bool:
    wanted = [names] if isinstance(names, str) else names
    if isinstance(value, bool):
        return "boolean" in wanted
    return any(isinstance(value, _TYPES[name]) for name in wanted)


def _object_faults(
    value: dict[str, Any], schema: dict[str, Any], root: dict[str, Any], where: str
) -> Iterator[str]:
    properties, others = schema.get("properties", {}), schema.get("additionalProperties", True)
    yield from (f"{where} has no {name}" for name in schema.get("required", ()) if name not in value)
    for name, member in value.items():
        if name in properties:
            yield from _faults(member, properties[name], root, f"{where}.{name}")
        elif others is False:
            yield f"{where}.{name} is not expected"
        elif isinstance(others, dict):
            yield from _faults(member, others, root, f"{where}.{name}")


def _array_faults(
    value: list[Any], schema: dict[str, Any], root: dict[str, Any], where: str
) -> Iterator[str]:
    if not schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", len(value)):
        yield f"{where} has {len(value)} items"
    for number, member in enumerate(value):
        yield from _faults(member, schema.get("items", {}), root, f"{where}[{number}]")
