"""The city from above with every query's cameras, as an SVG that a page lets one move and enlarge."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.reporting.page import rendered

Floats = NDArray[np.float64]
# Triangles beyond this are left out, those furthest from the cameras first: a browser must draw them all.
_MAX_TRIANGLES = 40_000
# Triangles steeper than this are walls, which from above are lines.
_LEAST_FLAT = 0.2
_MARGIN_M = 40.0


class Spot(NamedTuple):
    """A query on the map: (2,) east and north in metres of each camera, None where there is none."""

    key: str
    prior: Floats | None
    estimate: Floats | None
    truth: Floats | None
    trust: str = ""


def draw_map(spots: Sequence[Spot], vertices: Floats | None, triangles: NDArray[np.int32] | None) -> str:
    """Returns the map as HTML; "" where no camera is known.

    Args:
        spots: The queries.
        vertices: (V, 3) the city's, in the coordinates of the spots; None to leave the city out.
        triangles: (T, 3) their indices.
    """
    known = [place for spot in spots for place in spot[1:4] if place is not None]
    if not known:
        return ""
    places = np.array(known)
    low, high = places.min(axis=0), places.max(axis=0)
    margin = _MARGIN_M + 0.15 * float((high - low).max())
    low, high = low - margin, high + margin
    city = ""
    if vertices is not None and triangles is not None:
        city = _outlines(vertices, triangles, (low + high) / 2, float((high - low).max()), low)
    width, height = high - low
    return rendered(
        "map.html.jinja",
        box=(0.0, -round(float(height), 1), round(float(width), 1), round(float(height), 1)),
        city=city,
        spots=[(spot.key, spot.trust, _lines(spot, low), _dots(spot, low)) for spot in spots],
        has_truth=any(spot.truth is not None for spot in spots),
    )


def _outlines(
    vertices: Floats, triangles: NDArray[np.int32], middle: Floats, reach_m: float, low: Floats
) -> str:
    """Returns the path of the flat triangles near the cameras; north is up, so y is turned round."""
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sizes = np.linalg.norm(normals, axis=1)
    away = np.abs(corners[:, :, :2].mean(axis=1) - middle).max(axis=1)
    is_shown = (np.abs(normals[:, 2]) > _LEAST_FLAT * sizes) & (away < reach_m + _MARGIN_M)
    chosen = np.flatnonzero(is_shown)
    chosen = np.sort(chosen[np.argsort(away[chosen], kind="stable")[:_MAX_TRIANGLES]])
    flat = np.round((corners[chosen, :, :2] - low) * (1.0, -1.0), 1)
    # All one way round: a roof and the floor below it would cancel each other out.
    turned = normals[chosen, 2] < 0
    flat[turned] = flat[turned, ::-1]
    return "".join(
        f"M{ax:g} {ay:g}L{bx:g} {by:g} {cx:g} {cy:g}Z" for (ax, ay), (bx, by), (cx, cy) in flat.tolist()
    )


def _lines(spot: Spot, low: Floats) -> list[tuple[str, str]]:
    """Returns kind and path of the lines that end at the truth, or where there is none at the estimate."""
    end, kinds = spot.truth, (("prior", spot.prior), ("estimate", spot.estimate))
    if end is None:
        end, kinds = spot.estimate, (("prior", spot.prior),)  # type: ignore[assignment]
    if end is None:
        return []
    x, y = _at(end, low)
    found = [(kind, _at(start, low)) for kind, start in kinds if start is not None]
    return [(kind, f"M{a:g} {b:g}L{x:g} {y:g}") for kind, (a, b) in found]


def _dots(spot: Spot, low: Floats) -> list[tuple[str, str]]:
    named = (("truth", spot.truth), ("prior", spot.prior), ("estimate", spot.estimate))
    found = [(kind, _at(place, low)) for kind, place in named if place is not None]
    # A line of no length with a round end is a dot as wide as its pen, at every scale.
    return [(kind, f"M{x:g} {y:g}h0") for kind, (x, y) in found]


def _at(place: Floats, low: Floats) -> tuple[float, float]:
    x, y = np.round((place - low) * (1.0, -1.0), 2)
    return float(x), float(y)
