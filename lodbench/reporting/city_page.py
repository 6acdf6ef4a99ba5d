"""One HTML page of a city made of footprints: which building has its height from where."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.reporting.map_figure import Marked, draw_plan
from lodbench.reporting.page import markup, rendered

# Rows of the table of buildings: a browser sorts them in a moment. The city file has all.
_MAX_ROWS = 3000


class MadeBuilding(NamedTuple):
    """A building of a city that was made.

    Attributes:
        name: Its id.
        height_m: Above the ground.
        ground_m: Height of the ground.
        height_from, ground_from: What gave them, in words.
        rings: (N, 2) east and north each, of its outline and holes.
    """

    name: str
    height_m: float
    ground_m: float
    height_from: str
    ground_from: str
    rings: Sequence[NDArray[np.float64]]


def city_page(
    title: str,
    lines: Sequence[str],
    buildings: Sequence[MadeBuilding],
    left_out: Mapping[str, Sequence[str]],
    findings: Sequence[tuple[str, int, str]],
) -> str:
    """Returns the page as HTML.

    Args:
        title: Its heading.
        lines: What it was made from, a sentence each.
        buildings: Those of the city.
        left_out: Ids of footprints that are not in it, by why.
        findings: Code and name, how often, and what each kind means.
    """
    sources = sorted(
        {each.height_from for each in buildings}, key=lambda name: (name != "surface model", name)
    )
    by_source = {name: [each for each in buildings if each.height_from == name] for name in sources}
    groups = {
        name: [Marked(f"{each.name}: {each.height_m:.1f} m, {name}", each.rings) for each in of_source]
        for name, of_source in by_source.items()
    }
    rows = [
        (name, len(own), *(f"{value:.1f}" for value in np.percentile([b.height_m for b in own], (5, 50, 95))))
        for name, own in by_source.items()
    ]
    # Those that no surface model measured are to be looked at first.
    order = sorted(buildings, key=lambda each: (each.height_from == "surface model", each.name))
    return rendered(
        "city.html.jinja",
        title=title,
        lines=lines,
        map=markup(draw_plan(groups)),
        rows=rows,
        left_out=[(why, len(names), ", ".join(names[:5])) for why, names in left_out.items()],
        buildings=order[:_MAX_ROWS],
        count=len(buildings),
        findings=findings,
    )
