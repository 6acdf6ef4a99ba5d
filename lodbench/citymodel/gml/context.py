"""What stands around an element of CityGML, and how old notations write numbers."""

from __future__ import annotations

from itertools import chain
from typing import cast

from lxml import etree

from lodbench.citymodel.gml.names import (
    GML_IDS,
    INTERIOR_NAMES,
    OBJECT_PROPERTIES,
    OUTER_NAMES,
    ROOF_EDGE,
    STOREYS,
    SURFACE_KINDS,
    is_building_tag,
    is_extension,
)
from lodbench.citymodel.gml.xml import Element, local_name
from lodbench.citymodel.lifespans import NAMES
from lodbench.citymodel.model import SurfaceKind

# Of the object itself, of its surfaces and parts, and of their surfaces: a look at all would cost too much,
# and one expression for all three merges what it finds in the square of their number.
_LINKED = [
    etree.XPath(f"{path}[@xlink:href]", namespaces={"xlink": "http://www.w3.org/1999/xlink"})
    for path in ("*", "*/*/*", "*/*/*/*/*")
]
# Days, heights and roofs of objects; where their envelopes are.
HEIGHTS = ("measuredHeight", "storeyHeightsAboveGround", "storeyHeightsBelowGround")
_NOTED = frozenset({*NAMES, "height", *HEIGHTS, "roofType", "stringAttribute", "boundedBy"})
# Plain integers: looking a member up in its class costs more than the rest of a step.
_UNKNOWN, _ROOF, _INTERIOR = map(int, (SurfaceKind.UNKNOWN, SurfaceKind.ROOF, SurfaceKind.INTERIOR))


def plain_numbers(element: Element) -> str:
    """Returns the numbers of a GML2 ``coordinates`` element separated by blanks.

    The element may name its own separators: ``cs`` between coordinates, ``ts`` between tuples,
    ``decimal`` as the decimal sign.
    """
    text = element.text or ""
    decimal = element.get("decimal", ".")
    for separator in (element.get("cs", ","), element.get("ts", " ")):
        if separator.strip() and separator != decimal:
            text = text.replace(separator, " ")
    return text if decimal == "." else text.replace(decimal, ".")


def surface_kind(prop: Element, building: Element) -> int:
    """Returns the ``SurfaceKind`` of a geometry property, from the elements around it."""
    node = prop.getparent()
    if node is None or node is building:
        return _ROOF if local_name(prop.tag) == ROOF_EDGE else _UNKNOWN
    name = local_name(node.tag)
    if name in OUTER_NAMES:
        return SURFACE_KINDS[name]
    kind = _UNKNOWN
    while node is not None and node is not building:
        name = local_name(node.tag)
        if name in INTERIOR_NAMES:
            return _INTERIOR
        if kind == _UNKNOWN:
            kind = SURFACE_KINDS.get(name, _UNKNOWN)
        node = node.getparent()
    return kind


def is_in_ring(element: Element) -> bool:
    """Returns whether a curve or point belongs to a ring (``curveMember``, ``pointProperty``)."""
    node = element.getparent()
    while node is not None:
        name = local_name(node.tag)
        if name in ("Ring", "LinearRing"):
            return True
        if name in ("MultiGeometry", "MultiCurve", "Polygon"):
            return False
        node = node.getparent()
    return False


def owner_of(prop: Element, building: Element, part_of: dict[Element, int], own: int) -> int:
    """Returns the object a geometry property belongs to: the nearest around it."""
    node = prop.getparent()
    while node is not None and node is not building:
        if node in part_of:
            return part_of[node]
        node = node.getparent()
    return own


def storeys_among(building: Element, part_of: dict[Element, int]) -> set[int]:
    """Returns the numbers of the storeys and units of a building, and of what is in them."""
    storeys: set[int] = set()
    for element, number in part_of.items():  # what is around an object comes before it
        if local_name(element.tag) in STOREYS or owner_of(element, building, part_of, -1) in storeys:
            storeys.add(number)
    return storeys


def relief_lod(surface: Element) -> str:
    """Returns the level of detail of a terrain surface, which stands beside it."""
    relief = surface.getparent()
    return "" if relief is None else (relief.findtext("{*}lod") or "").strip()


def is_inside(element: Element, met: list[tuple[Element, dict[Element, int], int]]) -> bool:
    """Returns whether an element stands inside of one that was met, as terrain does inside of terrain."""
    above = set(element.iterancestors())
    return any(other in above for other, _, _ in met)


def is_another_s(node: Element, building: Element, left_out: set[Element]) -> bool:
    """Tells whether something inside of a building stands in what is left out, or in an extension's property.

    What a property of another namespace holds is no boundary of the building: thermal zones, measured noise.
    Objects of other namespaces in properties of CityGML are, such as a roof of a kind of its own.
    """
    above = node.getparent()
    while above is not None and above is not building:
        if above in left_out or is_extension(above.tag):
            return True
        above = above.getparent()
    return False


def extension_above(node: Element, building: Element) -> Element | None:
    """Returns the outermost property of an extension that something inside of a building stands in."""
    found = None
    for above in node.iterancestors():
        if above is building:
            break
        found = above if is_extension(above.tag) else found
    return found


def buildings_inside(element: Element) -> set[Element]:
    """Returns the buildings inside of another (``generalizesTo``), which are read as their own."""
    return {inner for inner in element.iterdescendants("{*}Building") if is_building_tag(inner.tag)}


def linked_objects(element: Element) -> list[Element]:
    """Returns the properties of an object and of its parts that refer to a surface or part elsewhere."""
    linked = chain.from_iterable(cast("list[Element]", find(element)) for find in _LINKED)
    return [prop for prop in linked if len(prop) == 0 and local_name(prop.tag) in OBJECT_PROPERTIES]


class _NotedNames(dict[str, str]):
    """Full tag to local name, "" for what is not noted; filled as tags are met."""

    def __missing__(self, tag: str) -> str:
        name = local_name(tag)
        self[tag] = name = name if name in _NOTED else ""
        return name


_noted_names = _NotedNames()


def noted_children(element: Element) -> dict[str, list[Element]]:
    """Returns the children of an object that say what it is, not of what, by their local names."""
    noted: dict[str, list[Element]] = {}
    for child in element:
        name = _noted_names[child.tag]
        if name:
            noted.setdefault(name, []).append(child)
    return noted


def gml_id(element: Element) -> str | None:
    """Returns an element's id, or None."""
    for name in GML_IDS:
        value = element.get(name)
        if value is not None:
            return str(value)
    return None


def envelope_srs(element: Element) -> str | None:
    """Returns the srsName of an element's own ``boundedBy/Envelope``, if it has one."""
    for child in element.iterchildren("{*}boundedBy"):
        for envelope in child.iterchildren("{*}Envelope"):
            name = envelope.get("srsName")
            return None if name is None else str(name).strip()
    return None


def declared_around(geometry: Element) -> tuple[str | None, int]:
    """Returns the srsName and the srsDimension around a geometry, None and 0 where none is."""
    names = (node.get("srsName") for node in geometry.iterancestors())
    dimensions = ((node.get("srsDimension") or "").strip() for node in geometry.iterancestors())
    srs_name = next((str(name).strip() for name in names if name), None)
    return srs_name, int(next((text for text in dimensions if text in ("2", "3")), 0))
