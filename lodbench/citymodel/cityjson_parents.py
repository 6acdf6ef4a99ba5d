"""What is a part of what in a CityJSON document, told from either side."""

from __future__ import annotations

from typing import Any

_GROUP = "CityObjectGroup"

Json = dict[str, Any]


def parents_of(objects: dict[str, Json]) -> dict[str, str]:
    """Returns the object that each is a part of; a group only lists its members, which stay their own."""
    parents: dict[str, str] = {}
    for object_id, item in objects.items():
        if item.get("type") == _GROUP:
            continue
        for child in item.get("children") or ():
            parents.setdefault(str(child), object_id)
    for object_id, item in objects.items():
        told = (str(parent) for parent in item.get("parents") or ())
        own = next((one for one in told if objects.get(one, {}).get("type") != _GROUP), None)
        if own is not None:
            parents[object_id] = own
    return {child: parent for child, parent in parents.items() if parent in objects}


def roots_of(objects: dict[str, Json], parents: dict[str, str]) -> dict[str, str]:
    """Returns the topmost ancestor of each object; a circle ends where it closes."""
    roots: dict[str, str] = {}
    for object_id in objects:
        top, line = object_id, {object_id}
        while top not in roots and (parent := parents.get(top)) is not None and parent not in line:
            top = parent
            line.add(top)
        roots.update(dict.fromkeys(line, roots.get(top, top)))
    return roots
