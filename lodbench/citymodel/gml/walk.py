"""From the tree of one city object to rings of text: what stands where, before any number is read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from lodbench.citymodel.attributes import NAMES, Lifespans
from lodbench.citymodel.codes import GEOMETRY_EMPTY, GEOMETRY_UNSUPPORTED
from lodbench.citymodel.crs import is_in_degrees
from lodbench.citymodel.gml import names
from lodbench.citymodel.gml.batch import NameTable, PolygonBatch, Reference, leave_out, read_placement
from lodbench.citymodel.gml.folding import FOLDED, FoldedSurface, Folding
from lodbench.citymodel.gml.names import CURVE, NOTHING, NUMBERS, ORIENTABLE, POLYGON, REFERENCE, RING, TUPLES
from lodbench.citymodel.gml.xml import XLINK_HREF, Element, NotFolded, local_name
from lodbench.findings import Findings


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
        folding: What is folded of the current member.
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
        self.folding = Folding(is_on=False)
        self._findings, self._lifespans = findings, lifespans
        self._nodes, self._is_walked = names.NodeTable(), names.WalkedTags()
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
        first, first_reference = len(self.batch.owners), len(self.references)
        # One pass for objects and geometry: an object comes before what is in it.
        for prop in self._places(element):
            surfaces = self._folded_surfaces(prop) if local_name(prop.tag) == names.BOUNDARY else []
            if surfaces is None or self._is_another_s(prop, element):
                continue
            self.part = names.owner_of(prop, element, part_of, own) if part_of else own
            self._add_surfaces(surfaces, building, srs)
            lod_name = names.property_lod(prop.tag)
            if lod_name is None and local_name(prop.tag) == names.RELIEF_SURFACE:
                lod_name = names.relief_lod(prop)
            if lod_name is not None:
                self._walk_place(prop, building, building_id, lod_name, names.surface_kind(prop, element))
            elif local_name(prop.tag) in names.NESTED_TYPES and self._stands_or_is_left_out(prop):
                part_of[prop] = add_nested(prop, part_of)
        for prop in names.linked_objects(element) if self.folding.has_links else ():
            if names.is_extension(prop.tag) or names.is_another_s(prop, element, self.left_out):
                continue
            part = names.owner_of(prop, element, part_of, own)
            # A door that two rooms share is inside from both.
            kind = names.surface_kind(prop, element)
            self.references.append(Reference(prop.get(XLINK_HREF, ""), building, -1, kind, False, None, part))
        storeys = names.storeys_among(element, part_of)
        if storeys:
            leave_out(storeys, self.batch.owners, first, self.references, first_reference)
        return part_of

    def _walk_place(self, prop: Element, building: int, building_id: str, lod_name: str, kind: int) -> None:
        lod, srs, name = self.lods.index(lod_name), self.default_srs, local_name(prop.tag)
        if name.endswith("ImplicitRepresentation"):
            self._walk_implicit(prop, building, building_id, lod, kind, srs)
        elif not self._walk_property(prop, building, lod, kind, srs):
            self._findings.add(GEOMETRY_EMPTY, building_id, name)

    def _places(self, element: Element) -> Iterable[Element]:
        """Returns where geometry and objects may be in an object, in document order."""
        if not names.is_building_tag(element.tag):
            return element.iter(*names.WALKED)
        if self.folding.has_boundaries:
            return element.iter(*names.WALKED_IN_BUILDINGS, "{*}" + names.BOUNDARY)
        walked = self._is_walked
        # Setting a filter up costs more than to look at the children that most buildings of one level have.
        properties = []
        for child in element:
            tag = child.tag
            if walked[tag]:
                properties.append(child)
            if (walked[tag] and names.property_lod(tag) is None) or (
                not walked[tag] and len(child) and any(walked[inner.tag] for inner in child.iter())
            ):
                return element.iter(*names.WALKED_IN_BUILDINGS)
        return properties

    def _folded_surfaces(self, boundary: Element) -> list[FoldedSurface] | None:
        """Returns what is folded into a boundary, None where nothing is."""
        for name, value in boundary.items():
            surfaces = self.folding.surfaces_at(str(value))
            if surfaces is not None:
                name = str(name)
                has_ids = name.removesuffix(FOLDED) + "id" in names.GML_IDS
                if not names.is_citygml(boundary.tag) or not (has_ids or name == FOLDED):
                    raise NotFolded("Names are not those of CityGML.")
                return surfaces
        return None

    def _add_surfaces(self, surfaces: list[FoldedSurface], building: int, srs: int) -> None:
        """Adds the polygons of what bounds a building."""
        batch, part = self.batch, self.part
        for name, lod_name, polygon_id, rings in surfaces:
            if polygon_id:
                self._note_id(polygon_id)
            owner = (building, self.lods.index(lod_name), names.SURFACE_KINDS[name], srs, part)
            batch.owners += [owner] * len(rings.texts)
            batch.add_rings(rings, 0)

    def _is_another_s(self, node: Element, building: Element) -> bool:
        """Tells whether something is no part of a building; objects of extensions are counted, once each."""
        is_other = names.is_another_s(node, building, self.left_out)
        prop = names.extension_above(node, building) if is_other else None
        if prop is not None and prop not in self.left_out:
            self.left_out.add(prop)
            inside = [local_name(child.tag) for child in prop.iterchildren("*")]
            if self.folding.has_folded and not {names.BOUNDARY, "Polygon"}.isdisjoint(inside):
                raise NotFolded("One element may stand for several.")
            self.extensions.update(inside)
        return is_other

    def _stands_or_is_left_out(self, element: Element) -> bool:
        if not self.stands(element, names.noted_children(element)):
            self.left_out.add(element)
        return element not in self.left_out

    def stands(self, element: Element, noted: dict[str, list[Element]]) -> bool:
        """Returns whether a city object stands at the date that counts; one that does not is a finding.

        Args:
            element: The object.
            noted: Its ``noted_children``.
        """
        dates = {name: noted[name][-1].text or "" for name in NAMES if name in noted} if noted else {}
        return not dates or self._lifespans.stands(names.gml_id(element) or local_name(element.tag), dates)

    def _walk_property(self, prop: Element, building: int, lod: int, kind: int, srs: int) -> bool:
        """Adds the polygons and references of one geometry property; returns whether there were any."""
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
        folding = self.folding
        # Without a tag filter: setting one up costs more than passing by the few other elements.
        for element in root.iter():
            node = nodes[element.tag]
            if node == NUMBERS or node == TUPLES:
                if not is_in_polygon:
                    continue
                text = ((element.text or "") if node == NUMBERS else names.plain_numbers(element)).encode()
                if is_new_ring:
                    texts.append(text)
                    ring_counts[-1] += 1
                    is_new_ring = False
                else:
                    texts[-1] += b" " + text
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
                rings = folding.rings_at(element.text) if folding.has_folded else None
                count = 1 if rings is None else len(rings.texts)
                if self._turned and element in self._turned:
                    batch.flipped.extend(range(len(ring_counts), len(ring_counts) + count))
                batch.owners += [(building, lod, kind, polygon_srs, part)] * count
                is_new_ring, is_in_polygon = rings is None, True
                if rings is None:
                    ring_counts.append(0)
                else:
                    batch.add_rings(rings, ring_dimension)
            elif node == ORIENTABLE:
                self._note_orientation(element)
            elif node == CURVE:
                is_in_polygon = is_in_polygon and names.is_in_ring(element)
        if self._turned:
            self._turned.clear()
        self._systems.clear()

    def _note_system(self, element: Element) -> None:
        """Notes the reference system that an element inside of a geometry declares for what is in it."""
        srs = self.srs_names.index(element.get("srsName", "").strip())
        below = list(element.iter(*names.POLYGONS))
        self._systems.update(dict.fromkeys(below, srs))
        # A ring, or its numbers.
        if not below and next(element.iterancestors(*names.POLYGONS), None) is not None:
            building, lod, kind, _, part = self.batch.owners[-1]
            self.batch.owners[-1] = (building, lod, kind, srs, part)

    def _read_attributes(
        self, attributes: Sequence[tuple[Any, Any]], srs: int, dimension: int
    ) -> tuple[int, int]:
        """Notes the id of the polygon that comes next; returns its reference system and dimension."""
        for name, value in attributes:
            if name in names.GML_IDS:
                self._note_id(value)
            elif name == "srsName":
                srs = self.srs_names.index(value.strip())
            elif name == "srsDimension" and value.strip() in ("2", "3"):
                dimension = int(value)
        return srs, dimension

    def _note_id(self, polygon_id: str) -> None:
        """Notes the id of the polygon that comes next."""
        if polygon_id in self.polygon_ids:
            self.duplicate_ids.add(polygon_id)
        else:
            self.polygon_ids[polygon_id] = len(self.batch.ring_counts)

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
            self._turned ^= set(element.iter(*names.POLYGONS, "{*}baseSurface"))
