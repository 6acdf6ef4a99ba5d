"""The rules of CityJSON 2.0 that a writer of buildings can break, as a JSON schema and a few more checks."""

from collections.abc import Iterator
from typing import Any

import jsonschema

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
