"""CityGML appearances: which picture, or colour, lies on which ring or surface, by gml:id."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.texture_pictures import TextureFolder
from lodbench.citymodel.xml import Element, local_name

Floats = NDArray[np.float64]


class Image(NamedTuple):
    """A picture by its name in the file, and how it goes on beyond its edges (``Pictures.wraps``)."""

    name: str
    wrap: str = ""


class Georeference(NamedTuple):
    """A picture that lies on the ground: (column, row) = inverse @ (x, y) - inverse @ origin."""

    image: str
    inverse: Floats
    origin: Floats


@dataclass(slots=True)
class Appearances:
    """What the appearances of a file say, by gml:id.

    Attributes:
        rings: Picture and text of coordinates of each ring.
        planes: Picture and (3, 4) matrix from world to texture of each surface.
        grounds: Georeferenced picture of each surface.
        materials: Diffuse RGB of each surface.
    """

    rings: dict[str, tuple[Image, str]] = field(default_factory=dict)
    planes: dict[str, tuple[Image, Floats]] = field(default_factory=dict)
    grounds: dict[str, Georeference] = field(default_factory=dict)
    materials: dict[str, tuple[int, int, int]] = field(default_factory=dict)


def read_appearances(member: Element, found: Appearances, folder: TextureFolder) -> None:
    """Adds what a member of the file says; what a surface was given first stays.

    Args:
        member: Any element.
        found: Receives it.
        folder: Where world files lie beside the pictures.
    """
    for texture in member.iter("{*}ParameterizedTexture"):
        _read_parameterized(texture, found)
    for texture in member.iter("{*}GeoreferencedTexture"):
        ground = _georeference(texture, folder)
        if ground is not None:
            found.grounds |= {target: ground for target in _targets(texture) if target not in found.grounds}
    for material in member.iter("{*}X3DMaterial"):
        colour = numbers_of(_text(material, "diffuseColor"))
        if len(colour) == 3:
            red, green, blue = np.rint(255 * np.clip(colour, 0.0, 1.0)).astype(int).tolist()
            for target in _targets(material):
                found.materials.setdefault(target, (red, green, blue))


def _read_parameterized(texture: Element, found: Appearances) -> None:
    image = Image(_text(texture, "imageURI"), _text(texture, "wrapMode"))
    for places in texture.iter("{*}TexCoordList"):
        coordinates = list(places.iterchildren("{*}textureCoordinates"))
        # CityGML 3 names the rings beside the coordinates, in the same order.
        rings = [ring.text or "" for ring in places.iterchildren("{*}ring")] or [""] * len(coordinates)
        for each, ring in zip(coordinates, rings, strict=False):
            name = each.get("ring") or ring
            found.rings.setdefault(name.strip().removeprefix("#"), (image, each.text or ""))
    for matrix in texture.iter("{*}worldToTexture"):
        numbers = numbers_of(matrix.text)
        if len(numbers) == 12:
            for target in _targets_above(matrix):
                found.planes.setdefault(target, (image, numbers.reshape(3, 4)))


def _targets(element: Element) -> list[str]:
    """Returns the ids that an appearance is for: ``<target>#id</target>``, or the attribute ``uri``."""
    found = [(target.get("uri") or target.text or "").strip() for target in element.iter("{*}target")]
    return [name.removeprefix("#") for name in found if name]


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
