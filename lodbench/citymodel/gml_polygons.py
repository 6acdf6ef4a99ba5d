"""What the walk over a city object collects: polygons as text, and references between them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from lodbench.citymodel.gml_implicit import Placement
from lodbench.errors import CityModelError

# Japan has 19 plane zones, and a name that nobody knows costs PROJ half a second.
_MAX_NAMES = 32


class Reference(NamedTuple):
    """An XLink met inside a geometry property: the id it names, and whose surface it stands for.

    One to a whole boundary surface or part has the level -1: its surfaces keep their own levels and kinds.
    """

    href: str
    building: int
    lod: int
    kind: int
    is_flipped: bool
    placement: Placement | None
    part: int


@dataclass(slots=True)
class PolygonBatch:
    """Polygons of many city objects as text, in document order.

    Attributes:
        texts: One text of numbers per ring.
        dimensions: Ring index to declared dimension, for the rings that declare one.
        solid_rings: Rings that declare three dimensions themselves, which most files do, or none.
        ring_counts: Rings of each polygon.
        owners: (building, lod, kind, srs, part) of each polygon.
        flipped: Polygons whose orientation is turned round.
        copies: Polygons that repeat an earlier one: source polygon, building, lod, kind, flipped,
            placement, part.
        placed: Where the polygons of implicit geometries are set down.
        num_characters: Total length of the texts, to know when to read the numbers.
    """

    texts: list[str] = field(default_factory=list)
    dimensions: dict[int, int] = field(default_factory=dict)
    solid_rings: list[int] = field(default_factory=list)
    ring_counts: list[int] = field(default_factory=list)
    owners: list[tuple[int, int, int, int, int]] = field(default_factory=list)
    flipped: list[int] = field(default_factory=list)
    copies: list[tuple[int, int, int, int, bool, Placement | None, int]] = field(default_factory=list)
    placed: dict[int, Placement] = field(default_factory=dict)
    num_characters: int = 0


@dataclass(slots=True)
class NameTable:
    """Names in the order they are first met: levels of detail, reference systems."""

    _numbers: dict[str | None, int] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str | None, ...]:
        """All names, by number."""
        return tuple(self._numbers)

    def index(self, name: str | None) -> int:
        """Returns the number of a name, a new one where it is new.

        Raises:
            CityModelError: There are more names than any city has.
        """
        known = self._numbers.get(name)
        if known is not None:
            return known
        number = self._numbers[name] = len(self._numbers)
        if number >= _MAX_NAMES:
            raise CityModelError(
                f"The file declares more than {_MAX_NAMES} reference systems.",
                "A city has one: correct the file.",
            )
        return number
