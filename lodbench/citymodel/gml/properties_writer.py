"""What CityGML says of an object besides its shape, as XML: attributes, references, addresses."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any
from xml.sax.saxutils import escape, quoteattr

from lodbench.citymodel.model import SurfaceKind

# Characters that XML 1.0 has no way to write.
_FORBIDDEN = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_DAY = re.compile(r"\d{4}-\d{2}-\d{2}")
_YEAR = re.compile(r"\d{4}")
_MAX_DEPTH = 8
# Names of xAL 2.0 that CityJSON uses too, in the order of its schema, and what they stand in.
_PLACE = ("ThoroughfareNumber", "ThoroughfareName")

Property = tuple[str, str]  # the name that tells its place, and the XML


def text_of(value: Any) -> str:
    """Returns a value as XML text; characters that XML cannot hold become a question mark."""
    if isinstance(value, bool):
        return "true" if value else "false"
    return escape(_FORBIDDEN.sub("?", str(value)))


def properties_of(attributes: dict[str, Any], type_: str, dialect: Dialect) -> Iterator[Property]:
    """Yields an object's attributes as properties of CityGML, in no order: generic ones where it has none.

    Args:
        attributes: As ``CityObjects.attributes`` has them.
        type_: The object's.
        dialect: The version.
    """
    known = _known(dialect, type_ in ("Building", "BuildingPart"))
    for name, value in attributes.items():
        if name == "address" and type_ in ("Building", "BuildingPart"):
            for address in value if isinstance(value, list) else [value]:
                if isinstance(address, dict):
                    yield "bldg:address", tag("bldg:address", tag("core:Address", _address(address, dialect)))
            continue
        rule = known.get(name)
        values = value if isinstance(value, list) and name in _REPEATED else [value]
        written = [] if rule is None else [rule[1](one) for one in values]
        if rule is not None and written and None not in written:
            yield from ((rule[0], tag(rule[0], str(content))) if content[:1] != "<" else (rule[0], content)
                        for content in written if content is not None)  # fmt: skip
        else:
            yield from (("gen:attribute" if dialect.version == "2.0" else "core:genericAttribute", xml)
                        for xml in _generic(name, value, dialect, 0))  # fmt: skip


_REPEATED = frozenset({"name", "function", "usage", "externalReference"})
_Rule = tuple[str, Callable[[Any], str | None]]


def _known(dialect: Dialect, is_building: bool) -> dict[str, _Rule]:
    """Returns the properties there are: name, and what writes a value, None where it is none of its kind."""
    day = _only(_DAY, dialect.date_form)
    known: dict[str, _Rule] = {
        "description": ("gml:description", _plain),
        "name": ("gml:name", _plain),
        "creationDate": ("core:creationDate", day),
        "terminationDate": ("core:terminationDate", day),
        "externalReference": ("core:externalReference", lambda value: _reference(value, dialect)),
        "class": ("bldg:class", _plain),
        "function": ("bldg:function", _plain),
        "usage": ("bldg:usage", _plain),
    }
    if not is_building:
        return known
    known["roofType"] = ("bldg:roofType", _plain)
    for side in ("Above", "Below"):
        known[f"storeys{side}Ground"] = (f"bldg:storeys{side}Ground", _count)
        heights = f"bldg:storeyHeights{side}Ground"
        known[f"storeyHeights{side}Ground"] = (heights, lambda value, name=heights: _heights(name, value))  # type: ignore[misc]
    if dialect.version == "2.0":
        known["measuredHeight"] = (
            "bldg:measuredHeight",
            lambda value: _measure("bldg:measuredHeight", value),
        )
        known["yearOfConstruction"] = ("bldg:yearOfConstruction", _only(_YEAR, "{}"))
        known["yearOfDemolition"] = ("bldg:yearOfDemolition", _only(_YEAR, "{}"))
    else:
        known["measuredHeight"] = ("con:height", _height)
        known["dateOfConstruction"] = ("con:dateOfConstruction", _only(_DAY, "{}"))
        known["dateOfDemolition"] = ("con:dateOfDemolition", _only(_DAY, "{}"))
    return known


def _plain(value: Any) -> str | None:
    return None if isinstance(value, dict | list) or value in (None, "") else text_of(value)


def _only(pattern: re.Pattern[str], form: str) -> Callable[[Any], str | None]:
    return lambda value: form.format(value) if pattern.fullmatch(str(value)) else None


def _number(value: Any) -> str | None:
    return repr(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _count(value: Any) -> str | None:
    text = str(value)
    return text if text.isascii() and text.isdigit() else None


def _measure(name: str, value: Any) -> str | None:
    text = _number(value)
    return None if text is None else tag(name, text, uom="m")


def _heights(name: str, value: Any) -> str | None:
    numbers = [_number(one) for one in (value if isinstance(value, list) else [value])]
    stated = [number for number in numbers if number is not None]
    return tag(name, " ".join(stated), uom="m") if stated and len(stated) == len(numbers) else None


def _height(value: Any) -> str | None:
    inner = _measure("con:value", value)
    ends = tag("con:highReference", "highestRoofEdge") + tag("con:lowReference", "lowestGroundPoint")
    return None if inner is None else tag(
        "con:height", tag("con:Height", ends + tag("con:status", "measured") + inner)
    )  # fmt: skip


def _reference(value: Any, dialect: Dialect) -> str | None:
    """Returns a reference to another register, as CityGML 2 tells it."""
    stated = value.get("externalObject") if isinstance(value, dict) else None
    if (
        not isinstance(stated, dict)
        or set(value) - {"informationSystem", "externalObject"}
        or len(stated) != 1
    ):
        return None
    (key, name), system = next(iter(stated.items())), value.get("informationSystem")
    if key not in ("name", "uri") or isinstance(name, dict | list):
        return None
    where = "" if system is None else tag("core:informationSystem", text_of(system))
    if dialect.version == "2.0":
        content = where + tag("core:externalObject", tag(f"core:{key}", text_of(name)))
        return tag("core:externalReference", content)
    content = tag("core:targetResource", text_of(name)) + where
    return tag("core:externalReference", tag("core:ExternalReference", content))


def _generic(name: str, value: Any, dialect: Dialect, depth: int) -> Iterator[str]:
    """Yields generic attributes: one per value of a list, a set for a mapping."""
    if isinstance(value, list) and depth < _MAX_DEPTH:
        for one in value:
            yield from _generic(name, one, dialect, depth + 1)
        return
    is_old = dialect.version == "2.0"
    if isinstance(value, dict) and value and depth < _MAX_DEPTH:
        inner = [xml for key, one in value.items() for xml in _generic(str(key), one, dialect, depth + 1)]
        kind, content = "genericAttributeSet", "".join(
            xml if is_old else tag("gen:genericAttribute", xml.removeprefix("<core:genericAttribute>")
                                   .removesuffix("</core:genericAttribute>")) for xml in inner
        )  # fmt: skip
        if not content:
            return
    elif value is None or value == {}:
        return
    else:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        kind = (
            ("intAttribute" if isinstance(value, int) else "doubleAttribute")
            if is_number
            else "stringAttribute"
        )
        content = tag("gen:value", repr(value) if is_number else text_of(value))
    if is_old:
        yield f"<gen:{kind} name={quoteattr(_FORBIDDEN.sub('?', name))}>{content}</gen:{kind}>"
    else:
        kind = kind[:1].upper() + kind[1:]
        yield tag("core:genericAttribute", tag(f"gen:{kind}", tag("gen:name", text_of(name)) + content))


def _address(values: dict[str, Any], dialect: Dialect) -> str:
    """Returns an address; what its standard has no element for becomes a line of that type."""
    stated = {key: text_of(value) for key, value in values.items() if not isinstance(value, dict | list)}
    if dialect.version == "3.0":
        return tag("core:xalAddress", tag("xAL:Address", _address_3(stated)))
    return tag("core:xalAddress", tag("xAL:AddressDetails", tag("xAL:Country", _address_2(stated))))


def _address_2(stated: dict[str, str]) -> str:
    known = ("CountryName", "LocalityName", *_PLACE, "PostalCodeNumber")
    lines = "".join(
        f"<xAL:AddressLine Type={quoteattr(key)}>{value}</xAL:AddressLine>"
        for key, value in stated.items() if key not in known
    )  # fmt: skip
    street = "".join(tag(f"xAL:{key}", stated[key]) for key in _PLACE if key in stated)
    locality = tag("xAL:LocalityName", stated["LocalityName"]) if "LocalityName" in stated else ""
    locality += tag("xAL:Thoroughfare", street, Type="Street") if street else ""
    if "PostalCodeNumber" in stated:
        locality += tag("xAL:PostalCode", tag("xAL:PostalCodeNumber", stated["PostalCodeNumber"]))
    country = tag("xAL:CountryName", stated["CountryName"]) if "CountryName" in stated else ""
    return lines + country + (tag("xAL:Locality", locality, Type="Town") if locality else "")


def _address_3(stated: dict[str, str]) -> str:
    parts = {
        "CountryName": ("xAL:Country", "xAL:NameElement"),
        "LocalityName": ("xAL:Locality", "xAL:NameElement"),
        "ThoroughfareName": ("xAL:Thoroughfare", "xAL:NameElement"),
        "ThoroughfareNumber": ("xAL:Thoroughfare", "xAL:Number"),
        "PostalCodeNumber": ("xAL:PostCode", "xAL:Identifier"),
    }
    lines = "".join(
        f"<xAL:AddressLine xAL:Type={quoteattr(key)}>{value}</xAL:AddressLine>"
        for key, value in stated.items() if key not in parts
    )  # fmt: skip
    grouped: dict[str, str] = {}
    for key, (outer, inner) in parts.items():
        if key in stated:
            grouped[outer] = grouped.get(outer, "") + tag(inner, stated[key])
    free = tag("xAL:FreeTextAddress", lines) if lines else ""
    return free + "".join(tag(outer, content) for outer, content in grouped.items())


Rank = dict[str, int]

_SURFACES = {
    SurfaceKind.GROUND: "GroundSurface",
    SurfaceKind.WALL: "WallSurface",
    SurfaceKind.ROOF: "RoofSurface",
    SurfaceKind.CLOSURE: "ClosureSurface",
    SurfaceKind.FLOOR: "OuterFloorSurface",
    SurfaceKind.CEILING: "OuterCeilingSurface",
    SurfaceKind.INTERIOR: "InteriorWallSurface",
}
_OBJECT = (
    "gml:description",
    "gml:name",
    "core:creationDate",
    "core:terminationDate",
    "core:externalReference",
)


@dataclass(frozen=True, slots=True)
class Dialect:
    """A version of CityGML."""

    version: str  # ``"2.0"`` or ``"3.0"``
    namespaces: dict[str, str]  # URI by prefix
    surfaces: dict[int, str]  # element of each kind of boundary surface
    openings: dict[int, str]  # element of windows and of doors
    # Properties that hold them
    boundary: str
    opening: str
    levels: tuple[int, ...]  # whole levels of detail that there are
    surface_levels: tuple[int, ...]  # levels at which boundary surfaces have geometry
    loose_levels: tuple[int, ...]  # levels at which an object has surfaces of its own that bound nothing
    date_form: str  # how a day is written where it is one
    rank: Rank  # place of each property among the children of any object


def _ranks(*names: str) -> Rank:
    return {name: place for place, name in enumerate(names)}


def _namespaces(version: str, gml: str, address: str) -> dict[str, str]:
    modules = {"bldg": "building", "gen": "generics", "app": "appearance"}
    if version == "3.0":
        modules["con"] = "construction"
    return {
        "core": f"http://www.opengis.net/citygml/{version}",
        **{prefix: f"http://www.opengis.net/citygml/{name}/{version}" for prefix, name in modules.items()},
        "gml": gml,
        "xAL": address,
        "xlink": "http://www.w3.org/1999/xlink",
    }


_FACTS = ("bldg:class", "bldg:function", "bldg:usage")
_STOREYS = (
    "bldg:storeysAboveGround", "bldg:storeysBelowGround", "bldg:storeyHeightsAboveGround",
    "bldg:storeyHeightsBelowGround",
)  # fmt: skip

CITYGML_2 = Dialect(
    version="2.0",
    namespaces=_namespaces("2.0", "http://www.opengis.net/gml", "urn:oasis:names:tc:ciq:xsdschema:xAL:2.0"),
    surfaces={kind: f"bldg:{name}" for kind, name in _SURFACES.items()},
    openings={SurfaceKind.OPENING: "bldg:Window", SurfaceKind.DOOR: "bldg:Door"},
    boundary="bldg:boundedBy",
    opening="bldg:opening",
    levels=(0, 1, 2, 3, 4),
    surface_levels=(2, 3, 4),
    loose_levels=(0, 1, 2, 3, 4),
    date_form="{}",
    rank=_ranks(
        *_OBJECT, "core:relativeToTerrain", "core:relativeToWater", "gen:attribute",
        *_FACTS, "bldg:yearOfConstruction", "bldg:yearOfDemolition", "bldg:roofType",
        "bldg:measuredHeight", *_STOREYS, "bldg:lod0FootPrint", "bldg:lod0RoofEdge",
        "bldg:lod1Solid", "bldg:lod1MultiSurface",
        "bldg:lod2Solid", "bldg:lod2MultiSurface", "bldg:lod2Geometry", "bldg:lod3Geometry",
        "bldg:lod4Geometry", "bldg:outerBuildingInstallation", "bldg:interiorBuildingInstallation",
        "room:lod4Solid", "room:lod4MultiSurface",
        "bldg:boundedBy", "bldg:lod3Solid", "bldg:lod3MultiSurface", "bldg:lod4Solid",
        "bldg:lod4MultiSurface", "bldg:opening", "bldg:interiorFurniture", "bldg:roomInstallation",
        "bldg:interiorRoom", "bldg:consistsOfBuildingPart", "bldg:address",
    ),
)  # fmt: skip
CITYGML_3 = Dialect(
    version="3.0",
    namespaces=_namespaces("3.0", "http://www.opengis.net/gml/3.2", "urn:oasis:names:tc:ciq:xal:3"),
    surfaces={
        kind: f"{'core' if kind == SurfaceKind.CLOSURE else 'con'}:{name}" for kind, name in _SURFACES.items()
    },
    openings={SurfaceKind.OPENING: "con:WindowSurface", SurfaceKind.DOOR: "con:DoorSurface"},
    boundary="core:boundary",
    opening="con:fillingSurface",
    levels=(0, 1, 2, 3),
    surface_levels=(0, 1, 2, 3),
    loose_levels=(0, 2, 3),
    date_form="{}T00:00:00",
    rank=_ranks(
        *_OBJECT, "core:relativeToTerrain", "core:relativeToWater", "core:genericAttribute",
        "core:boundary", "core:lod0MultiSurface", "core:lod1MultiSurface", "core:lod1Solid", "core:lod2Solid",
        "core:lod2MultiSurface", "core:lod3Solid", "core:lod3MultiSurface", "con:fillingSurface",
        "con:dateOfConstruction", "con:dateOfDemolition", "con:height", *_FACTS, "bldg:roofType", *_STOREYS,
        "bldg:buildingConstructiveElement", "bldg:buildingInstallation", "bldg:buildingRoom",
        "bldg:buildingFurniture", "bldg:buildingSubdivision", "bldg:address", "bldg:buildingPart",
    ),
)  # fmt: skip


def tag(name: str, content: str = "", **attributes: str) -> str:
    """Returns an element; ``gml__id`` becomes ``gml:id``. Attributes and content are XML already.

    Example:
        >>> tag("gml:name", "a &amp; b"), tag("gml:surfaceMember", xlink__href="#p1")
        ('<gml:name>a &amp; b</gml:name>', '<gml:surfaceMember xlink:href="#p1"/>')
    """
    stated = "".join(f' {key.replace("__", ":")}="{value}"' for key, value in attributes.items())
    return f"<{name}{stated}>{content}</{name}>" if content else f"<{name}{stated}/>"
