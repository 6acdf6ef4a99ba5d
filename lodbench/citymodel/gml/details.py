"""What CityGML says of a building besides its surfaces: attributes, address, and the solids they close."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from lodbench.citymodel.gml.context import HEIGHTS, is_another_s, owner_of
from lodbench.citymodel.gml.names import (
    GEOMETRY_PROPERTIES,
    GML_IDS,
    OBJECT_PROPERTIES,
    POLYGONS,
    XLINK_HREF,
    is_citygml,
    property_lod,
)
from lodbench.citymodel.gml.walk import GeometryWalk
from lodbench.citymodel.gml.xml import Element, NotFolded, local_name
from lodbench.citymodel.model import ObjectTable


@dataclass(slots=True)
class MemberIndex:
    """Everything in a member that can be referred to; built only when a plain look-up fails."""

    elements: dict[str, Element]
    polygons: dict[Element, int]


def index_member(member: Element, walk: GeometryWalk | None) -> MemberIndex:
    """Returns what can be referred to; polygons by number where ``walk`` has just collected them.

    Raises:
        NotFolded: Some of it has no elements.
    """
    if walk is not None and walk.folding.has_folded:
        raise NotFolded("A reference may be to something that is folded.")
    elements: dict[str, Element] = {}
    for element in member.iter():
        for name in GML_IDS:
            gml_id = element.get(name)
            if gml_id is not None:
                elements.setdefault(gml_id, element)
    if walk is None:
        return MemberIndex(elements, {})
    # The same steps in the same order as the walk took, so that numbers agree.
    in_order = (polygon for prop in walk.properties for polygon in prop.iter(*POLYGONS))
    polygons = {element: walk.first_polygon + i for i, element in enumerate(in_order)}
    return MemberIndex(elements, polygons)


# Children that hold geometry, other objects or bookkeeping, not facts about the object.
_NO_ATTRIBUTES = OBJECT_PROPERTIES | {
    "appearance", "address", "generalizesTo", "adeOfAbstractBuilding", "reliefComponent", "tin",
}  # fmt: skip
_GENERIC = ("attribute", "attributeset")
_GENERIC_KINDS = {"doubleAttribute": float, "intAttribute": int, "measureAttribute": float}
# By their names, in UCUM and in EPSG; without a unit a length is in metres.
_METRES_PER_UNIT = (
    dict.fromkeys(("", "m", "metre", "metres", "meter", "meters", "9001"), 1.0)
    | {"mm": 1e-3, "cm": 1e-2, "dm": 1e-1, "km": 1e3}
    | dict.fromkeys(("ft", "foot", "feet", "[ft_i]", "ft_i", "9002"), 0.3048)
    | dict.fromkeys(("us-ft", "ftus", "[ft_us]", "ft_us", "9003"), 1200.0 / 3937.0)
)
_DECIMALS = re.compile(r"\s*(?:[-+]?\d*\.?\d+(?:[eE][-+]?\d+)?(?:\s+|\Z))*")
_DAYS = ("creationDate", "terminationDate")
_MAX_DEPTH = 8
# Lines, points and terrain intersections: geometry too, which no scene has.
_LINES = re.compile(r"lod\d\w+")
# What a name inside of an address of CityGML 3 is the name of.
_ADDRESS_NAMES = {
    ("Country", "NameElement"): "CountryName",
    ("Locality", "NameElement"): "LocalityName",
    ("Thoroughfare", "NameElement"): "ThoroughfareName",
    ("Thoroughfare", "Number"): "ThoroughfareNumber",
    ("PostCode", "Identifier"): "PostalCodeNumber",
}


def read_attributes(element: Element) -> dict[str, Any]:
    """Returns the attributes of an object by their names in CityGML: text, numbers, lists or nested mappings.

    Generic attributes stand under the names they give themselves; an address under ``address``, as CityJSON
    has it. Geometry, parts and surfaces are left out. Heights and lengths that CityGML names are in metres; a
    height whose unit is not known has that in its name.
    """
    values: dict[str, Any] = {}
    for child in element.iterchildren("*"):
        name = local_name(child.tag)
        generic = child.get("name")
        if name == "address":
            addresses = values.setdefault("address", [])
            addresses += [_leaves(node) for node in child.iterchildren("*")]
        elif name == "genericAttribute" or (generic is not None and name.lower().endswith(_GENERIC)):
            _put_generic(values, child, 0)
        elif name not in _NO_ATTRIBUTES and not (is_citygml(child.tag) and _LINES.fullmatch(name)):
            value = _value(child, 0)
            if name in _DAYS:
                value = str(value).removesuffix("T00:00:00")  # a day, which CityGML 3 writes as a moment
            elif name.startswith("storey"):
                value = _storeys(name, str(child.text or ""), _metres(child) or 1.0)
            if name in HEIGHTS and _metres(child) is None:
                name = f"{name}_{child.get('uom')}"  # not to be taken for metres
            if value not in (None, "", {}):
                _put(values, name, value)
    _take_measured_height(values)
    return values


def _take_measured_height(values: dict[str, Any]) -> None:
    """Puts what measuredHeight became in CityGML 3 under its name: of several heights that with its ends."""
    given = values.get("height")
    heights = given if isinstance(given, list) else [given]
    inner = [one.get("Height") if isinstance(one, dict) else None for one in heights]
    measured = [one for one in inner if isinstance(one, dict) and one.get("status") == "measured"]
    if not measured:
        return
    chosen = max(measured, key=_is_overall)
    values["measuredHeight"] = chosen.get("value")
    if _is_overall(chosen):
        rest = [one for one, height in zip(heights, inner, strict=True) if height is not chosen]
        values["height"] = rest if len(rest) > 1 else next(iter(rest), None)
        if not rest:
            del values["height"]


def measured_height(noted: Mapping[str, list[Element]]) -> float | None:
    """Returns the height of an object above the ground in metres: the stated one, or that of its storeys.

    Args:
        noted: Its ``noted_children``.
    """
    found: dict[str, Any] = {}
    for name in HEIGHTS:
        for child in noted.get(name, ()):
            metres = _metres(child)
            if metres is not None:
                found[name] = [float(word) * metres for word in _numbers(child)]
    if "height" in noted:
        found["height"] = _value(noted["height"][-1], 0)
    if not found:
        return None
    if "measuredHeight" not in found:
        _take_measured_height(found)
    return overall_height(found)


def overall_height(attributes: Mapping[str, Any]) -> float | None:
    """Returns the measured height among an object's attributes, else that of its storeys above the ground."""
    for name in ("measuredHeight", "storeyHeightsAboveGround"):
        values = attributes[name] if isinstance(attributes.get(name), list) else [attributes.get(name)]
        if values and all(type(value) in (int, float) for value in values):
            return float(sum(values))
    return None


def _numbers(element: Element) -> list[str]:
    text = element.text or ""
    return text.split() if _DECIMALS.fullmatch(text) else []


def _is_overall(height: dict[str, Any]) -> bool:
    return (height.get("lowReference"), height.get("highReference")) == (
        "lowestGroundPoint",
        "highestRoofEdge",
    )


def _metres(element: Element) -> float | None:
    """Returns the metres per unit that a measure declares, None where its unit is no known length."""
    return _metres_per(element.get("uom", "m"))


@lru_cache(maxsize=256)
def _metres_per(uom: str) -> float | None:
    unit = uom.strip().lower()
    # What divides is no length; names of authorities are URNs and addresses.
    name = unit if "/" in unit and "://" not in unit else re.split("[:#/]", unit)[-1]
    return _METRES_PER_UNIT.get(name)


def _storeys(name: str, text: str, metres: float) -> Any:
    """Returns the number of storeys, or a list of their heights in metres; the text where it is neither."""
    try:
        return int(text) if name.startswith("storeys") else [float(word) * metres for word in text.split()]
    except ValueError:
        return text.strip()


def _put_generic(values: dict[str, Any], element: Element, depth: int) -> None:
    """Adds a generic attribute under its own name; a set of them is a mapping."""
    if local_name(element.tag) == "genericAttribute":  # of CityGML 3, around the attribute
        for inner in element.iterchildren("*"):
            _put_generic(values, inner, depth)
        return
    kind = local_name(element.tag)
    name = element.get("name") or (element.findtext("{*}name") or "").strip()
    if not name:
        return
    if not kind.lower().endswith("attributeset"):
        _put(values, name, _generic(element, kind[:1].lower() + kind[1:]))
    elif depth < _MAX_DEPTH:
        inside: dict[str, Any] = {}
        for child in element.iterchildren("*"):
            if local_name(child.tag) not in ("name", "codeSpace"):
                _put_generic(inside, child, depth + 1)
        _put(values, name, inside)


def _generic(element: Element, kind: str) -> Any:
    value = next(element.iterchildren("{*}value"), None)
    text = (value.text or "").strip() if value is not None else ""
    try:
        return _GENERIC_KINDS.get(kind, str)(text)
    except ValueError:
        return text


def _put(values: dict[str, Any], name: str, value: Any) -> None:
    """Adds a value; a name met again becomes a list."""
    if name not in values:
        values[name] = value
    elif isinstance(values[name], list):
        values[name].append(value)
    else:
        values[name] = [values[name], value]


def _value(element: Element, depth: int) -> Any:
    if len(element) == 0:
        text = (element.text or "").strip() or str(element.get(XLINK_HREF) or "")
        return _number(text, _metres(element) or 1.0) if element.get("uom") is not None else text
    if depth >= _MAX_DEPTH:
        return None
    values: dict[str, Any] = {}
    for child in element.iterchildren("*"):
        value = _value(child, depth + 1)
        if value not in (None, "", {}):
            _put(values, local_name(child.tag), value)
    return values


def _number(text: str, scale: float) -> Any:
    try:
        return float(text) * scale
    except ValueError:
        return text


def _leaves(element: Element) -> dict[str, Any]:
    """Returns the texts below an address by their innermost names."""
    values: dict[str, Any] = {}
    for node in element.iter("*"):
        text = (node.text or "").strip()
        name, parent = local_name(node.tag), node.getparent()
        if len(node) == 0 and text and name not in ("pos", "posList"):
            around = "" if parent is None else local_name(parent.tag)
            given = next((v for key, v in node.items() if local_name(str(key)) == "Type"), None)
            _put(values, str(given or _ADDRESS_NAMES.get((around, name), name)), text)
    return values


class SolidReader:
    """Finds the solids of a member and the polygons that close them.

    Attributes:
        polygons: The member's polygons by their number in the walk.
    """

    def __init__(self, member: Element, walk: GeometryWalk, table: ObjectTable, first_serial: int) -> None:
        self._index: MemberIndex = index_member(member, walk)
        self.polygons = self._index.polygons
        self._table, self._left_out = table, walk.left_out
        self._first = first_serial
        for element, number in self._index.polygons.items():
            gml_id = next((element.get(name) for name in GML_IDS if element.get(name)), None)
            if gml_id is not None:
                table.polygon_ids[first_serial + number] = str(gml_id)

    def read(self, building: Element, part_of: dict[Element, int], own: int) -> None:
        """Adds the solids of a building and its parts."""
        for prop in building.iter(*GEOMETRY_PROPERTIES):
            if property_lod(prop.tag) is None or is_another_s(prop, building, self._left_out):
                continue
            composites: dict[Element, int] = {}
            for composite in prop.iter("{*}CompositeSolid"):
                composites[composite] = self._table.num_composites
                self._table.num_composites += 1
            for solid in prop.iter("{*}Solid"):
                shells = [
                    self._faces(shell)
                    for name in ("{*}exterior", "{*}interior")
                    for shell in solid.iterchildren(name)
                ]
                if any(shells):
                    around = owner_of(solid, prop, composites, -1) if composites else -1
                    self._table.solids.append((owner_of(prop, building, part_of, own), shells, around))

    def _faces(self, shell: Element) -> list[tuple[int, bool]]:
        """Returns serial number and direction of each polygon of a shell, borrowed ones included."""
        faces: list[tuple[int, bool]] = []
        visited: set[Element] = {shell}
        todo = [(shell, False)]
        for root, is_flipped in todo:  # which grows
            for node in root.iter(*POLYGONS, "{*}surfaceMember", "{*}baseSurface"):
                number = self._index.polygons.get(node)
                if number is not None:
                    faces.append((self._first + number, is_flipped))
                href = node.get(XLINK_HREF)
                name = (href or "").strip().removeprefix("#").strip().removeprefix("urn:uuid:")
                target = self._index.elements.get(name)
                if target is not None and target not in visited:
                    visited.add(target)
                    parent = node.getparent()
                    is_turned = parent is not None and parent.get("orientation", "+").strip() == "-"
                    todo.append((target, is_flipped ^ is_turned))
        return faces
