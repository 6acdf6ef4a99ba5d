"""Houses: alone, in pairs and in rows with gardens along streets; wall to wall around closed blocks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lodbench.synthesis.town import shapes
from lodbench.synthesis.town.buildings import (
    Detail,
    Plan,
    annex,
    chance,
    dormers,
    eaves,
    house_roof,
    lift_houses,
    town_roof,
)
from lodbench.synthesis.town.roofs import Roof, Strip, flat, gabled, hipped, mansard, serrated
from lodbench.synthesis.town.shapes import Points, left_of


class Site:
    """The land of one block inside its building line, (N, 2), the plans placed on it, and their chances."""

    def __init__(self, ring: Points, district: str, chances: np.random.Generator) -> None:
        self.ring, self.district, self.chances = ring, district, chances
        self.along, _, _ = shapes.box_of(
            ring
        )  # (2,) unit, along the longer side of the smallest box around it
        self.plans: list[Plan] = []  # what was placed, in order
        self._pieces = np.empty((0, 4, 2))

    def place(
        self,
        strip: Strip,
        roof: Roof,
        function: str = "residential",
        details: Sequence[Detail] = (),
        *,
        gap_m: float = 0.0,
        yard: Points | None = None,
        on_line: bool = False,
    ) -> bool:
        """Places a building inside the building line, a gap from all others; returns whether there was room.

        A gap of 0 lets walls touch. What is laid out along the building line need not be tested against it;
        with a ``yard``, (N, 2), it must lie inside of that part of the block.
        """
        plan = Plan(strip, roof, function, self.district, tuple(details))
        ring, pieces = self.ring if yard is None else yard, plan.pieces
        # Corners and edge middles are enough to test against a nearly convex ring.
        outlines = [np.concatenate([piece, 0.5 * (piece + np.roll(piece, -1, axis=0))]) for piece in pieces]
        if not on_line and not all(shapes.contains(ring, outline).all() for outline in outlines):
            return False
        if not all(self._is_free(piece, gap_m) for piece in pieces):
            return False
        self.plans.append(plan)
        self._pieces = np.concatenate([self._pieces, pieces])
        return True

    def _is_free(self, piece: Points, gap_m: float) -> bool:
        """Returns whether a convex piece keeps a gap to all that stands; of most, circles around tell."""
        pieces = np.concatenate([[piece], self._pieces])
        middles = pieces.mean(axis=1)
        radii = np.linalg.norm(pieces - middles[:, None], axis=2).max(axis=1)
        distance = np.linalg.norm(middles - middles[0], axis=1)
        near = np.flatnonzero(distance[1:] < radii[1:] + radii[0] + gap_m)
        return all(shapes.keeps_apart(piece, self._pieces[k], gap_m) for k in near)

    def places(self, spacing_m: float) -> list[Points]:
        """Returns places to try, in random order: a jittered grid along its own directions."""
        axes = np.stack([self.along, left_of(self.along)])
        spans = self.ring @ axes.T
        steps = [
            np.arange(low + 1.0, high, spacing_m)
            for low, high in zip(spans.min(axis=0), spans.max(axis=0), strict=True)
        ]
        grid = np.stack([axis.ravel() for axis in np.meshgrid(*steps)], axis=1)
        grid += self.chances.uniform(0.0, 4.0, size=grid.shape)
        return list(self.chances.permutation(grid) @ axes)


class Style(NamedTuple):
    """How a street of houses is built up."""

    grow: float  # size of the houses against small ones
    storeys: tuple[int, int]  # least and greatest number of storeys
    gap_m: tuple[float, float]  # least and greatest distance between houses along the street
    setback_m: float  # greatest depth of the front garden
    rows: float  # share of terraces among what is built
    garages: float  # share of houses with a garage


SUBURB = Style(1.05, (1, 2), (6.0, 14.0), 4.5, 0.2, 0.22)
VILLAS = Style(1.35, (2, 3), (5.0, 11.0), 4.0, 0.15, 0.3)
OLD_LANES = Style(1.15, (2, 3), (0.8, 3.5), 1.2, 0.7, 0.1)


def add_houses(site: Site, style: Style) -> None:
    """Adds houses on every side of a block."""
    ring = site.ring
    for start, along, length in zip(
        ring, shapes.edge_directions(ring), shapes.edge_lengths(ring).tolist(), strict=True
    ):
        _add_street(site, style, start, along, length)


def _add_street(site: Site, style: Style, start: Points, along: Points, length: float) -> None:
    """Adds houses from one corner of the block to the next; streets like either rows or houses."""
    chances = site.chances
    at = float(chances.uniform(1.0, 5.0))
    rows = style.rows * float(chances.choice([0.2, 2.0]))
    while at < length - 8.0:
        setback = float(chances.uniform(0.2, style.setback_m))
        corner = start + along * at + left_of(along) * setback
        if chance(chances, rows):
            at += _add_terrace(site, style, corner, along, length - at)
        else:
            at += _add_house(site, style, corner, along)
        at += float(chances.uniform(*style.gap_m))


def _add_house(site: Site, style: Style, corner: Points, along: Points) -> float:
    """Adds a house and perhaps its garage; returns the length of street it takes, metres."""
    chances, gap_m = site.chances, min(3.0, style.gap_m[0])
    length, depth = (style.grow * chances.uniform((9.5, 8.0), (14.0, 10.5))).tolist()
    strip = _house_strip(corner, along, length, depth, chances)
    storeys = int(chances.integers(*style.storeys, endpoint=True))
    roof = house_roof(eaves(storeys, chances), strip, chances)
    details: list[Detail] = dormers(strip, roof, chances) if chance(chances, 0.35) else []
    if len(strip.wings) == 1 and chance(chances, 0.4):
        _, _, wall, _ = strip.first_wing
        details += annex(wall, roof.eave_m, chances)
    placed = site.place(strip, roof, details=details, gap_m=gap_m) or site.place(strip, roof, gap_m=gap_m)
    if placed and chance(chances, style.garages):
        _add_garage(site, corner + along * (length + 1.0), along)
    return float(length)


def _house_strip(
    corner: Points, along: Points, length: float, depth: float, generator: np.random.Generator
) -> Strip:
    """Returns the plan of a house: a bar along or across the street, a square, or an L."""
    draw, inward = float(generator.random()), left_of(along)
    if draw < 0.18:
        wing, turn = 0.55 * depth + 1.0, corner + along * length
        return Strip.bent(np.stack([corner, turn, turn + inward * (depth + 2.0)]), [wing, wing])
    if draw < 0.28:
        return Strip.bar(corner, along, depth, depth)
    if draw < 0.5:
        return Strip.bar(corner + along * depth, inward, length, depth)
    return Strip.bar(corner, along, length, depth)


def _add_garage(site: Site, corner: Points, along: Points) -> None:
    """Adds a garage or shed beside or behind a house where there is room."""
    chances = site.chances
    width, depth = chances.uniform((3.0, 5.5), (6.0, 7.5)).tolist()
    height = float(chances.uniform(2.4, 3.0))
    roof = flat(height) if chance(chances, 0.7) else gabled(height, 30.0, depth)
    back = left_of(along) * float(chances.uniform(3.0, 14.0))
    site.place(Strip.bar(corner + back, along, width, depth), roof, "garage", gap_m=0.6)


def _add_terrace(site: Site, style: Style, corner: Points, along: Points, room: float) -> float:
    """Adds a row of like houses, every other one set back a little; returns its length, metres."""
    chances = site.chances
    width, depth = chances.uniform((6.2, 9.5), (8.5, 11.5)).tolist()
    count = min(int(chances.integers(2, 7)), int(room / width))
    eave, pitch = eaves(style.storeys[1], chances), float(chances.uniform(32, 42))
    step, rise = chances.uniform((0.0, -0.4), (1.2, 0.4)).tolist()
    for k in range(count):
        back = left_of(along) * (step if k % 2 else 0.0)
        strip = Strip.bar(corner + along * (k * width) + back, along, width, depth)
        details = annex(width, eave, chances) if chance(chances, 0.4) else []
        # The row's own houses touch; the first keeps its distance from whatever stood there.
        gap_m = min(3.0, style.gap_m[0]) if k == 0 else 0.0
        if not site.place(strip, gabled(eave + k * rise, pitch, depth), details=details, gap_m=gap_m):
            return float(max(k, 1) * width)
    return float(max(count, 1) * width)


# Courtyards are at least this wide between the back walls.
COURTYARD_M = 9.0
# Sharper corners than this make no rooms.
_LEAST_CORNER_DEG = 47.0
# A stretch of street shorter than this goes to the corner houses beside it.
_LEAST_ROW_M = 8.0


def add_closed_block(site: Site, storeys: int) -> None:
    """Adds row houses of some storeys all around, or nothing where the block's shape leaves no courtyard."""
    depth = float(site.chances.uniform(10.5, 13.0))
    if shapes.inset(site.ring, depth + COURTYARD_M / 2) is None:
        return
    legs = _corner_legs(site.ring, depth, site.chances)
    if legs is not None:
        block = _ClosedBlock(site, depth, storeys, legs)
        block.add_corner_houses()
        block.add_rows()
        block.add_yard_buildings()


def _corner_legs(ring: Points, depth: float, generator: np.random.Generator) -> Points | None:
    """Returns how far each corner house reaches back and ahead, (N, 2) metres, or None without room."""
    count, angles, lengths = len(ring), shapes.corner_angles_deg(ring), shapes.edge_lengths(ring)
    if angles.min() < _LEAST_CORNER_DEG:
        return None
    least = np.maximum(depth / np.tan(np.radians(angles) / 2), 0.0) + 2.5
    legs = least[:, None] + generator.uniform(1.5, 5.0, size=(count, 2))
    for k in range(count):
        m = (k + 1) % count
        if lengths[k] - legs[k, 1] - legs[m, 0] >= _LEAST_ROW_M:
            continue
        spare = lengths[k] - least[k] - least[m]
        if spare < 0:
            return None
        legs[k, 1], legs[m, 0] = least[k] + spare / 2, lengths[k] - least[k] - spare / 2
    return legs


class _ClosedBlock(NamedTuple):
    """A block while its houses are placed."""

    site: Site  # the block
    depth: float  # of its houses, metres
    storeys: int  # usual number of storeys
    legs: Points  # (N, 2) how far each corner house reaches back and ahead, metres

    def add_corner_houses(self) -> None:
        """Adds a house with two wings at every corner."""
        along, chances = shapes.edge_directions(self.site.ring), self.site.chances
        for k, corner in enumerate(self.site.ring):
            line = [corner - along[k - 1] * self.legs[k, 0], corner, corner + along[k] * self.legs[k, 1]]
            eave = eaves(self.storeys + chance(chances, 0.3), chances)
            roof = gabled(eave, float(chances.uniform(36, 48)), self.depth)
            self._place(Strip.bent(np.stack(line), [self.depth, self.depth]), roof)

    def add_rows(self) -> None:
        """Shares the streets between the corner houses out among houses that touch, with rare gaps."""
        ring, chances = self.site.ring, self.site.chances
        free = shapes.edge_lengths(ring) - self.legs[:, 1] - np.roll(self.legs[:, 0], -1)
        for k in np.flatnonzero(free >= _LEAST_ROW_M / 2):
            along = shapes.edge_directions(ring)[k]
            count = max(1, round(free[k] / chances.uniform(11.0, 16.0)))
            shares = chances.uniform(0.7, 1.3, size=count)
            edges = self.legs[k, 1] + np.concatenate([[0.0], np.cumsum(shares / shares.sum())]) * free[k]
            for left, width in zip(edges[:-1], np.diff(edges), strict=True):
                if not chance(chances, 0.06):
                    self._add_row_house(ring[k] + along * left, along, float(width))

    def _add_row_house(self, corner: Points, along: Points, width: float) -> None:
        """Adds one house of a row; some narrow old ones turn their gable to the street."""
        chances, is_old = self.site.chances, self.site.district == "old town"
        depth = self.depth + float(chances.uniform(-2.0, 1.2))
        eave = eaves(max(2, self.storeys + int(chances.integers(-1, 2))), chances)
        if is_old and width < depth and chance(chances, 0.3):
            strip = Strip.bar(corner + along * width, left_of(along), depth, width)
            self._place(strip, gabled(eave, float(chances.uniform(42, 54)), width))
            return
        roof = town_roof(eave, depth, chances, modern=0.05 if is_old else 0.2)
        extension = annex(width, eave, chances) if width > 8.0 and chance(chances, 0.45) else []
        self._place(Strip.bar(corner, along, width, depth), roof, extension)

    def _place(self, strip: Strip, roof: Roof, extension: Sequence[Detail] = ()) -> None:
        """Places a house, perhaps with dormers; without its extension where that has no room."""
        windows = dormers(strip, roof, self.site.chances) if chance(self.site.chances, 0.55) else []
        if not self.site.place(strip, roof, details=[*windows, *extension], on_line=True):
            self.site.place(strip, roof, details=windows, on_line=True)

    def add_yard_buildings(self) -> None:
        """Adds workshops and sheds to the courtyard."""
        site, chances = self.site, self.site.chances
        yard = shapes.inset(site.ring, self.depth + 3.0)
        if yard is None:
            return
        for _ in range(int(shapes.area(yard) / 260.0) + 1):
            corner = chances.uniform(yard.min(axis=0), yard.max(axis=0))
            length, width = chances.uniform((5.0, 4.0), (13.0, 7.0)).tolist()
            height = float(chances.uniform(2.8, 5.5))
            roof = flat(height) if chance(chances, 0.6) else gabled(height, 28.0, width)
            strip = Strip.bar(corner, site.along, length, width)
            site.place(strip, roof, "commercial", gap_m=1.2, yard=yard)


def add_church(site: Site) -> bool:
    """Adds a church with its tower; returns whether the square had room for both."""
    chances, along = site.chances, site.along
    middle = 0.5 * (site.ring.min(axis=0) + site.ring.max(axis=0))
    length, width, side = float(chances.uniform(28, 38)), float(chances.uniform(13, 16)), 8.0
    corner = middle - along * (length - side) / 2 - left_of(along) * width / 2
    nave = hipped(float(chances.uniform(11, 14)), 52.0, width, length, (False, True))
    spire = Roof("pavilion", ((0.0, 30.0), (0.5, 48.0), (1.0, 30.0)), (side / 2, side / 2))
    tower = Strip.bar(corner - along * side + left_of(along) * (width - side) / 2, along, side, side)
    return site.place(Strip.bar(corner, along, length, width), nave, "church") and site.place(
        tower, spire, "church"
    )


def add_town_hall(site: Site) -> None:
    """Adds the town hall at one side of the market square, the rest left open."""
    lengths = shapes.edge_lengths(site.ring)
    k = int(np.argmax(lengths))
    along, length, depth = shapes.edge_directions(site.ring)[k], float(min(34.0, 0.6 * lengths[k])), 15.0
    corner = site.ring[k] + along * (lengths[k] - length) / 2 + left_of(along) * 2.0
    strip, roof = Strip.bar(corner, along, length, depth), mansard(11.0, depth)
    site.place(strip, roof, "public", dormers(strip, roof, site.chances))


def add_courtyard_house(site: Site) -> None:
    """Adds one building around a courtyard (a convent, a court of justice), or nothing without room."""
    depth = float(site.chances.uniform(11.0, 13.5))
    if len(site.ring) > 6 or shapes.inset(site.ring, depth + COURTYARD_M / 2) is None:
        return
    strip = Strip.bent(site.ring, [depth] * len(site.ring), closed=True)
    roof = gabled(eaves(3, site.chances), float(site.chances.uniform(32, 42)), depth)
    site.place(strip, roof, "public", dormers(strip, roof, site.chances), on_line=True)


def add_school(site: Site) -> None:
    """Adds a school with two or three wings around a yard, or nothing without room."""
    chances = site.chances
    along, *size = shapes.box_of(site.ring)
    wings, depth = chances.uniform(0.45, 0.6, size=2) * size, 13.0
    if wings.min() < 2 * depth + 4:
        return
    inward = left_of(along)
    for corner in site.places(6.0):
        turn = corner + along * wings[0]
        line = [corner, turn, turn + inward * wings[1]]
        if chance(chances, 0.6):
            line.insert(0, corner + inward * wings[1] * float(chances.uniform(0.7, 1.0)))
        strip = Strip.bent(np.stack(line), [depth] * (len(line) - 1))
        if site.place(strip, gabled(eaves(3, chances), float(chances.uniform(25, 38)), depth), "public"):
            return


def add_pavilion(site: Site) -> None:
    """Adds a pavilion in the green."""
    corner = 0.5 * (site.ring.min(axis=0) + site.ring.max(axis=0)) - 4.0
    strip = Strip.bar(corner, np.array([1.0, 0.0]), 8.0, 8.0)
    site.place(strip, hipped(3.2, 25.0, 8.0, 8.0), "public")


def add_flats(site: Site) -> None:
    """Adds slabs and towers of flats, all turned the same way."""
    chances = site.chances
    for corner in site.places(20.0):
        tower = chance(chances, 0.3)
        sizes = ((18.0, 18.0), (24.0, 24.0)) if tower else ((38.0, 11.0), (64.0, 13.0))
        length, depth = chances.uniform(*sizes).tolist()
        storeys = int(chances.integers(9, 16) if tower else chances.integers(4, 8))
        strip, roof = Strip.bar(corner, site.along, length, depth), flat(eaves(storeys, chances))
        details = lift_houses(strip, roof, 1 if tower else 2, chances)
        site.place(strip, roof, details=details, gap_m=13.0)


def add_works(site: Site) -> None:
    """Adds halls, and an office or two."""
    chances = site.chances
    for k, corner in enumerate(site.places(16.0)):
        office = k % 4 == 3
        sizes = ((14.0, 9.0), (24.0, 14.0)) if office else ((26.0, 18.0), (70.0, 38.0))
        length, depth = chances.uniform(*sizes).tolist()
        strip = Strip.bar(corner, site.along, length, depth)
        roof = flat(eaves(3, chances)) if office else _hall_roof(depth, chances)
        details = lift_houses(strip, roof, 1, chances) if roof.name == "flat" else []
        site.place(strip, roof, "commercial" if office else "industrial", details, gap_m=7.0)


def _hall_roof(depth: float, generator: np.random.Generator) -> Roof:
    """Returns a flat, low gabled or serrated roof."""
    eave, draw = float(generator.uniform(6.0, 11.0)), float(generator.random())
    if draw < 0.45:
        return flat(eave)
    return gabled(eave, 12.0, depth) if draw < 0.75 else serrated(eave, 2.2, max(2, round(depth / 8)))
