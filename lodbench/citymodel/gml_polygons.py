"""What the walk over a city object collects: polygons as text, and references between them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from lodbench.citymodel.gml_implicit import Placement


class Reference(NamedTuple):
    """An XLink met inside a geometry property: the id it names, and whose surface it stands for."""

    href: str
    building: int
    lod: int
    kind: int
    is_flipped: bool
    placement: Placement | None


@dataclass(slots=True)
class PolygonBatch:
    """Polygons of many city objects as text, in document order.

    Attributes:
        texts: One text of numbers per ring.
        dimensions: Ring index to declared dimension, for the rings that declare one.
        solid_rings: Rings that declare three dimensions themselves, which most files do, or none.
        ring_counts: Rings of each polygon.
        owners: (building, lod, kind, srs) of each polygon.
        flipped: Polygons whose orientation is turned round.
        copies: Polygons that repeat an earlier one: source polygon, building, lod, kind, flipped,
            placement.
        placed: Where the polygons of implicit geometries are set down.
        num_characters: Total length of the texts, to know when to read the numbers.
    """

    texts: list[str] = field(default_factory=list)
    dimensions: dict[int, int] = field(default_factory=dict)
    solid_rings: list[int] = field(default_factory=list)
    ring_counts: list[int] = field(default_factory=list)
    owners: list[tuple[int, int, int, int]] = field(default_factory=list)
    flipped: list[int] = field(default_factory=list)
    copies: list[tuple[int, int, int, int, bool, Placement | None]] = field(default_factory=list)
    placed: dict[int, Placement] = field(default_factory=dict)
    num_characters: int = 0


@dataclass(slots=True)
class NameTable:
    """Names in the order they are first met: levels of detail, reference systems."""

    names: list[str | None] = field(default_factory=list)

    def index(self, name: str | None) -> int:
        """Returns the number of a name, a new one where it is new."""
        if name not in self.names:
            self.names.append(name)
        return self.names.index(name)
