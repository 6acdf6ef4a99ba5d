"""From the tree of one city object to rings of text: what stands where, before any number is read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import GEOMETRY_EMPTY, GEOMETRY_UNSUPPORTED
from lodbench.citymodel.coordinates import parse_rings
from lodbench.citymodel.crs import is_in_degrees
from lodbench.citymodel.gml.context import (
    buildings_inside,
    extension_above,
    gml_id,
    is_another_s,
    is_in_ring,
    linked_objects,
    owner_of,
    plain_numbers,
    relief_lod,
    surface_kind,
)
from lodbench.citymodel.gml.names import (
    CURVE,
    GML_IDS,
    NESTED_TYPES,
    NOTHING,
    NUMBERS,
    ORIENTABLE,
    POLYGON,
    POLYGONS,
    REFERENCE,
    RELIEF_SURFACE,
    RING,
    STOREYS,
    TUPLES,
    WALKED,
    WALKED_IN_BUILDINGS,
    XLINK_HREF,
    NodeTable,
    is_building_tag,
    is_extension,
    property_lod,
)
from lodbench.citymodel.gml.xml import Element, local_name
from lodbench.citymodel.lifespans import NAMES, Lifespans
from lodbench.citymodel.model import SurfaceKind
from lodbench.errors import CityModelError
from lodbench.findings import Findings


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """Where a shape is set down.

    Attributes:
        matrix: (3, 4) from the shape's frame to metres around the anchor.
        anchor: (3,) in the coordinates of the file.
    """

    matrix: NDArray[np.float64]
    anchor: NDArray[np.float64]

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
    return parse_rings([text])[0]


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


_INTERIOR = int(SurfaceKind.INTERIOR)
_DAYS = tuple("{*}" + name for name in NAMES)


class GeometryWalk:
    """Collects the polygons of buildings into a batch.

    Attributes:
        batch: The polygons since the batch was last replaced.
        lods: Levels of detail met.
        srs_names: Reference systems met.
        polygon_ids: gml:id to polygon of the current member.
        first_polygon: Number of the current member's first polygon.
        properties: Geometry properties of the current member, in the order of their polygons.
        references: XLinks of the current member.
        duplicate_ids: Polygon ids met twice in the current member.
        default_srs: Reference system of the current building.
        part: City object that the polygons met next belong to.
        left_out: Elements of the current member that are no part of the building around them.
        extensions: Objects that extensions (ADE) hang on buildings, by name.
    """

    def __init__(self, findings: Findings, lifespans: Lifespans) -> None:
        self.batch = PolygonBatch()
        self.lods = NameTable()
        self.srs_names = NameTable()
        self.polygon_ids: dict[str, int] = {}
        self.first_polygon = 0
        self.properties: list[Element] = []
        self.references: list[Reference] = []
        self.duplicate_ids: set[str] = set()
        self.default_srs = 0
        self.part = 0
        self.left_out: set[Element] = set()
        self.extensions: Counter[str] = Counter()
        self._findings, self._lifespans = findings, lifespans
        self._nodes = NodeTable()
        self._turned: set[Element] = set()
        self._systems: dict[Element, int] = {}

    def begin_member(self) -> None:
        """Forgets the ids and references of the member before."""
        self.polygon_ids.clear()
        self.references.clear()
        self.first_polygon = len(self.batch.owners)

    def end_member(self) -> None:
        """Lets go of the elements of a member, or freeing it would have to keep theirs."""
        self.properties.clear()
        self.left_out.clear()

    def take_batch(self) -> PolygonBatch:
        """Returns what was collected and begins anew; call between members only."""
        batch, self.batch = self.batch, PolygonBatch()
        return batch

    def walk_building(
        self,
        element: Element,
        building: int,
        building_id: str,
        srs_name: str | None,
        own: int,
        add_nested: Callable[[Element, dict[Element, int]], int],
    ) -> dict[Element, int]:
        """Adds every polygon of a building, its parts, surfaces, openings and installations.

        Args:
            element: The building, or an object of another kind.
            building: Its number.
            building_id: Its id, for the findings.
            srs_name: Reference system of its coordinates.
            own: Its number among the city objects.
            add_nested: Called with each city object inside of it and the numbers of those before; returns
                its number.

        Returns:
            The numbers of the city objects inside of it, by element.
        """
        srs = self.default_srs = self.srs_names.index(srs_name)
        part_of: dict[Element, int] = {}
        left_out = buildings_inside(element)
        self.left_out |= left_out
        first, first_reference = len(self.batch.owners), len(self.references)
        # One pass for objects and geometry: an object comes before what is in it.
        for prop in element.iter(*(WALKED_IN_BUILDINGS if is_building_tag(element.tag) else WALKED)):
            if self._is_another_s(prop, element):
                continue
            lod_name = property_lod(prop.tag)
            if lod_name is None:
                name = local_name(prop.tag)
                if name in NESTED_TYPES and self._stands_or_is_left_out(prop):
                    part_of[prop] = add_nested(prop, part_of)
                if name != RELIEF_SURFACE:
                    continue
                lod_name = relief_lod(prop)
            lod = self.lods.index(lod_name)
            kind = surface_kind(prop, element)
            self.part = owner_of(prop, element, part_of, own) if part_of else own
            name = local_name(prop.tag)
            if name.endswith("ImplicitRepresentation"):
                self._walk_implicit(prop, building, building_id, lod, kind, srs)
            elif not self._walk_property(prop, building, lod, kind, srs):
                self._findings.add(GEOMETRY_EMPTY, building_id, name)
        for prop in linked_objects(element):
            if is_extension(prop.tag) or is_another_s(prop, element, self.left_out):
                continue
            part = owner_of(prop, element, part_of, own)
            # A door that two rooms share is inside from both.
            kind = surface_kind(prop, element)
            self.references.append(Reference(prop.get(XLINK_HREF, ""), building, -1, kind, False, None, part))
        self._leave_out_storeys(element, part_of, first, first_reference)
        return part_of

    def _is_another_s(self, node: Element, building: Element) -> bool:
        """Tells whether something is no part of a building; objects of extensions are counted, once each."""
        is_other = is_another_s(node, building, self.left_out)
        prop = extension_above(node, building) if is_other else None
        if prop is not None and prop not in self.left_out:
            self.left_out.add(prop)
            self.extensions.update(local_name(child.tag) for child in prop.iterchildren("*"))
        return is_other

    def _stands_or_is_left_out(self, element: Element) -> bool:
        if not self.stands(element):
            self.left_out.add(element)
        return element not in self.left_out

    def stands(self, element: Element) -> bool:
        """Tells whether a city object stands at the date that counts; one that does not is a finding."""
        dates = {local_name(child.tag): child.text or "" for child in element.iterchildren(*_DAYS)}
        return not dates or self._lifespans.stands(gml_id(element) or local_name(element.tag), dates)

    def _leave_out_storeys(
        self, building: Element, part_of: dict[Element, int], first: int, first_reference: int
    ) -> None:
        """Makes surfaces of storeys and units interior ones at the levels at which their building has others.

        Args:
            building: Their building.
            part_of: Numbers of the objects in it.
            first: Its first polygon.
            first_reference: And its first reference.
        """
        storeys: set[int] = set()
        for element, number in part_of.items():  # what is around an object comes before it
            if local_name(element.tag) in STOREYS or owner_of(element, building, part_of, -1) in storeys:
                storeys.add(number)
        if not storeys:
            return
        owners, references = self.batch.owners, self.references
        outside = {
            lod for _, lod, kind, _, part in owners[first:] if part not in storeys and kind != _INTERIOR
        }
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

    def _walk_property(self, prop: Element, building: int, lod: int, kind: int, srs: int) -> bool:
        """Adds the polygons and references of one geometry property; tells whether there were any."""
        href = prop.get(XLINK_HREF)
        if href is not None:
            self.references.append(Reference(href, building, lod, kind, False, None, self.part))
        if len(prop) == 0:
            return href is not None
        self.properties.append(prop)
        srs, dimension = self._declared(prop[0], srs, 0)
        first, first_reference = len(self.batch.owners), len(self.references)
        self.walk_geometry(prop, building, lod, kind, srs, dimension)
        return len(self.batch.owners) > first or len(self.references) > first_reference

    def _walk_implicit(
        self, prop: Element, building: int, building_id: str, lod: int, kind: int, srs: int
    ) -> None:
        """Adds the polygons of an implicit geometry, which are set down when their numbers are read."""
        placement = read_placement(prop[0]) if len(prop) else None
        for point in prop[0].iterfind("{*}referencePoint//*[@srsName]") if len(prop) else ():
            srs = self.srs_names.index(point.get("srsName", "").strip())
        fault = ""
        if placement is None:
            fault = "an incomplete placement"
        elif prop[0].find("{*}libraryObject") is not None:
            fault = "a shape in another file"
        elif is_in_degrees(self.srs_names.names[srs]):
            fault = "a shape in metres at a place in degrees"
        if placement is None or fault:
            self._findings.add(GEOMETRY_UNSUPPORTED, building_id, f"{local_name(prop.tag)}: {fault}")
            return
        first = len(self.batch.owners)
        self.properties.append(prop)
        for shape in prop[0].iterchildren("{*}relativeGMLGeometry", "{*}relativeGeometry"):
            href = shape.get(XLINK_HREF)
            if href is not None:
                self.references.append(Reference(href, building, lod, kind, False, placement, self.part))
            self.walk_geometry(shape, building, lod, kind, srs, 3)
        owners = self.batch.owners
        for polygon in range(first, len(owners)):
            self.batch.placed[polygon] = placement
            owners[polygon] = (building, lod, kind, srs, self.part)  # of the place, whatever its shape says

    def _declared(self, element: Element, srs: int, dimension: int) -> tuple[int, int]:
        """Returns reference system and dimension as an element declares them, else as inherited."""
        name = element.get("srsName")
        text = element.get("srsDimension")
        if name is not None:
            srs = self.srs_names.index(name.strip())
        if text is not None and text.strip() in ("2", "3"):
            dimension = int(text)
        return srs, dimension

    def walk_geometry(  # noqa: C901 - one dispatch per element kind; this loop is the reader's hot path
        self, root: Element, building: int, lod: int, kind: int, srs: int, dimension: int
    ) -> None:
        """Adds the polygons and references below an element, in document order."""
        batch, nodes, part = self.batch, self._nodes, self.part
        texts, ring_counts = batch.texts, batch.ring_counts
        is_new_ring, is_in_polygon = True, False
        ring_dimension = dimension
        # Without a tag filter: setting one up costs more than passing by the few other elements.
        for element in root.iter():
            node = nodes[element.tag]
            if node == NUMBERS or node == TUPLES:
                if not is_in_polygon:
                    continue
                text = (element.text or "") if node == NUMBERS else plain_numbers(element)
                if is_new_ring:
                    texts.append(text)
                    ring_counts[-1] += 1
                    is_new_ring = False
                else:
                    texts[-1] += " " + text
                batch.num_characters += len(text)
                if element.get("srsName"):
                    self._note_system(element)
                declared = element.get("srsDimension")
                if declared == "3":
                    batch.solid_rings.append(len(texts) - 1)
                elif ring_dimension or declared is not None:
                    self._note_dimension(len(texts) - 1, declared, ring_dimension)
            elif node == NOTHING:
                if element.get("srsName"):
                    self._note_system(element)
            elif node == RING:
                is_new_ring = True
                if len(element) == 0:
                    self._note_reference(element, building, lod, kind)
            elif node == REFERENCE:
                if len(element) == 0:
                    self._note_reference(element, building, lod, kind)
            elif node == POLYGON:
                polygon_srs, ring_dimension = self._systems.get(element, srs), dimension
                attributes = element.items()
                if attributes:
                    polygon_srs, ring_dimension = self._read_attributes(attributes, polygon_srs, dimension)
                if self._turned and element in self._turned:
                    batch.flipped.append(len(ring_counts))
                ring_counts.append(0)
                batch.owners.append((building, lod, kind, polygon_srs, part))
                is_new_ring, is_in_polygon = True, True
            elif node == ORIENTABLE:
                self._note_orientation(element)
            elif node == CURVE:
                is_in_polygon = is_in_polygon and is_in_ring(element)
        if self._turned:
            self._turned.clear()
        self._systems.clear()

    def _note_system(self, element: Element) -> None:
        """Notes the reference system that an element inside of a geometry declares for what is in it."""
        srs = self.srs_names.index(element.get("srsName", "").strip())
        below = list(element.iter(*POLYGONS))
        self._systems.update(dict.fromkeys(below, srs))
        if not below and next(element.iterancestors(*POLYGONS), None) is not None:  # a ring, or its numbers
            building, lod, kind, _, part = self.batch.owners[-1]
            self.batch.owners[-1] = (building, lod, kind, srs, part)

    def _read_attributes(
        self, attributes: Sequence[tuple[Any, Any]], srs: int, dimension: int
    ) -> tuple[int, int]:
        """Notes the id of the polygon that comes next; returns its reference system and dimension."""
        for name, value in attributes:
            if name in GML_IDS:
                if value in self.polygon_ids:
                    self.duplicate_ids.add(value)
                else:
                    self.polygon_ids[value] = len(self.batch.ring_counts)
            elif name == "srsName":
                srs = self.srs_names.index(value.strip())
            elif name == "srsDimension" and value.strip() in ("2", "3"):
                dimension = int(value)
        return srs, dimension

    def _note_dimension(self, ring: int, declared: str | None, inherited: int) -> None:
        text = (declared or "").strip()
        self.batch.dimensions[ring] = int(text) if text in ("2", "3") else inherited

    def _note_reference(self, element: Element, building: int, lod: int, kind: int) -> None:
        href = element.get(XLINK_HREF)
        if href is not None:
            is_flipped = self._turned and element in self._turned
            reference = Reference(href, building, lod, kind, bool(is_flipped), None, self.part)
            self.references.append(reference)

    def _note_orientation(self, element: Element) -> None:
        """Marks what stands below an ``OrientableSurface`` of orientation "-"; twice is not at all."""
        if element.get("orientation", "+").strip() == "-":
            self._turned ^= set(element.iter(*POLYGONS, "{*}baseSurface"))
