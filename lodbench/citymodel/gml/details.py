"""What CityGML says of objects besides their surfaces: attributes, addresses, and the pictures on them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.attributes import take_measured_height
from lodbench.citymodel.gml.names import GML_IDS, HEIGHTS, OBJECT_PROPERTIES, is_citygml
from lodbench.citymodel.gml.xml import MAX_DEPTH, Element, local_name, metres_of, put_value, value_of
from lodbench.citymodel.textures import Image, SurfaceTextures, TextureFolder
from lodbench.errors import DatasetError

# Children that hold geometry, other objects or bookkeeping, not facts about the object.
_NO_ATTRIBUTES = OBJECT_PROPERTIES | {
    "appearance", "address", "generalizesTo", "adeOfAbstractBuilding", "reliefComponent", "tin",
}  # fmt: skip
_GENERIC = ("attribute", "attributeset")
_GENERIC_KINDS = {"doubleAttribute": float, "intAttribute": int, "measureAttribute": float}
_DAYS = ("creationDate", "terminationDate")
# Lines, points and terrain intersections: geometry too, which no scene has.
_LINES = re.compile(r"lod\d\w+")
# What a name inside of an address of CityGML 3 is the name of.
_ADDRESS_NAMES = {
    ("Country", "NameElement"): "CountryName",
    ("Locality", "NameElement"): "LocalityName",
    ("Thoroughfare", "NameElement"): "ThoroughfareName",
    ("Thoroughfare", "Number"): "ThoroughfareNumber",
    ("PostCode", "Identifier"): "PostalCodeNumber",
}


def read_attributes(element: Element) -> dict[str, Any]:
    """Returns the attributes of an object by their names in CityGML: text, numbers, lists or nested mappings.

    Generic attributes stand under the names they give themselves; an address under ``address``, as CityJSON
    has it. Geometry, parts and surfaces are left out. Heights and lengths that CityGML names are in metres; a
    height whose unit is not known has that in its name.
    """
    values: dict[str, Any] = {}
    for child in element.iterchildren("*"):
        name = local_name(child.tag)
        generic = child.get("name")
        if name == "address":
            addresses = values.setdefault("address", [])
            addresses += [_leaves(node) for node in child.iterchildren("*")]
        elif name == "genericAttribute" or (generic is not None and name.lower().endswith(_GENERIC)):
            _put_generic(values, child, 0)
        elif name not in _NO_ATTRIBUTES and not (is_citygml(child.tag) and _LINES.fullmatch(name)):
            value = value_of(child, 0)
            if name in _DAYS:
                value = str(value).removesuffix("T00:00:00")  # a day, which CityGML 3 writes as a moment
            elif name.startswith("storey"):
                value = _storeys(name, str(child.text or ""), metres_of(child) or 1.0)
            if name in HEIGHTS and metres_of(child) is None:
                name = f"{name}_{child.get('uom')}"  # not to be taken for metres
            if value not in (None, "", {}):
                put_value(values, name, value)
    take_measured_height(values)
    return values


def _storeys(name: str, text: str, metres: float) -> Any:
    """Returns the number of storeys, or a list of their heights in metres; the text where it is neither."""
    try:
        return int(text) if name.startswith("storeys") else [float(word) * metres for word in text.split()]
    except ValueError:
        return text.strip()


def _put_generic(values: dict[str, Any], element: Element, depth: int) -> None:
    """Adds a generic attribute under its own name; a set of them is a mapping."""
    if local_name(element.tag) == "genericAttribute":  # of CityGML 3, around the attribute
        for inner in element.iterchildren("*"):
            _put_generic(values, inner, depth)
        return
    kind = local_name(element.tag)
    name = element.get("name") or (element.findtext("{*}name") or "").strip()
    if not name:
        return
    if not kind.lower().endswith("attributeset"):
        put_value(values, name, _generic(element, kind[:1].lower() + kind[1:]))
    elif depth < MAX_DEPTH:
        inside: dict[str, Any] = {}
        for child in element.iterchildren("*"):
            if local_name(child.tag) not in ("name", "codeSpace"):
                _put_generic(inside, child, depth + 1)
        put_value(values, name, inside)


def _generic(element: Element, kind: str) -> Any:
    value = next(element.iterchildren("{*}value"), None)
    text = (value.text or "").strip() if value is not None else ""
    try:
        return _GENERIC_KINDS.get(kind, str)(text)
    except ValueError:
        return text


def _leaves(element: Element) -> dict[str, Any]:
    """Returns the texts below an address by their innermost names."""
    values: dict[str, Any] = {}
    for node in element.iter("*"):
        text = (node.text or "").strip()
        name, parent = local_name(node.tag), node.getparent()
        if len(node) == 0 and text and name not in ("pos", "posList"):
            parent_name = "" if parent is None else local_name(parent.tag)
            given = next((v for key, v in node.items() if local_name(str(key)) == "Type"), None)
            put_value(values, str(given or _ADDRESS_NAMES.get((parent_name, name), name)), text)
    return values


Floats = NDArray[np.float64]


class Georeference(NamedTuple):
    """A picture that lies on the ground: (column, row) = inverse @ (x, y) - inverse @ origin."""

    image: str
    inverse: Floats
    origin: Floats


@dataclass(slots=True)
class Appearances:
    """What the appearances of a file say, by gml:id."""

    # Picture and text of coordinates of each ring
    rings: dict[str, tuple[Image, str]] = field(default_factory=dict)
    # Picture and (3, 4) matrix from world to texture of each surface
    planes: dict[str, tuple[Image, Floats]] = field(default_factory=dict)
    grounds: dict[str, Georeference] = field(default_factory=dict)  # georeferenced picture of each surface
    materials: dict[str, tuple[int, int, int]] = field(default_factory=dict)  # diffuse RGB of each surface


def read_appearances(member: Element, appearances: Appearances, folder: TextureFolder) -> None:
    """Adds what a member of the file says; what a surface was given first stays.

    Args:
        member: Any element.
        appearances: Receives it.
        folder: Where world files lie beside the pictures.
    """
    for texture in member.iter("{*}ParameterizedTexture"):
        _read_parameterized(texture, appearances)
    for texture in member.iter("{*}GeoreferencedTexture"):
        ground = _georeference(texture, folder)
        if ground is not None:
            appearances.grounds |= {
                target: ground for target in _targets(texture) if target not in appearances.grounds
            }
    for material in member.iter("{*}X3DMaterial"):
        colour = numbers_of(_text(material, "diffuseColor"))
        if len(colour) == 3 and np.isfinite(colour).all():
            red, green, blue = np.rint(255 * np.clip(colour, 0.0, 1.0)).astype(int).tolist()
            for target in _targets(material):
                appearances.materials.setdefault(target, (red, green, blue))


def _read_parameterized(texture: Element, appearances: Appearances) -> None:
    image = Image(_text(texture, "imageURI"), _text(texture, "wrapMode"))
    for places in texture.iter("{*}TexCoordList"):
        coordinates = list(places.iterchildren("{*}textureCoordinates"))
        # CityGML 3 names the rings beside the coordinates, in the same order.
        rings = [ring.text or "" for ring in places.iterchildren("{*}ring")] or [""] * len(coordinates)
        for each, ring in zip(coordinates, rings, strict=False):
            name = each.get("ring") or ring
            appearances.rings.setdefault(name.strip().removeprefix("#"), (image, each.text or ""))
    for matrix in texture.iter("{*}worldToTexture"):
        numbers = numbers_of(matrix.text)
        if len(numbers) == 12:
            for target in _targets_above(matrix):
                appearances.planes.setdefault(target, (image, numbers.reshape(3, 4)))


def _targets(element: Element) -> list[str]:
    """Returns the ids that an appearance is for: ``<target>#id</target>``, or the attribute ``uri``."""
    uris = [(target.get("uri") or target.text or "").strip() for target in element.iter("{*}target")]
    return [name.removeprefix("#") for name in uris if name]


def _targets_above(element: Element) -> list[str]:
    """Returns the ids of the target, or of the association of CityGML 3, that holds an element."""
    for above in element.iterancestors():
        if local_name(above.tag) == "target" and above.get("uri"):
            return [str(above.get("uri")).strip().removeprefix("#")]
        if local_name(above.tag) == "TextureAssociation":
            return _targets(above)
    return []


def _georeference(texture: Element, folder: TextureFolder) -> Georeference | None:
    image = _text(texture, "imageURI")
    place = next(texture.iter("{*}pos"), None)
    orientation = numbers_of(_text(texture, "orientation"))
    if place is not None and len(orientation) == 4:
        matrix, origin = orientation.reshape(2, 2), numbers_of(place.text)[:2]
    else:
        world = _world_file(image, folder)
        if world is None:
            return None
        # Lines of a world file: a d b e c f, of x = a column + b row + c and y = d column + e row + f.
        matrix, origin = np.array([[world[0], world[2]], [world[1], world[3]]]), world[4:6]
    if len(origin) != 2 or not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-12:
        return None
    return Georeference(image, np.linalg.inv(matrix).astype(np.float64), origin)


def _world_file(image: str, folder: TextureFolder) -> Floats | None:
    stem, _, suffix = image.rpartition(".")
    for name in (f"{stem}.{suffix[:1]}{suffix[-1:]}w", f"{stem}.wld"):
        if stem and folder.path(name) is not None:
            numbers = numbers_of(folder.read(name).decode("ascii", "replace"))
            return numbers if len(numbers) == 6 else None
    return None


def numbers_of(text: str | None) -> Floats:
    """Returns the numbers of a text, none if any is no number."""
    try:
        return np.array((text or "").split(), dtype=np.float64)
    except ValueError:
        return np.zeros(0)


def _text(element: Element, name: str) -> str:
    """Returns the text of the first child of a local name."""
    child = next(element.iterchildren("{*}" + name), None)
    return "" if child is None else (child.text or "").strip()


class AppearanceReader:
    """Gathers what the members of a document say of pictures, and at its end lays them on its polygons.

    Args:
        textures: Receives them, by the serial numbers of polygons.
    """

    def __init__(self, textures: SurfaceTextures) -> None:
        self._textures = textures
        self._appearances = Appearances()
        self._rings: dict[int, tuple[str, ...]] = {}
        self._surfaces: dict[int, tuple[str, ...]] = {}

    def read_member(self, member: Element, polygons: dict[Element, int], first_serial: int) -> None:
        """Adds the appearances of a member, and the ids of its polygons and their rings."""
        read_appearances(member, self._appearances, self._textures.folder)
        above: dict[Element | None, tuple[str, ...]] = {None: ()}
        for element, number in polygons.items():
            serial = first_serial + number
            self._surfaces[serial] = _ids_up(element, above)
            self._rings[serial] = tuple(_gml_id(ring) for ring in element.iter("{*}LinearRing", "{*}Ring"))

    def lay_all(self, columns: Mapping[str, NDArray[Any]], flipped: set[int]) -> None:
        """Lays pictures and colours on the polygons of a document.

        Args:
            columns: As for ``city_of_columns``, points in the coordinates of the file.
            flipped: Serial numbers of the polygons whose rings were turned round.
        """
        found = self._appearances
        if not (found.rings or found.planes or found.grounds or found.materials):
            return
        lengths, notes = columns["ring_lengths"].tolist(), self._textures.notes
        ring = first = 0
        for serial, count in zip(columns["serial"].tolist(), columns["ring_counts"].tolist(), strict=True):
            own = lengths[ring : ring + count]
            points = columns["points"][first : first + sum(own)]
            ring, first = ring + count, first + sum(own)
            if serial < 0:
                notes["surface borrowed from another object, whose picture stays with that"] += 1
            elif not self._lay(serial, own, points, serial in flipped):
                colours = map(found.materials.get, self._surfaces.get(serial, ()))
                colour = next((each for each in colours if each is not None), None)
                if colour is not None:  # of the polygon's material, or of that of what it is part of
                    self._textures.paint(serial, colour)

    def _lay(self, serial: int, lengths: list[int], points: Floats, is_flipped: bool) -> bool:
        """Lays the picture that a polygon's outline has, else that of what it is part of, if there is any."""
        entries = [
            self._appearances.rings.get(name) if name else None for name in self._rings.get(serial, ())
        ]
        if not entries or entries[0] is None:
            whole = self._on_surface(serial, points)
            return whole is not None and self._textures.lay(serial, [len(points)], [whole])
        if len(entries) != len(lengths):
            self._textures.notes["surface with ambiguous rings"] += 1
            return False
        rings = [None if entry is None else (entry[0], _places(entry[1])) for entry in entries]
        return self._textures.lay(serial, lengths, rings, has_closing_points=True, is_flipped=is_flipped)

    def _on_surface(self, serial: int, points: Floats) -> tuple[Image, Floats] | None:
        """Returns the picture of a polygon or of what it is part of, by a matrix or a place on the ground."""
        for name in self._surfaces.get(serial, ()):
            if name in self._appearances.planes:
                image, matrix = self._appearances.planes[name]
                homogeneous = np.column_stack([points, np.ones(len(points))]) @ matrix.T
                with np.errstate(divide="ignore", invalid="ignore"):
                    return image, homogeneous[:, :2] / homogeneous[:, 2:]
            if name in self._appearances.grounds:
                ground = self._appearances.grounds[name]
                return Image(ground.image), self._on_ground(ground, points)
        return None

    def _on_ground(self, ground: Georeference, points: Floats) -> Floats:
        """Returns the places of points on a picture of the ground, none where that cannot be read."""
        try:
            width, height = self._textures.folder.size(ground.image)
        except DatasetError:
            return np.zeros((0, 2))
        pixels = (points[:, :2] - ground.origin) @ ground.inverse.T
        # The reference point is the middle of the upper left pixel.
        return np.column_stack([(pixels[:, 0] + 0.5) / width, 1.0 - (pixels[:, 1] + 0.5) / height])


def _places(text: str) -> Floats:
    """Returns (n, 2) places of a text, none if it has an odd number of numbers or something else."""
    numbers = numbers_of(text)
    return numbers.reshape(-1, 2) if len(numbers) % 2 == 0 else np.zeros((0, 2))


def _gml_id(element: Element) -> str:
    return next((str(element.get(name)) for name in GML_IDS if element.get(name)), "")


def _ids_up(element: Element, known: dict[Element | None, tuple[str, ...]]) -> tuple[str, ...]:
    """Returns the ids of an element and of all above it; ``known`` grows by those above."""
    line = list(_unknown_above(element, known))
    ids = known[line[-1].getparent()] if line else known[element]
    for node in reversed(line):
        own = _gml_id(node)
        ids = known[node] = (own, *ids) if own else ids
    return ids


def _unknown_above(element: Element, known: dict[Element | None, tuple[str, ...]]) -> Iterator[Element]:
    node: Element | None = element
    while node is not None and node not in known:
        yield node
        node = node.getparent()
