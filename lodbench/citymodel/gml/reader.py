"""CityGML 1.0, 2.0 and 3.0: buildings of every level of detail, streamed one city object at a time."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from lodbench.citymodel.attributes import ATTRIBUTES, Lifespans, ObjectTable, roof_type_of
from lodbench.citymodel.codes import BUILDING_EMPTY, NOT_A_BUILDING
from lodbench.citymodel.gml import names
from lodbench.citymodel.gml.batch import read_batch
from lodbench.citymodel.gml.folding import Folding
from lodbench.citymodel.gml.names import is_building_tag, is_citygml
from lodbench.citymodel.gml.walk import GeometryWalk
from lodbench.citymodel.gml.xml import Element, NotFolded, XmlMembers, local_name, namespace_of
from lodbench.citymodel.options import ReadOptions, types_of
from lodbench.citymodel.raw import GrowingArray, NotACity, RawCity, city_of_columns, paused_collector
from lodbench.findings import Findings

if TYPE_CHECKING:
    from lodbench.citymodel.gml.details import AppearanceReader
    from lodbench.citymodel.gml.links import LinkResolver
    from lodbench.citymodel.textures import SurfaceTextures

# Numbers are read when this much text has gathered: large enough that a parse is worth its call,
# small enough that memory stays flat.
_BATCH_CHARACTERS = 1 << 20
# Files of 1.0 and 2.0 declare .../citygml/profiles/base/2.0 besides.
_BEFORE_THE_STANDARD = re.compile(r"https?://www\.citygml\.org/citygml/(\w+/)?\d/\d/\d$")
# Where CityJSON has another name for what CityGML calls an object.
_JSON_TYPES = {
    "ReliefFeature": "TINRelief",
    "TransportationComplex": "Road",
    "Track": "Road",
    "Square": "TransportSquare",
    "GenericOccupiedSpace": "GenericCityObject",
}


def read_citygml(
    open_stream: Callable[[], BinaryIO],
    source: str,
    options: ReadOptions,
    textures: SurfaceTextures | None = None,
) -> RawCity:
    """Returns the buildings of a CityGML document in the coordinates of the file, and objects of its layers.

    Args:
        open_stream: Opens the document; called again only when a reference crosses members.
        source: Name of the file, for messages.
        options: ``is_strict``, ``has_details``, ``layers``, ``date``.
        textures: Receives the pictures of surfaces, which are kept then; with ``has_details``.

    Raises:
        CityModelError: The XML is not well-formed or not CityGML, or a coordinate is bad.
    """
    reader = _Reader(source, options, textures)
    with paused_collector():
        try:
            with open_stream() as stream:  # details and pictures hang on elements that are folded
                reader.read(stream, is_folded=not options.has_details)
        except NotFolded:
            reader = _Reader(source, options, textures)
            with open_stream() as stream:
                reader.read(stream)
    if reader.has_unresolved:
        with open_stream() as stream:
            reader.read_links(stream)
    return reader.result()


class _Reader:
    """State of one document while it is read."""

    def __init__(self, source: str, options: ReadOptions, textures: SurfaceTextures | None) -> None:
        self.findings = Findings()
        self._lifespans = Lifespans(options.date, self.findings)
        self.walk = GeometryWalk(self.findings, self._lifespans)
        self._source = source
        self._is_strict = options.is_strict
        self._building_ids: list[str] = []
        self._objects = ObjectTable(options.has_details)
        self._wanted = tuple("{*}" + name for name in types_of(options.layers))
        self._num_walked = 0  # polygons of the batches that are read
        self._others: Counter[str] = Counter()
        self._columns = {
            "points": GrowingArray(np.float64, (3,)),
            "ring_lengths": GrowingArray(np.int32),
            "ring_counts": GrowingArray(np.int32),
            "building": GrowingArray(np.int32),
            "lod": GrowingArray(np.int16),
            "kind": GrowingArray(np.uint8),
            "srs": GrowingArray(np.int16),
            "part": GrowingArray(np.int32),
        }
        if options.has_details:
            self._columns["serial"] = GrowingArray(np.int64)
        self._has_textures = False
        self._textures = textures
        self._links: LinkResolver | None = None
        self._appearances: AppearanceReader | None = None
        if textures is not None:
            from lodbench.citymodel.gml.details import AppearanceReader

            self._appearances = AppearanceReader(textures)
        self._flipped: set[int] = set()
        self._version: str | None = None
        self._srs_name: str | None = None
        self._root_srs: str | None = None
        self._parent: Element | None = None  # what the members of now stand in

    def read(self, stream: BinaryIO, *, is_folded: bool = False) -> None:
        folding = self.walk.folding = Folding(is_on=is_folded)
        members = XmlMembers(
            stream, self._source, names.MEMBERS, self.findings, folding=folding if is_folded else None
        )
        for member in members:
            if self._version is None and members.root is not None:
                self._read_root(members.root)
            self._read_member(member)
            self.walk.end_member()
            if self.walk.batch.num_characters > _BATCH_CHARACTERS:
                self._flush()
        self._flush()
        if members.root is not None and self._version is None:
            self._read_root(members.root)
        self.walk.folding = Folding(is_on=False)

    @property
    def has_unresolved(self) -> bool:
        """Returns whether references have no target in their own member."""
        return self._links is not None and bool(self._links.unresolved)

    def _resolver(self) -> LinkResolver:
        """Returns what resolves references, which most files without solids have none of."""
        if self._links is None:
            from lodbench.citymodel.gml.links import LinkResolver

            self._links = LinkResolver(self.walk, self._source.rpartition("/")[2], self.findings)
        return self._links

    def read_links(self, stream: BinaryIO) -> None:
        """Looks in every member for the targets of references that point out of their own."""
        links = self._resolver()
        links.begin_second_pass(self._building_ids)
        for member in XmlMembers(stream, self._source, names.MEMBERS, Findings()):
            self._begin_member(member)
            srs_name = next(filter(None, map(names.envelope_srs, member)), self._srs_name)
            if not links.resolve_elsewhere(member, self._building_ids, srs_name):
                break
        links.end_second_pass()
        self._flush()

    def _read_root(self, root: Element) -> None:
        name = local_name(root.tag)
        if name not in ("CityModel", "FeatureCollection"):
            raise NotACity(
                f"{self._source} is XML, but not CityGML: its root element is <{name}>.",
                "A CityGML file begins with <CityModel>.",
            )
        # A WFS answer wraps the CityModel; its namespace map still names the version.
        namespaces = [namespace_of(root.tag), *(root.nsmap or {}).values()]
        versions = [ns.rpartition("/")[2] for ns in namespaces if "opengis.net/citygml/" in (ns or "")]
        if not versions and any(_BEFORE_THE_STANDARD.match(ns or "") for ns in namespaces):
            raise NotACity(
                f"{self._source} is CityGML 0.4 or older, from before the standard; 1.0 to 3.0 is read.",
                "Export it again, or convert it to CityGML 1.0 with a program that reads 0.4.",
            )
        self._version = versions[0] if versions else ""
        self._srs_name = self._root_srs = names.envelope_srs(root) or root.get("srsName")

    def _begin_member(self, member: Element) -> None:
        self.walk.begin_member()
        parent = member.getparent()
        if parent is not None and parent is not self._parent:  # its Envelope goes with its first member
            self._parent, self._srs_name = parent, names.envelope_srs(parent) or self._root_srs

    def _read_member(self, member: Element) -> None:
        self._begin_member(member)
        met: list[tuple[Element, dict[Element, int], int]] = []
        num_over = 0
        elements = list(member.iter(*self._wanted))
        for element in elements:
            if not is_citygml(element.tag) or (not is_building_tag(element.tag) and is_inside(element, met)):
                continue
            noted = names.noted_children(element)
            if not self.walk.stands(element, noted):
                num_over += 1
                continue
            if len(elements) > 1:
                self.walk.left_out |= names.buildings_inside(element)
            met.append((element, *self._read_object(element, noted)))
        if not met:
            met_here = [] if num_over else [local_name(child.tag) for child in member]
            # Of a CityModel in this one the members were read before.
            self._others.update(name for name in met_here if name != "CityModel")
            self._has_textures |= any(local_name(child.tag) == "Appearance" for child in member)
            self._read_pictures(member, {})
            return
        if self._objects.has_details and not self._has_textures:  # a look at all elements
            self._has_textures = member.find(".//{*}appearance") is not None
        if self._objects.has_details:
            from lodbench.citymodel.gml.links import SolidReader

            solids = SolidReader(member, self.walk, self._objects, self._num_walked)
            for element, part_of, own in met:
                solids.read(element, part_of, own)
            self._read_pictures(member, solids.polygons)
        if self.walk.references or self.walk.duplicate_ids:
            self._resolver().resolve_member(member, self._building_ids)

    def _read_object(
        self, element: Element, noted: dict[str, list[Element]]
    ) -> tuple[dict[Element, int], int]:
        """Adds a building or another object; returns the numbers of objects in it, and its own."""
        type_, number = local_name(element.tag), len(self._building_ids)
        building_id = names.gml_id(element) or f"{type_.lower()}-{number + 1}"
        self._building_ids.append(building_id)
        attributes = self._attributes_of(element)
        own = self._objects.add(
            building_id, _JSON_TYPES.get(type_, type_), -1, number, attributes, _roof_type(noted),
            names.measured_height(noted),
        )  # fmt: skip
        srs_name = (names.envelope_srs(element) if "boundedBy" in noted else None) or self._srs_name
        before = len(self.walk.batch.owners), len(self.walk.references)
        part_of = self.walk.walk_building(
            element, number, building_id, srs_name, own, partial(self._add_nested, element, own)
        )
        if before == (len(self.walk.batch.owners), len(self.walk.references)):
            self.findings.add(BUILDING_EMPTY, building_id, "" if type_ == "Building" else f"a {type_}")
        return part_of, own

    def _attributes_of(self, element: Element) -> dict[str, Any] | None:
        if not self._objects.has_details:
            return None
        from lodbench.citymodel.gml.details import read_attributes

        return read_attributes(element)

    def _read_pictures(self, member: Element, polygons: dict[Element, int]) -> None:
        if self._appearances is not None:
            self._appearances.read_member(member, polygons, self._num_walked)

    def _add_nested(self, building: Element, own: int, nested: Element, part_of: dict[Element, int]) -> int:
        """Adds an object inside of another; returns its number."""
        table = self._objects
        name = local_name(nested.tag)
        parent = names.owner_of(nested, building, part_of, own)
        object_id = names.gml_id(nested) or f"{table.ids[own]}-{name}-{len(part_of) + 1}"
        attributes = self._attributes_of(nested)
        noted = names.noted_children(nested)
        type_, roof_type = names.NESTED_TYPES[name], _roof_type(noted)
        height_m = names.measured_height(noted) if type_ == "BuildingPart" else None
        return table.add(object_id, type_, parent, table.building[own], attributes, roof_type, height_m)

    def _flush(self) -> None:
        batch = self.walk.take_batch()
        if batch.owners:
            arrays = read_batch(batch, self._building_ids, self.findings, is_strict=self._is_strict)
            arrays.serial[arrays.serial >= 0] += self._num_walked
            if self._appearances is not None:
                self._flipped.update(self._num_walked + n for n in batch.flipped)
            self._num_walked += len(batch.owners)
            for name, column in self._columns.items():
                column.extend(getattr(arrays, name))

    def _report_what_is_left_out(self) -> None:
        if self._links is not None:
            self._links.report_unresolved(self._building_ids)
        for name, count in sorted(self._others.items()):
            if not name.startswith("Appearance"):
                self.findings.add(NOT_A_BUILDING, name, f"{count} of them")
        for name, count in sorted(self.walk.extensions.items()):
            self.findings.add(NOT_A_BUILDING, name, f"{count} of them, of an extension, in buildings")
        if not self._building_ids and (ended := self._lifespans.none_stands()):
            raise NotACity(f"{self._source} {ended}.", "Take it as it stood before: `date=YYYY-MM-DD`")
        if not self._building_ids and not self._version:
            hint = "Of other GML, such as INSPIRE's, footprints are read once they are saved as GeoPackage."
            raise NotACity(f"{self._source} is GML, but names nothing of CityGML.", hint)
        if not self._building_ids:
            raise NotACity(f"{self._source} has no buildings.", "Is it the building tile of the city?")

    def result(self) -> RawCity:
        self._report_what_is_left_out()
        columns = {name: column.finish() for name, column in self._columns.items()}
        if self._appearances is not None:
            self._appearances.lay_all(columns, self._flipped)
        return city_of_columns(
            columns,
            table=self._objects,
            textures=self._textures,
            source=self._source,
            format="CityGML",
            version=self._version or None,
            srs_names=tuple(self.walk.srs_names.names),
            building_ids=tuple(self._building_ids),
            lods=tuple(name or "" for name in self.walk.lods.names),
            has_closing_points=True,
            findings=self.findings,
            has_textures=self._has_textures,
            period=self._lifespans.period(),
        )


def _roof_type(noted: dict[str, list[Element]]) -> str:
    """Returns the word or code under which an object describes its roof, as CityJSON converted may, or ""."""
    generic = noted.get("stringAttribute", ())
    stated = {name: each.findtext("{*}value") for each in generic if (name := each.get("name")) in ATTRIBUTES}
    if "roofType" in noted:
        stated["roofType"] = noted["roofType"][0].text
    return roof_type_of(stated) if stated else ""


def is_inside(element: Element, met: list[tuple[Element, dict[Element, int], int]]) -> bool:
    """Returns whether an element stands inside of one that was met, as terrain does inside of terrain."""
    above = set(element.iterancestors())
    return any(other in above for other, _, _ in met)
