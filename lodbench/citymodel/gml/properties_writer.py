"""What CityGML says of an object besides its shape, as XML: attributes, references, addresses."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Any
from xml.sax.saxutils import escape, quoteattr

from lodbench.citymodel.gml.dialect import Dialect, tag

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
    told = [number for number in numbers if number is not None]
    return tag(name, " ".join(told), uom="m") if told and len(told) == len(numbers) else None


def _height(value: Any) -> str | None:
    inner = _measure("con:value", value)
    ends = tag("con:highReference", "highestRoofEdge") + tag("con:lowReference", "lowestGroundPoint")
    return None if inner is None else tag(
        "con:height", tag("con:Height", ends + tag("con:status", "measured") + inner)
    )  # fmt: skip


def _reference(value: Any, dialect: Dialect) -> str | None:
    """Returns a reference to another register, as CityGML 2 tells it."""
    told = value.get("externalObject") if isinstance(value, dict) else None
    if not isinstance(told, dict) or set(value) - {"informationSystem", "externalObject"} or len(told) != 1:
        return None
    (key, name), system = next(iter(told.items())), value.get("informationSystem")
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
    told = {key: text_of(value) for key, value in values.items() if not isinstance(value, dict | list)}
    if dialect.version == "3.0":
        return tag("core:xalAddress", tag("xAL:Address", _address_3(told)))
    return tag("core:xalAddress", tag("xAL:AddressDetails", tag("xAL:Country", _address_2(told))))


def _address_2(told: dict[str, str]) -> str:
    known = ("CountryName", "LocalityName", *_PLACE, "PostalCodeNumber")
    lines = "".join(
        f"<xAL:AddressLine Type={quoteattr(key)}>{value}</xAL:AddressLine>"
        for key, value in told.items() if key not in known
    )  # fmt: skip
    street = "".join(tag(f"xAL:{key}", told[key]) for key in _PLACE if key in told)
    locality = tag("xAL:LocalityName", told["LocalityName"]) if "LocalityName" in told else ""
    locality += tag("xAL:Thoroughfare", street, Type="Street") if street else ""
    if "PostalCodeNumber" in told:
        locality += tag("xAL:PostalCode", tag("xAL:PostalCodeNumber", told["PostalCodeNumber"]))
    country = tag("xAL:CountryName", told["CountryName"]) if "CountryName" in told else ""
    return lines + country + (tag("xAL:Locality", locality, Type="Town") if locality else "")


def _address_3(told: dict[str, str]) -> str:
    parts = {
        "CountryName": ("xAL:Country", "xAL:NameElement"),
        "LocalityName": ("xAL:Locality", "xAL:NameElement"),
        "ThoroughfareName": ("xAL:Thoroughfare", "xAL:NameElement"),
        "ThoroughfareNumber": ("xAL:Thoroughfare", "xAL:Number"),
        "PostalCodeNumber": ("xAL:PostCode", "xAL:Identifier"),
    }
    lines = "".join(
        f"<xAL:AddressLine xAL:Type={quoteattr(key)}>{value}</xAL:AddressLine>"
        for key, value in told.items() if key not in parts
    )  # fmt: skip
    grouped: dict[str, str] = {}
    for key, (outer, inner) in parts.items():
        if key in told:
            grouped[outer] = grouped.get(outer, "") + tag(inner, told[key])
    free = tag("xAL:FreeTextAddress", lines) if lines else ""
    return free + "".join(tag(outer, content) for outer, content in grouped.items())
