"""Labels of surfaces in CityJSON: one for each surface, nested as the surfaces are, or nearly so."""

from __future__ import annotations

from itertools import chain
from typing import Any

from lodbench.citymodel.gml_names import INTERIOR_NAMES, SURFACE_KINDS
from lodbench.citymodel.model import SurfaceKind

# How many lists of lists stand around a surface.
DEPTHS = {"MultiSurface": 0, "CompositeSurface": 0, "Solid": 1, "MultiSolid": 2, "CompositeSolid": 2}


def surface_kinds(geometry: dict[str, Any], num_surfaces: int, is_interior: bool) -> tuple[list[int], str]:
    """Returns the ``SurfaceKind`` of each surface, in the order of the boundaries, and what is odd about it.

    Labels nested otherwise than the surfaces are taken in their order where their number fits.
    """
    if is_interior:
        return [int(SurfaceKind.INTERIOR)] * num_surfaces, ""
    unknown = [int(SurfaceKind.UNKNOWN)] * num_surfaces
    semantics = geometry.get("semantics")
    if not isinstance(semantics, dict):
        return unknown, ""
    labels = semantics.get("values", [])  # null is no label for any surface
    if labels is None or not (labels or semantics.get("surfaces")):
        return unknown, ""
    names = [str(surface.get("type")) for surface in semantics.get("surfaces", ())]
    known = [int(SurfaceKind.INTERIOR if n in INTERIOR_NAMES else SURFACE_KINDS.get(n, 0)) for n in names]
    values, is_aligned = _labels(labels, geometry["boundaries"], DEPTHS[geometry["type"]])
    if len(values) != num_surfaces:
        return unknown, f"{len(values)} labels of {num_surfaces} surfaces: none is taken"
    if set(map(type, values)) == {int} and 0 <= min(values) and max(values) < len(known):
        kinds, num_lost = [known[v] for v in values], 0
    else:
        kinds = [known[v] if type(v) is int and 0 <= v < len(known) else 0 for v in values]
        num_lost = sum(v is not None and not (type(v) is int and 0 <= v < len(known)) for v in values)
    if num_lost:
        return kinds, f"{num_lost} of {num_surfaces} labels name no surface type of the geometry"
    return kinds, "" if is_aligned else f"{num_surfaces} labels nested otherwise, taken in their order"


def _labels(values: Any, boundaries: list[Any], depth: int) -> tuple[list[Any], bool]:
    """Returns the labels in the order of the surfaces, and whether they are nested as the surfaces are."""
    flat: list[Any] = []
    if _align(values, boundaries, depth, flat):
        return flat, True
    flat.clear()
    stack = [iter(values)] if isinstance(values, list) else []
    while stack:
        value = next(stack[-1], stack)
        if value is stack:
            stack.pop()
        elif isinstance(value, list):
            stack.append(iter(value))
        else:
            flat.append(value)
    return flat, False


def _align(values: Any, boundaries: list[Any], depth: int, flat: list[Any]) -> bool:
    """Appends one label per surface, None for those below a null; tells whether the nesting agrees."""
    if values is None:
        flat += [None] * len(flatten(boundaries, depth))
        return True
    if not isinstance(values, list) or len(values) != len(boundaries):
        return False
    if depth:
        return all(_align(v, b, depth - 1, flat) for v, b in zip(values, boundaries, strict=True))
    flat += values
    return list not in set(map(type, values))


def flatten(boundaries: list[Any], depth: int) -> list[Any]:
    """Returns the surfaces of a solid or of several."""
    for _ in range(depth):
        boundaries = list(chain.from_iterable(boundaries))
    return boundaries
