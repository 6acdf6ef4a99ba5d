"""The schemas of CityJSON 2.0 as cityjson.org publishes them, out of the wheel of its own validator.

They are not ours to hand on, and the validator (MIT) has no wheel for every Python; any of its wheels holds
the schemas as text, and the environment variable says where one lies:

    pip download cjvalpy==0.4.1 --no-deps --only-binary :all: --python-version 3.10 --platform win_amd64
    LODBENCH_CJVALPY=cjvalpy-0.4.1-cp310-none-win_amd64.whl pytest tests/citymodel
"""

import json
import os
import zipfile
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import jsonschema
import pytest

_BEGIN = b'{"$schema"'
_SCHEMAS = {
    f"https://www.cityjson.org/schemas/2.0.0/{name}.schema.json": kind
    for name, kind in (("cityjson", "CityJSON"), ("cityjsonfeature", "CityJSONFeature"))
}


def assert_valid(document: dict[str, Any]) -> None:
    """Checks a CityJSON document, or a feature of a sequence; without a schema the test is left out."""
    wheel = os.environ.get("LODBENCH_CJVALPY")
    if not wheel:
        pytest.skip("LODBENCH_CJVALPY names no wheel of cjvalpy, which holds the published schemas")
    faults = sorted(_validators(wheel)[document["type"]].iter_errors(document), key=lambda fault: fault.path)
    assert not faults, "\n".join(f"{list(fault.path)}: {fault.message[:200]}" for fault in faults[:5])


@lru_cache(maxsize=1)
def _validators(wheel: str) -> dict[str, jsonschema.Draft7Validator]:
    with zipfile.ZipFile(wheel) as archive:
        module = next(name for name in archive.namelist() if name.endswith((".pyd", ".so")))
        content = archive.read(module)
    found = {}
    begin = content.find(_BEGIN)
    while begin >= 0:
        schema, _ = json.JSONDecoder().raw_decode(content[begin : begin + (1 << 20)].decode("latin-1"))
        if schema.get("$id") in _SCHEMAS:
            found[_SCHEMAS[schema["$id"]]] = jsonschema.Draft7Validator(schema)
        begin = content.find(_BEGIN, begin + 1)
    return found


Json = dict[str, Any]

_DEPTHS = {"MultiSurface": 3, "CompositeSurface": 3, "Solid": 4, "CompositeSolid": 5}
_SURFACES = [
    "RoofSurface", "GroundSurface", "WallSurface", "ClosureSurface", "OuterCeilingSurface",
    "OuterFloorSurface", "Window", "Door", "InteriorWallSurface", "CeilingSurface", "FloorSurface",
]  # fmt: skip
_TOP = "Building Bridge Tunnel SolitaryVegetationObject PlantCover TINRelief CityFurniture".split()
_SECOND = [
    "BuildingPart", "BuildingInstallation", "BuildingConstructiveElement", "BuildingFurniture",
    "BuildingRoom", "BuildingStorey", "BuildingUnit", "BridgePart", "BridgeInstallation",
]  # fmt: skip


def _nested(depth: int, leaf: Json) -> Json:
    return {"type": "array", "items": _nested(depth - 1, leaf)} if depth else leaf


def _geometry(kind: str, depth: int) -> Json:
    label = {"type": ["integer", "null"]}
    semantics = {
        "type": "object",
        "required": ["surfaces", "values"],
        "properties": {
            "surfaces": {"type": "array", "items": {"properties": {"type": {"enum": _SURFACES}}}},
            "values": _nested(depth - 2, label),
        },
    }
    return {
        "type": "object",
        "required": ["type", "lod", "boundaries"],
        "additionalProperties": False,
        "properties": {
            "type": {"const": kind},
            "lod": {"type": "string", "pattern": r"^[0-3](\.[0-3])?$"},
            "boundaries": _nested(depth, {"type": "integer", "minimum": 0}),
            "semantics": semantics,
            "texture": {"type": "object"},
            "material": {"type": "object"},
        },
    }


_NUMBERS = {"type": "array", "items": {"type": "number"}}
_TEXT, _IDS = {"type": "string"}, {"type": "array", "items": {"type": "string"}}
_OBJECT = {
    "type": "object",
    "required": ["type"],
    "properties": {
        "type": {"enum": [*_TOP, *_SECOND]},
        "geometry": {"type": "array", "items": {"anyOf": [_geometry(*pair) for pair in _DEPTHS.items()]}},
        "parents": _IDS,
        "children": _IDS,
        "address": {"type": "array", "items": {"type": "object"}},
        "attributes": {
            "type": "object",
            "properties": {
                **dict.fromkeys(("class", "function", "usage"), _TEXT),
                **{f"storeys{side}Ground": {"type": "integer"} for side in ("Above", "Below")},
                **{f"storeyHeights{side}Ground": _NUMBERS for side in ("Above", "Below")},
                "measuredHeight": {"type": "number"},
            },
        },
    },
    "if": {"properties": {"type": {"enum": _SECOND}}},
    "then": {"required": ["parents"]},
}  # fmt: skip
_THREE = {"type": "array", "minItems": 3, "maxItems": 3}
_OBJECTS = {"type": "object", "additionalProperties": _OBJECT}
_VERTICES = {"type": "array", "items": {**_THREE, "items": {"type": "integer"}}}
DOCUMENT = {
    "type": "object",
    "required": ["type", "version", "transform", "CityObjects", "vertices"],
    "properties": {
        "type": {"const": "CityJSON"},
        "version": {"const": "2.0"},
        "transform": {
            "required": ["scale", "translate"],
            "additionalProperties": False,
            "properties": {key: {**_THREE, "items": {"type": "number"}} for key in ("scale", "translate")},
        },
        "metadata": {
            "properties": {
                "referenceSystem": {
                    "type": "string",
                    "pattern": r"^https://www\.opengis\.net/def/crs/EPSG/\d+/\d+$",
                }
            }
        },
        "CityObjects": _OBJECTS,
        "vertices": _VERTICES,
    },
}
FEATURE = {
    "type": "object",
    "required": ["type", "id", "CityObjects", "vertices"],
    "properties": {"type": {"const": "CityJSONFeature"}, "CityObjects": _OBJECTS, "vertices": _VERTICES},
}


def assert_keeps_the_rules(document: Json, schema: Json = DOCUMENT) -> None:
    """Checks a document against the schema, and what no schema can say: indices, families, semantics."""
    jsonschema.validate(document, schema)
    objects, count = document["CityObjects"], len(document["vertices"])
    used = set()
    for name, item in objects.items():
        assert all(name in objects[child]["parents"] for child in item.get("children", ()))
        assert all(name in objects[parent]["children"] for parent in item.get("parents", ()))
        for shape in item.get("geometry", ()):
            used.update(_leaves(shape["boundaries"]))
            if "semantics" in shape:
                labels = [label for label in _leaves(shape["semantics"]["values"]) if label is not None]
                assert set(labels) <= set(range(len(shape["semantics"]["surfaces"])))
                assert _shape(shape["semantics"]["values"], _DEPTHS[shape["type"]] - 2) == _shape(
                    shape["boundaries"], _DEPTHS[shape["type"]] - 2
                )
    assert used == set(range(count)), "indices out of range, or vertices that nothing uses"
    assert len({tuple(vertex) for vertex in document["vertices"]}) == count


def _leaves(values: Any) -> Iterator[Any]:
    if isinstance(values, list):
        for value in values:
            yield from _leaves(value)
    else:
        yield values


def _shape(values: Any, depth: int) -> Any:
    """Returns the lengths of lists in lists, down to a depth."""
    return len(values) if depth == 1 else [_shape(value, depth - 1) for value in values]


def assert_valid_gml(path: Path) -> None:
    """By the official schemas of CityGML 2.0, GML 3.1.1 and xAL 2.0."""
    schema = pytest.importorskip("citysmith.schema", reason="it brings the official schemas")
    report = schema.validate_schema(str(path))
    assert report.valid, report.messages[:3]
