"""Polygons of many members as text, and from there to arrays: one parse for thousands of rings."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import BAD_COORDINATE, BAD_COUNT, RING_2D
from lodbench.citymodel.gml.folding import FoldedRings, parse_rings
from lodbench.citymodel.gml.xml import Element, NotFolded, local_name
from lodbench.citymodel.model import SurfaceKind, starts_of, take_segments
from lodbench.errors import CityModelError
from lodbench.findings import FindingCode, Findings


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """Where a shape is set down."""

    matrix: NDArray[np.float64]  # (3, 4) from the shape's frame to metres around the anchor
    anchor: NDArray[np.float64]  # (3,) in the coordinates of the file

    def apply(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns points (N, 3) of the shape in the coordinates of the file."""
        placed: NDArray[np.float64] = points @ self.matrix[:, :3].T + self.matrix[:, 3] + self.anchor
        return placed


def read_placement(geometry: Element) -> Placement | None:
    """Returns the placement of an ``ImplicitGeometry``, or None where it is incomplete or malformed.

    The matrix is 4x4, row by row, the identity where it is left out; the anchor must be there.
    """
    matrix, anchor = np.eye(4)[:3], None
    for child in geometry:
        name = local_name(child.tag)
        if name == "transformationMatrix":
            values = _numbers(child.text or "")
            if len(values) != 16:
                return None
            matrix = values.reshape(4, 4)[:3]
        elif name == "referencePoint":
            text = " ".join(pos.text or "" for pos in child.iter("{*}pos", "{*}coordinates"))
            anchor = _numbers(text.replace(",", " "))
    if anchor is None or len(anchor) != 3 or not np.isfinite(matrix).all() or not np.isfinite(anchor).all():
        return None
    return Placement(matrix, anchor)


def _numbers(text: str) -> NDArray[np.float64]:
    return parse_rings([text.encode()])[0]


_INTERIOR = int(SurfaceKind.INTERIOR)
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


Owner = tuple[int, int, int, int, int]


def leave_out(
    storeys: set[int], owners: list[Owner], first: int, references: list[Reference], first_reference: int
) -> None:
    """Makes surfaces of storeys and units interior ones at the levels at which their building has others.

    Args:
        storeys: Numbers of the storeys.
        owners: Those of ``PolygonBatch``.
        first: The building's first polygon.
        references: Those of all polygons.
        first_reference: The building's first.
    """
    outside = {lod for _, lod, kind, _, part in owners[first:] if part not in storeys and kind != _INTERIOR}
    outside |= {
        each.lod
        for each in references[first_reference:]
        if each.part not in storeys and each.kind != _INTERIOR
    }
    for n in range(first, len(owners)):
        number, lod, _, srs, part = owners[n]
        if part in storeys and lod in outside:
            owners[n] = (number, lod, _INTERIOR, srs, part)
    for n in range(first_reference, len(references)):
        if references[n].part in storeys and (
            references[n].lod in outside or (outside and references[n].lod < 0)
        ):
            references[n] = references[n]._replace(kind=_INTERIOR)


@dataclass(slots=True)
class PolygonBatch:
    """Polygons of many city objects as text, in document order."""

    texts: list[bytes] = field(default_factory=list)  # one text of numbers per ring, in UTF-8
    # Ring index to declared dimension, for the rings that declare one
    dimensions: dict[int, int] = field(default_factory=dict)
    # Rings that declare three dimensions themselves, which most files do, or none
    solid_rings: list[int] = field(default_factory=list)
    ring_counts: list[int] = field(default_factory=list)  # rings of each polygon
    owners: list[Owner] = field(default_factory=list)  # (building, lod, kind, srs, part) of each polygon
    flipped: list[int] = field(default_factory=list)  # polygons whose orientation is turned round
    # Polygons that repeat an earlier one: source polygon, building, lod, kind, flipped, placement, part
    copies: list[tuple[int, int, int, int, bool, Placement | None, int]] = field(default_factory=list)
    # Where the polygons of implicit geometries are set down
    placed: dict[int, Placement] = field(default_factory=dict)
    num_characters: int = 0  # total length of the texts, to know when to read the numbers
    is_folded: bool = False  # whether any of the texts never went through a parser

    def add_rings(self, rings: FoldedRings, dimension: int) -> None:
        """Adds polygons of one ring each, whose owners are there; ``dimension`` is that around them, or 0."""
        texts, is_solid = rings
        first = len(self.texts)
        self.is_folded = True
        self.texts += texts
        self.ring_counts += [1] * len(texts)
        self.num_characters += sum(map(len, texts))
        if is_solid:
            self.solid_rings.extend(range(first, len(self.texts)))
        elif dimension:
            self.dimensions.update(dict.fromkeys(range(first, len(self.texts)), dimension))


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


@dataclass(slots=True)
class PolygonArrays:
    """Polygons of one batch; lengths instead of offsets, so that batches concatenate."""

    points: NDArray[np.float64]  # (P, 3) float64 in the coordinates of the file
    ring_lengths: NDArray[np.int32]  # (R,) points per ring
    ring_counts: NDArray[np.int32]  # (N,) rings per polygon
    # (N,) each, as in ``RawCity``
    building: NDArray[np.int32]
    lod: NDArray[np.int16]
    kind: NDArray[np.uint8]
    srs: NDArray[np.int16]
    part: NDArray[np.int32]
    # (N,) number of each polygon among those of the batch, dropped ones included; -1 for copies
    serial: NDArray[np.int64]


def read_batch(
    batch: PolygonBatch, building_ids: list[str], findings: Findings, *, is_strict: bool
) -> PolygonArrays:
    """Returns the polygons of a batch as arrays.

    Args:
        batch: Texts and structure, in document order.
        building_ids: Ids by building number, for messages.
        findings: Receives dropped polygons and rings without heights.
        is_strict: Whether a bad coordinate is an error; else its polygon is dropped with a finding.

    Raises:
        CityModelError: ``is_strict`` and a coordinate is not a finite number, or a count does not
            fit the dimension; the message names the building.
        NotFolded: A coordinate is bad, which may be an entity of XML.
    """
    values, counts, is_bad = parse_rings(batch.texts)
    if batch.is_folded and is_bad.any():
        raise NotFolded("A coordinate is bad.")
    dimensions = np.zeros(len(counts), np.int64)
    dimensions[batch.solid_rings] = 3
    for declared_ring, dimension in batch.dimensions.items():
        dimensions[declared_ring] = dimension
    _settle_dimensions(values, counts, dimensions)
    has_remainder = counts % dimensions != 0
    ring_counts = np.asarray(batch.ring_counts, np.int64)
    building, lod, kind, srs, part = np.fromiter(chain.from_iterable(batch.owners), np.int64).reshape(-1, 5).T
    ring_polygon = np.repeat(np.arange(len(ring_counts)), ring_counts)
    faults: list[tuple[FindingCode, NDArray[np.bool_]]] = [
        (BAD_COORDINATE, is_bad),
        (BAD_COUNT, has_remainder & ~is_bad),
    ]
    for code, is_faulty in faults:
        _report_faults(code, is_faulty, batch, building_ids, ring_polygon, findings, is_strict)
    arrays = PolygonArrays(
        points=_points(values, counts, dimensions),
        ring_lengths=(counts // dimensions).astype(np.int32),
        ring_counts=ring_counts.astype(np.int32),
        building=building.astype(np.int32),
        lod=lod.astype(np.int16),
        kind=kind.astype(np.uint8),
        srs=srs.astype(np.int16),
        part=part.astype(np.int32),
        serial=np.arange(len(building)),
    )
    for ring in np.flatnonzero(dimensions == 2):
        findings.add(RING_2D, building_ids[batch.owners[ring_polygon[ring]][0]])
    _flip(arrays, batch.flipped)
    faulty = np.unique(ring_polygon[is_bad | has_remainder])
    return _select(arrays, batch, faulty)


def _settle_dimensions(
    values: NDArray[np.float64], counts: NDArray[np.int64], dimensions: NDArray[np.int64]
) -> None:
    """Fills in the dimension of rings that declare none: 3, unless only 2 makes the ring closed."""
    starts = starts_of(counts)
    undeclared = np.flatnonzero(dimensions == 0)
    fits_3, fits_2 = counts[undeclared] % 3 == 0, counts[undeclared] % 2 == 0
    dimensions[undeclared] = 3
    unsure = undeclared[fits_2 & (counts[undeclared] >= 6)]
    first, last = starts[unsure], starts[unsure + 1]
    is_closed = [
        np.all([values[first + k] == values[last - size + k] for k in range(size)], axis=0) for size in (2, 3)
    ]
    unsure_fits_3 = counts[unsure] % 3 == 0
    dimensions[unsure[is_closed[0] & ~(is_closed[1] & unsure_fits_3)]] = 2
    # Neither closed nor divisible by three: two is the only reading left.
    dimensions[undeclared[~fits_3 & fits_2]] = 2


def _points(
    values: NDArray[np.float64], counts: NDArray[np.int64], dimensions: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Returns (P, 3) points; rings of two dimensions get z = 0, remainders are left out."""
    if np.all(dimensions == 3) and not np.any(counts % 3):
        return values.reshape(-1, 3)
    lengths = counts // dimensions
    ring = np.repeat(np.arange(len(counts)), lengths)
    within = np.arange(len(ring)) - starts_of(lengths)[ring]
    first = starts_of(counts)[ring] + within * dimensions[ring]
    columns = np.stack([first, first + 1, np.minimum(first + 2, len(values) - 1)], axis=1)
    points: NDArray[np.float64] = values[columns]
    points[dimensions[ring] == 2, 2] = 0.0
    return points


def _report_faults(
    code: FindingCode,
    is_faulty: NDArray[np.bool_],
    batch: PolygonBatch,
    building_ids: list[str],
    ring_polygon: NDArray[np.int64],
    findings: Findings,
    is_strict: bool,
) -> None:
    for ring in np.flatnonzero(is_faulty):
        building_id = building_ids[batch.owners[ring_polygon[ring]][0]]
        words = batch.texts[ring].decode("utf-8", "replace").split()
        excerpt = " ".join(words[:6])
        if is_strict:
            what = (
                "a coordinate that is not a finite number"
                if code is BAD_COORDINATE
                else f"{len(words)} numbers, which do not make points"
            )
            raise CityModelError(
                f"Building {building_id} has a ring with {what} (it begins: {excerpt[:80]}).",
                "Mend the file, or see `lodbench city check FILE` for all such rings.",
            )
        findings.add(code, building_id, excerpt[:80])


def _flip(arrays: PolygonArrays, flipped: list[int]) -> None:
    """Turns the rings of some polygons round, in place."""
    polygon_starts, ring_starts = starts_of(arrays.ring_counts), starts_of(arrays.ring_lengths)
    for polygon in flipped:
        for ring in range(polygon_starts[polygon], polygon_starts[polygon + 1]):
            ring_points = slice(ring_starts[ring], ring_starts[ring + 1])
            arrays.points[ring_points] = arrays.points[ring_points][::-1].copy()


def _select(arrays: PolygonArrays, batch: PolygonBatch, faulty: NDArray[np.int64]) -> PolygonArrays:
    """Drops faulty polygons and appends the copies that references need."""
    if len(faulty) == 0 and not batch.copies and not batch.placed:
        return arrays
    copies = np.asarray([copy[:4] for copy in batch.copies], np.int64).reshape(-1, 4)
    sources = np.concatenate([np.arange(len(arrays.building)), copies[:, 0]])
    chosen = np.flatnonzero(~np.isin(sources, faulty))
    rings, polygon_starts = take_segments(starts_of(arrays.ring_counts), sources[chosen])
    points, ring_starts = take_segments(starts_of(arrays.ring_lengths), rings)
    selected = PolygonArrays(
        points=arrays.points[points],
        ring_lengths=np.diff(ring_starts).astype(np.int32),
        ring_counts=np.diff(polygon_starts).astype(np.int32),
        building=np.concatenate([arrays.building, copies[:, 1].astype(np.int32)])[chosen],
        lod=np.concatenate([arrays.lod, copies[:, 2].astype(np.int16)])[chosen],
        kind=np.concatenate([arrays.kind, copies[:, 3].astype(np.uint8)])[chosen],
        srs=np.concatenate([arrays.srs, arrays.srs[copies[:, 0]]])[chosen],
        part=np.concatenate([arrays.part, [copy[6] for copy in batch.copies]])[chosen].astype(np.int32),
        serial=np.concatenate([arrays.serial, np.full(len(copies), -1)])[chosen],
    )
    is_flipped = np.asarray([False] * len(arrays.building) + [copy[4] for copy in batch.copies])[chosen]
    _flip(selected, np.flatnonzero(is_flipped).tolist())
    placements = [batch.placed.get(polygon) for polygon in range(len(arrays.building))]
    placements += [copy[5] for copy in batch.copies]
    _place(selected, [placements[polygon] for polygon in chosen])
    return selected


def _place(arrays: PolygonArrays, placements: list[Placement | None]) -> None:
    """Sets polygons of implicit geometries down, in place."""
    first_points = starts_of(arrays.ring_lengths)[starts_of(arrays.ring_counts)]
    for polygon, placement in enumerate(placements):
        if placement is not None:
            points = slice(first_points[polygon], first_points[polygon + 1])
            arrays.points[points] = placement.apply(arrays.points[points])
