"""What references of CityGML may name in a member."""

from __future__ import annotations

from dataclasses import dataclass

from lodbench.citymodel.gml_names import GML_IDS, POLYGONS
from lodbench.citymodel.gml_walk import GeometryWalk
from lodbench.citymodel.xml import Element


@dataclass(slots=True)
class MemberIndex:
    """Everything in a member that can be referred to; built only when a plain look-up fails."""

    elements: dict[str, Element]
    polygons: dict[Element, int]


def index_member(member: Element, walk: GeometryWalk | None) -> MemberIndex:
    """Returns what can be referred to; polygons by number where ``walk`` has just collected them."""
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
