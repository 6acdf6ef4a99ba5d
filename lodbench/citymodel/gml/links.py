"""XLinks: surfaces that a solid borrows from elsewhere, each polygon counted once per building and level."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain

from lodbench.citymodel import codes
from lodbench.citymodel.attributes import ObjectTable
from lodbench.citymodel.gml import names
from lodbench.citymodel.gml.batch import Reference
from lodbench.citymodel.gml.walk import GeometryWalk
from lodbench.citymodel.gml.xml import XLINK_HREF, Element, NotFolded, local_name
from lodbench.citymodel.model import SurfaceKind
from lodbench.findings import Findings

_INTERIOR = int(SurfaceKind.INTERIOR)


class LinkResolver:
    """Resolves the references of one member after another.

    Args:
        walk: Holds the polygons, ids and references of the current member.
        source_name: Name of the file: ``name#id`` refers to the file itself.
        findings: Receives remote, cyclic and duplicate references.

    Attributes:
        unresolved: References without a target in their own member, for a second pass.
    """

    def __init__(self, walk: GeometryWalk, source_name: str, findings: Findings) -> None:
        self.unresolved: list[Reference] = []
        self._walk = walk
        self._source_name = source_name
        self._findings = findings
        self._copied: set[tuple[int, int, int, int]] = set()
        self._visited: dict[tuple[int, int, int], set[str]] = {}
        self._wanted: dict[str, list[int]] = {}
        self._is_second_pass = False

    def resolve_member(self, member: Element, building_ids: list[str]) -> None:
        """Turns the current member's references into copies where they add a surface.

        A reference to a polygon that already counts for the same building and level adds nothing:
        that is how a solid repeats the surfaces of its walls and roofs.
        """
        walk = self._walk
        for gml_id in sorted(walk.duplicate_ids):
            self._findings.add(codes.DUPLICATE_ID, gml_id)
        walk.duplicate_ids.clear()
        self._copied.clear()
        self._visited.clear()
        index: MemberIndex | None = None
        owners, polygon_ids = walk.batch.owners, walk.polygon_ids
        for reference in tuple(walk.references):
            href, building, lod, kind, _, placement, _ = reference
            known = polygon_ids.get(href[1:])
            if (
                known is not None
                and owners[known][0] == building
                and owners[known][1] == lod
                and (owners[known][2] != _INTERIOR or kind == _INTERIOR)
                and placement is None
            ):
                continue  # the usual case, before any care for odd spellings
            target = self._target_id(reference, building_ids)
            if target is None:
                continue
            polygon = walk.polygon_ids.get(target) if lod >= 0 else None
            if polygon is not None:
                self._copy(polygon, reference)
                continue
            if index is None:
                index = index_member(member, walk)
            if target not in index.elements:
                self.unresolved.append(reference)
            else:
                self._follow(index, target, reference, building_ids)

    def begin_second_pass(self, building_ids: list[str]) -> None:
        """Sorts the unresolved references by the id they name, so that each member is read once."""
        self._copied.clear()
        self._visited.clear()
        self._is_second_pass = True
        for number, reference in enumerate(self.unresolved):
            target = self._target_id(reference, building_ids)
            self._wanted.setdefault(target or "", []).append(number)

    def resolve_elsewhere(self, member: Element, building_ids: list[str], srs_name: str | None) -> bool:
        """Second pass: adds what ``member`` holds of the unresolved references; returns whether any are left.

        ``srs_name`` is the reference system of what declares none in it.
        """
        index = index_member(member, None)
        matches = [
            (number, target)
            for target in self._wanted.keys() & index.elements.keys()
            for number in self._wanted.pop(target)
        ]
        if matches:
            self._walk.default_srs = self._walk.srs_names.index(srs_name)
        for number, target in sorted(matches):
            self._follow(index, target, self.unresolved[number], building_ids)
        return bool(self._wanted)

    def end_second_pass(self) -> None:
        """Forgets the references that were found."""
        self.unresolved = [self.unresolved[n] for n in sorted(chain.from_iterable(self._wanted.values()))]

    def report_unresolved(self, building_ids: list[str]) -> None:
        """Adds a finding for every reference that found no target anywhere."""
        for reference in self.unresolved:
            self._findings.add(codes.XLINK_UNRESOLVED, building_ids[reference.building], reference.href)

    def _target_id(self, reference: Reference, building_ids: list[str]) -> str | None:
        """Returns the id a reference names in this file, or None with a finding."""
        href = reference.href.strip()
        place, hash_sign, fragment = href.partition("#")
        if not hash_sign:
            # `urn:uuid:...` and bare names are ids; anything with a path or scheme lies elsewhere.
            if "/" in href or not href:
                self._findings.add(codes.XLINK_REMOTE, building_ids[reference.building], href)
                return None
            return href.removeprefix("urn:uuid:") if href not in self._walk.polygon_ids else href
        if place and place != self._source_name:
            self._findings.add(codes.XLINK_REMOTE, building_ids[reference.building], href)
            return None
        return fragment.strip()

    def _copy(self, polygon: int, reference: Reference) -> None:
        batch = self._walk.batch
        building, lod, own_kind, _, _ = batch.owners[polygon]
        # A door of a room that an outer wall borrows bounds the outside, too.
        is_borrowed = own_kind == _INTERIOR != reference.kind
        is_own = (building, lod) == (reference.building, reference.lod) and reference.placement is None
        if is_own and not is_borrowed:
            return
        key = (polygon, reference.building, reference.lod, id(reference.placement))
        if key not in self._copied:
            self._copied.add(key)
            kind = reference.kind or (int(SurfaceKind.UNKNOWN) if is_borrowed else own_kind)
            batch.copies.append(
                (
                    *(polygon, reference.building, reference.lod, kind),
                    *(reference.is_flipped, reference.placement, reference.part),
                )
            )

    def _follow(self, index: MemberIndex, target: str, reference: Reference, building_ids: list[str]) -> None:
        """Copies what a reference stands for: a geometry, or those of a whole boundary surface or part."""
        if reference.lod >= 0:
            self._copy_all(index, target, reference, building_ids)
            return
        visited = self._visited.setdefault((reference.building, reference.lod, 0), set())
        todo, has_geometry = [target], False
        for name in todo:  # which grows
            if name in visited:
                continue
            visited.add(name)
            element = index.elements[name]
            if element in self._walk.left_out or not self._walk.stands(
                element, names.noted_children(element)
            ):
                has_geometry = True  # which ended with it
                continue
            has_geometry |= self._copy_object(index, index.elements[name], reference, building_ids)
            hrefs = (prop.get(XLINK_HREF, "") for prop in names.linked_objects(index.elements[name]))
            todo += self._targets_within(index, hrefs, reference, building_ids)
        # An object without geometry is one; objects that name only each other are none.
        if len(todo) > 1 and not has_geometry:
            self._findings.add(codes.XLINK_UNRESOLVED, building_ids[reference.building], reference.href)

    def _copy_object(
        self, index: MemberIndex, element: Element, reference: Reference, building_ids: list[str]
    ) -> bool:
        """Copies each geometry of an object at its own level and of its own kind; tells if there are any."""
        parent, properties = element.getparent(), 0
        for prop in element.iter(*names.GEOMETRY_PROPERTIES):
            lod_name = names.property_lod(prop.tag)
            if lod_name is None or parent is None or names.is_another_s(prop, parent, self._walk.left_out):
                continue
            properties += 1
            if local_name(prop.tag).endswith("ImplicitRepresentation"):
                detail = f"{local_name(prop.tag)} of an object elsewhere"
                self._findings.add(codes.GEOMETRY_UNSUPPORTED, building_ids[reference.building], detail)
                continue
            lod, kind = self._walk.lods.index(lod_name), names.surface_kind(prop, parent)
            own = reference._replace(lod=lod, kind=_INTERIOR if reference.kind == _INTERIOR else kind)
            hrefs = (*filter(None, [prop.get(XLINK_HREF)]), *self._copy_below(prop, index, own))
            for inner in self._targets_within(index, hrefs, own, building_ids):
                self._copy_all(index, inner, own, building_ids)
        return properties > 0

    def _targets_within(
        self, index: MemberIndex, hrefs: Iterable[str], reference: Reference, building_ids: list[str]
    ) -> list[str]:
        """Returns the ids that stand in the member; every other is looked for in those that follow."""
        targets = []
        for href in hrefs:
            target = self._target_id(reference._replace(href=href), building_ids)
            if target in index.elements:
                targets.append(target)
            elif target is not None:
                if self._is_second_pass:
                    self._wanted.setdefault(target, []).append(len(self.unresolved))
                self.unresolved.append(reference._replace(href=href))
        return targets

    def _copy_all(
        self, index: MemberIndex, target: str, reference: Reference, building_ids: list[str]
    ) -> None:
        """Copies every polygon below a referenced element, and below what that refers to in turn.

        A circle is a reference to an element whose own references are still being followed.
        """
        # What one reference of a building and level has copied, the next would copy in vain.
        key = (reference.building, reference.lod, id(reference.placement))
        visited = self._visited.setdefault(key, set())
        if target in visited:
            return
        visited.add(target)
        open_targets = {target}
        # One entry per element whose references are being followed: its id and those still to follow.
        stack = [(target, self._copy_below(index.elements[target], index, reference))]
        while stack:
            name, links = stack[-1]
            href = next(links, None)
            if href is None:
                open_targets.discard(name)
                stack.pop()
                continue
            inner = href.strip().removeprefix("#").strip()
            if inner in open_targets:
                self._findings.add(codes.XLINK_CYCLE, building_ids[reference.building], href)
            elif inner not in index.elements:
                self._findings.add(codes.XLINK_UNRESOLVED, building_ids[reference.building], href)
            elif inner not in visited:
                visited.add(inner)
                open_targets.add(inner)
                stack.append((inner, self._copy_below(index.elements[inner], index, reference)))

    def _copy_below(self, element: Element, index: MemberIndex, reference: Reference) -> Iterator[str]:
        """Copies the polygons below an element; returns the references that stand there."""
        for polygon_element in element.iter(*names.POLYGONS):
            if polygon_element not in index.polygons:
                # A geometry outside every geometry property: nothing has counted it yet.
                self._walk_once(polygon_element, index, reference)
            else:
                self._copy(index.polygons[polygon_element], reference)
        hrefs = [
            node.get(XLINK_HREF) for node in element.iter("{*}surfaceMember", "{*}baseSurface", "{*}exterior")
        ]
        return iter([str(href) for href in hrefs if href is not None])

    def _walk_once(self, element: Element, index: MemberIndex, reference: Reference) -> None:
        walk = self._walk
        polygon = len(walk.batch.owners)
        walk.part = reference.part
        srs_name, dimension = inherited_srs(element)
        srs = walk.default_srs if srs_name is None else walk.srs_names.index(srs_name)
        walk.walk_geometry(element, reference.building, reference.lod, reference.kind, srs, dimension)
        index.polygons[element] = polygon
        if reference.is_flipped:
            walk.batch.flipped.append(polygon)
        if reference.placement is not None:
            walk.batch.placed[polygon] = reference.placement


@dataclass(slots=True)
class MemberIndex:
    """Everything in a member that can be referred to; built only when a plain look-up fails."""

    elements: dict[str, Element]
    polygons: dict[Element, int]


def index_member(member: Element, walk: GeometryWalk | None) -> MemberIndex:
    """Returns what can be referred to; polygons by number where ``walk`` has just collected them.

    Raises:
        NotFolded: Some of it has no elements.
    """
    if walk is not None and walk.folding.has_folded:
        raise NotFolded("A reference may be to something that is folded.")
    elements: dict[str, Element] = {}
    for element in member.iter():
        for name in names.GML_IDS:
            gml_id = element.get(name)
            if gml_id is not None:
                elements.setdefault(gml_id, element)
    if walk is None:
        return MemberIndex(elements, {})
    # The same steps in the same order as the walk took, so that numbers agree.
    in_order = (polygon for prop in walk.properties for polygon in prop.iter(*names.POLYGONS))
    polygons = {element: walk.first_polygon + i for i, element in enumerate(in_order)}
    return MemberIndex(elements, polygons)


class SolidReader:
    """Finds the solids of a member and the polygons that close them.

    Attributes:
        polygons: The member's polygons by their number in the walk.
    """

    def __init__(self, member: Element, walk: GeometryWalk, table: ObjectTable, first_serial: int) -> None:
        self._index: MemberIndex = index_member(member, walk)
        self.polygons = self._index.polygons
        self._table, self._left_out = table, walk.left_out
        self._first = first_serial
        for element, number in self._index.polygons.items():
            gml_id = next((element.get(name) for name in names.GML_IDS if element.get(name)), None)
            if gml_id is not None:
                table.polygon_ids[first_serial + number] = str(gml_id)

    def read(self, building: Element, part_of: dict[Element, int], own: int) -> None:
        """Adds the solids of a building and its parts."""
        for prop in building.iter(*names.GEOMETRY_PROPERTIES):
            if names.property_lod(prop.tag) is None or names.is_another_s(prop, building, self._left_out):
                continue
            composites: dict[Element, int] = {}
            for composite in prop.iter("{*}CompositeSolid"):
                composites[composite] = self._table.num_composites
                self._table.num_composites += 1
            for solid in prop.iter("{*}Solid"):
                shells = [
                    self._faces(shell)
                    for name in ("{*}exterior", "{*}interior")
                    for shell in solid.iterchildren(name)
                ]
                if any(shells):
                    parent = names.owner_of(solid, prop, composites, -1) if composites else -1
                    self._table.solids.append((names.owner_of(prop, building, part_of, own), shells, parent))

    def _faces(self, shell: Element) -> list[tuple[int, bool]]:
        """Returns serial number and direction of each polygon of a shell, borrowed ones included."""
        faces: list[tuple[int, bool]] = []
        visited: set[Element] = {shell}
        todo = [(shell, False)]
        for root, is_flipped in todo:  # which grows
            for node in root.iter(*names.POLYGONS, "{*}surfaceMember", "{*}baseSurface"):
                number = self._index.polygons.get(node)
                if number is not None:
                    faces.append((self._first + number, is_flipped))
                href = node.get(XLINK_HREF)
                name = (href or "").strip().removeprefix("#").strip().removeprefix("urn:uuid:")
                target = self._index.elements.get(name)
                if target is not None and target not in visited:
                    visited.add(target)
                    parent = node.getparent()
                    is_turned = parent is not None and parent.get("orientation", "+").strip() == "-"
                    todo.append((target, is_flipped ^ is_turned))
        return faces


def inherited_srs(geometry: Element) -> tuple[str | None, int]:
    """Returns the srsName and the srsDimension around a geometry, None and 0 where none is."""
    systems = (node.get("srsName") for node in geometry.iterancestors())
    dimensions = ((node.get("srsDimension") or "").strip() for node in geometry.iterancestors())
    srs_name = next((str(name).strip() for name in systems if name), None)
    return srs_name, int(next((text for text in dimensions if text in ("2", "3")), 0))
