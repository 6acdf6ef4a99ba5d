"""What flights say of a map against what was done to it: counts that add up over flights."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from shapely import Polygon, box, unary_union

# A height is recovered within this, metres.
RECOVERED_M = 0.5
# A place that is found may miss the building it is by this, metres.
_NEAR_M = 3.0


@dataclass(frozen=True, slots=True)
class MapScore:
    """Counts; those of several flights add up.

    Attributes:
        heights: Buildings whose roofs photos show and whose heights the flight reports.
        recovered: Of them, those whose height against the map is reported within 0.5 m.
        wrong: Buildings whose roofs photos show and whose height was changed, reported or not.
        found_wrong: Of these, those in doubt.
        doubted: Buildings in doubt, whether photos can tell or not.
        rightly: Of the doubted, those whose height was changed.
        demolished: Buildings that stand in the map only, and that several photos should show.
        reported_demolished: Buildings reported as demolished.
        rightly_demolished: Of them, those that stand in the map only.
        unmapped: Buildings that the map lacks, and that several photos show.
        found: Of them, those found.
        places: Places reported as unmapped.
        rightly_unmapped: Of them, those where the map lacks one.
        clutter: Of the others, those where something else stands that no map holds: containers, tents, heaps.
    """

    heights: int = 0
    recovered: int = 0
    wrong: int = 0
    found_wrong: int = 0
    doubted: int = 0
    rightly: int = 0
    demolished: int = 0
    reported_demolished: int = 0
    rightly_demolished: int = 0
    unmapped: int = 0
    found: int = 0
    places: int = 0
    rightly_unmapped: int = 0
    clutter: int = 0

    def __add__(self, other: MapScore) -> MapScore:
        """Returns the counts of both."""
        return MapScore(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


def score_map(
    findings: Mapping[str, Any],
    changed: Mapping[str, Any],
    shown: Collection[str],
    roofs: Collection[str],
    boxes: Mapping[str, Sequence[float]],
    clutter: Sequence[Sequence[float]] = (),
) -> MapScore:
    """Returns how a flight's findings compare with what was done to the map.

    Args:
        findings: ``buildings`` and ``changes``, as ``method=flight`` reports them.
        changed: ``heights`` (metres that a building is higher in the map than in truth, by id), ``missing``
            and ``extra`` (ids).
        shown: Ids of the buildings of either that at least three photos show.
        roofs: Ids of the map's buildings whose roofs at least two photos show.
        boxes: West, south, east and north of each missing building, the city's coordinates.
        clutter: The same of what stands there besides.
    """
    truth = changed["heights"]
    reported = {b["id"]: b for b in findings["buildings"] if b["id"] not in changed["extra"]}
    seen = {name: b for name, b in reported.items() if name in roofs}
    errors = [abs(b["higher_m"] + truth.get(name, 0.0)) for name, b in seen.items()]
    doubted = [name for name, b in reported.items() if b["doubt"]]
    reported_demolished = [c["id"] for c in findings["changes"] if c["kind"] == "demolished"]
    outlines = [c["outline"] for c in findings["changes"] if c["kind"] == "unmapped"]
    places = [unary_union([Polygon(ring) for ring in rings]) for rings in outlines]
    lacking = {name: box(*boxes[name]).buffer(_NEAR_M) for name in changed["missing"] if name in boxes}
    others = [place for place in places if not any(place.intersects(there) for there in lacking.values())]
    standing = unary_union([box(*each) for each in clutter])
    return MapScore(
        heights=len(errors),
        recovered=int(np.count_nonzero(np.array(errors) < RECOVERED_M)),
        wrong=sum(name in roofs for name in truth),
        found_wrong=sum(name in truth and name in roofs for name in doubted),
        doubted=len(doubted),
        rightly=sum(name in truth for name in doubted),
        demolished=sum(name in shown for name in changed["extra"]),
        reported_demolished=len(reported_demolished),
        rightly_demolished=sum(name in changed["extra"] for name in reported_demolished),
        unmapped=sum(name in shown for name in lacking),
        found=sum(
            name in shown and any(place.intersects(there) for place in places)
            for name, there in lacking.items()
        ),
        places=len(places),
        rightly_unmapped=len(places) - len(others),
        clutter=sum(bool(place.intersects(standing)) for place in others),
    )
