"""From the tree of one city object to rings of text: what stands where, before any number is read."""

from __future__ import annotations

from dataclasses import dataclass, field

from lodbench.citymodel.codes import GEOMETRY_EMPTY
from lodbench.citymodel.gml_names import (
    GEOMETRY_NODES,
    GEOMETRY_PROPERTIES,
    GML_IDS,
    INTERIOR_NAMES,
    POLYGONS,
    SURFACE_KINDS,
    XLINK_HREF,
    Node,
    NodeTable,
    property_lod,
)
from lodbench.citymodel.model import SurfaceKind
from lodbench.citymodel.xml import Element, local_name
from lodbench.findings import Findings


@dataclass(slots=True)
class Reference:
    """An XLink met inside a geometry property: the id it names, and whose surface it stands for."""

    href: str
    building: int
    lod: int
    kind: int
    is_flipped: bool


@dataclass(slots=True)
class PolygonBatch:
    """Polygons of many city objects as text, in document order.

    Attributes:
        texts: One text of numbers per ring.
        dimensions: Ring index to declared dimension, for the rings that declare one.
        ring_counts: Rings of each polygon.
        building, lod, kind, srs: One entry per polygon.
        flipped: Polygons whose orientation is turned round.
        copies: Polygons that repeat an earlier one: (source polygon, building, lod, kind, flipped).
        num_characters: Total length of the texts, to know when to read the numbers.
    """

    texts: list[str] = field(default_factory=list)
    dimensions: dict[int, int] = field(default_factory=dict)
    ring_counts: list[int] = field(default_factory=list)
    building: list[int] = field(default_factory=list)
    lod: list[int] = field(default_factory=list)
    kind: list[int] = field(default_factory=list)
    srs: list[int] = field(default_factory=list)
    flipped: list[int] = field(default_factory=list)
    copies: list[tuple[int, int, int, int, bool]] = field(default_factory=list)
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


class GeometryWalk:
    """Collects the polygons of buildings into a batch.

    Args:
        findings: Receives what is empty or not understood.

    Attributes:
        batch: The polygons since the batch was last replaced.
        lods: Levels of detail met.
        srs_names: Reference systems met.
        polygon_ids: gml:id to polygon of the current member.
        polygon_elements: The current member's polygons as elements, from ``first_polygon`` on.
        references: XLinks of the current member.
        duplicate_ids: Polygon ids met twice in the current member.
        default_srs: Reference system of the current building.
    """

    def __init__(self, findings: Findings) -> None:
        self.batch = PolygonBatch()
        self.lods = NameTable()
        self.srs_names = NameTable()
        self.polygon_ids: dict[str, int] = {}
        self.polygon_elements: list[Element] = []
        self.first_polygon = 0
        self.references: list[Reference] = []
        self.duplicate_ids: set[str] = set()
        self.default_srs = 0
        self._findings = findings
        self._nodes = NodeTable()
        self._turned: set[Element] = set()

    def begin_member(self) -> None:
        """Forgets the ids and references of the member before."""
        self.polygon_ids.clear()
        self.polygon_elements.clear()
        self.references.clear()
        self.first_polygon = len(self.batch.building)

    def take_batch(self) -> PolygonBatch:
        """Returns what was collected and begins anew; call between members only."""
        batch, self.batch = self.batch, PolygonBatch()
        return batch

    def walk_building(self, element: Element, building: int, building_id: str, srs_name: str | None) -> None:
        """Adds every polygon of a building, its parts, surfaces, openings and installations."""
        srs = self.default_srs = self.srs_names.index(srs_name)
        for prop in element.iter(*GEOMETRY_PROPERTIES):
            lod_name = property_lod(prop.tag)
            if lod_name is None:
                continue
            lod = self.lods.index(lod_name)
            kind = int(surface_kind(prop, element))
            if not self._walk_property(prop, building, lod, kind, srs):
                self._findings.add(GEOMETRY_EMPTY, building_id, local_name(prop.tag))

    def _walk_property(self, prop: Element, building: int, lod: int, kind: int, srs: int) -> bool:
        """Adds the polygons and references of one geometry property; tells whether there were any."""
        href = prop.get(XLINK_HREF)
        if href is not None:
            self.references.append(Reference(href, building, lod, kind, False))
        if len(prop) == 0:
            return href is not None
        srs, dimension = self._declared(prop[0], srs, 0)
        first, first_reference = len(self.batch.building), len(self.references)
        self.walk_geometry(prop, building, lod, kind, srs, dimension)
        return len(self.batch.building) > first or len(self.references) > first_reference

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
        batch, nodes = self.batch, self._nodes
        texts = batch.texts
        is_new_ring, is_in_polygon = True, False
        ring_srs, ring_dimension = srs, dimension
        for element in root.iter(*GEOMETRY_NODES):
            node = nodes[element.tag]
            if node == Node.POLYGON:
                attributes = element.items()
                ring_srs, ring_dimension = srs, dimension
                if attributes:
                    self._note_id(element, len(batch.building))
                    ring_srs, ring_dimension = self._declared(element, srs, dimension)
                self.polygon_elements.append(element)
                batch.building.append(building)
                batch.lod.append(lod)
                batch.kind.append(kind)
                batch.srs.append(ring_srs)
                batch.ring_counts.append(0)
                if self._turned and element in self._turned:
                    batch.flipped.append(len(batch.building) - 1)
                is_new_ring, is_in_polygon = True, True
            elif node == Node.NUMBERS or node == Node.TUPLES:
                if not is_in_polygon:
                    continue
                text = element.text or ""
                if node == Node.TUPLES:
                    text = plain_numbers(element)
                if is_new_ring:
                    texts.append(text)
                    batch.ring_counts[-1] += 1
                    is_new_ring = False
                else:
                    texts[-1] += " " + text
                batch.num_characters += len(text)
                declared = element.get("srsDimension")
                if declared is not None or ring_dimension:
                    self._note_dimension(len(texts) - 1, declared, ring_dimension)
            elif node == Node.RING:
                is_new_ring = True
                if len(element) == 0:
                    self._note_reference(element, building, lod, kind)
            elif node == Node.REFERENCE:
                if len(element) == 0:
                    self._note_reference(element, building, lod, kind)
            elif node == Node.ORIENTABLE:
                self._note_orientation(element)
            elif node == Node.CURVE:
                is_in_polygon = is_in_polygon and _is_in_ring(element)
        self._turned.clear()

    def _note_id(self, element: Element, polygon: int) -> None:
        for name in GML_IDS:
            gml_id = element.get(name)
            if gml_id is not None:
                if gml_id in self.polygon_ids:
                    self.duplicate_ids.add(gml_id)
                self.polygon_ids.setdefault(gml_id, polygon)

    def _note_dimension(self, ring: int, declared: str | None, inherited: int) -> None:
        text = (declared or "").strip()
        self.batch.dimensions[ring] = int(text) if text in ("2", "3") else inherited

    def _note_reference(self, element: Element, building: int, lod: int, kind: int) -> None:
        href = element.get(XLINK_HREF)
        if href is not None:
            is_flipped = self._turned and element in self._turned
            self.references.append(Reference(href, building, lod, kind, bool(is_flipped)))

    def _note_orientation(self, element: Element) -> None:
        """Marks what stands below an ``OrientableSurface`` of orientation "-"; twice is not at all."""
        if element.get("orientation", "+").strip() == "-":
            self._turned ^= set(element.iter(*POLYGONS, "{*}baseSurface"))


def plain_numbers(element: Element) -> str:
    """Returns the numbers of a GML2 ``coordinates`` element separated by blanks.

    The element may name its own separators: ``cs`` between coordinates, ``ts`` between tuples,
    ``decimal`` as the decimal sign.
    """
    text = element.text or ""
    decimal = element.get("decimal", ".")
    for separator in (element.get("cs", ","), element.get("ts", " ")):
        if separator.strip() and separator != decimal:
            text = text.replace(separator, " ")
    return text if decimal == "." else text.replace(decimal, ".")


def surface_kind(prop: Element, building: Element) -> SurfaceKind:
    """Returns what the surfaces of a geometry property are, from the elements around it."""
    kind = SurfaceKind.UNKNOWN
    node = prop.getparent()
    while node is not None and node is not building:
        name = local_name(node.tag)
        if name in INTERIOR_NAMES:
            return SurfaceKind.INTERIOR
        if kind is SurfaceKind.UNKNOWN:
            kind = SURFACE_KINDS.get(name, SurfaceKind.UNKNOWN)
        node = node.getparent()
    return kind


def _is_in_ring(element: Element) -> bool:
    """Tells whether a curve is a piece of a ring (``Ring/curveMember/LineString``)."""
    node = element.getparent()
    while node is not None:
        name = local_name(node.tag)
        if name == "Ring":
            return True
        if name in ("MultiGeometry", "MultiCurve", "Polygon"):
            return False
        node = node.getparent()
    return False
