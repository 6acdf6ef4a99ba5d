"""CityGML with textures: the buildings of a file as textured triangles.

Read in two passes, because an appearance may stand anywhere in the file: first the textures by the ids
they name, then the polygons of each building at its finest level of detail.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.coordinates import parse_rings
from lodbench.citymodel.frame import to_metres
from lodbench.citymodel.gml_appearance import Appearances, Georeference, numbers_of, read_appearances
from lodbench.citymodel.gml_names import (
    BUILDINGS,
    GEOMETRY_PROPERTIES,
    GML_IDS,
    INTERIOR_NAMES,
    MEMBERS,
    POLYGONS,
    is_building_tag,
    property_lod,
)
from lodbench.citymodel.model import Polygons
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.raw import starts_of
from lodbench.citymodel.texture_pictures import TextureFolder
from lodbench.citymodel.textured_mesh import TexturedMesh
from lodbench.citymodel.triangulate import triangulate
from lodbench.citymodel.xml import Element, XmlMembers, local_name
from lodbench.errors import CityModelError, DatasetError
from lodbench.findings import Findings

Floats = NDArray[np.float64]

# What has neither texture nor material.
_GREY = (170, 170, 170)
# What no texture coordinates have in common with: marks rings without.
_NO_PICTURE = -1


class _Ring(NamedTuple):
    """A ring as the file has it: its id, and its numbers as text."""

    id: str
    text: str


class _Face(NamedTuple):
    """A polygon: the ids of it and of the surfaces that hold it, innermost first, and its rings."""

    ids: tuple[str, ...]
    rings: tuple[_Ring, ...]


def read_gml_textures(path: Path, folder: TextureFolder, options: ReadOptions) -> TexturedMesh:
    """Returns the buildings of a CityGML file with their textures, in metres of its reference system.

    ParameterizedTexture (by ring, or by a world-to-texture matrix), GeoreferencedTexture (by reference point
    and orientation, or a world file beside the picture) and the diffuse colour of X3DMaterial. Of several
    themes the first that names a surface counts. Surfaces of other buildings that are referred to by XLink
    are drawn once, where they stand.

    Args:
        path: The file.
        folder: Where its pictures are.
        options: ``crs`` and ``axis_order``.

    Raises:
        CityModelError: The XML is damaged or refused, or has no building.
        DatasetError: It has no textures, or none of their pictures is there.
    """
    appearances, faces = Appearances(), []
    srs_name: str | None = None
    with path.open("rb") as stream:
        members = XmlMembers(stream, str(path), MEMBERS, Findings())
        for member in members:
            read_appearances(member, appearances, folder)
    with path.open("rb") as stream:
        members = XmlMembers(stream, str(path), MEMBERS, Findings())
        for member in members:
            if srs_name is None and members.root is not None:
                srs_name = _srs_name(members.root)
            for building in member.iter(*BUILDINGS):
                if is_building_tag(building.tag):
                    faces += _faces(building)
    if not faces:
        raise CityModelError(f"{path} has no building with surfaces.", "Is it the building tile of the city?")
    if not (appearances.rings or appearances.planes or appearances.grounds):
        raise DatasetError(f"{path} has no textures.", "A textured map needs appearances with pictures.")
    return _Assembly(path, folder, options, appearances).mesh(faces, srs_name)


def _faces(building: Element) -> list[_Face]:
    """Returns the polygons of a building at its finest level of detail."""
    by_lod: dict[str, list[Element]] = {}
    for prop in building.iter(*GEOMETRY_PROPERTIES):
        lod = property_lod(prop.tag)
        is_inside = any(local_name(above.tag) in INTERIOR_NAMES for above in prop.iterancestors())
        if lod is not None and not is_inside and next(prop.iter(*POLYGONS), None) is not None:
            by_lod.setdefault(lod, []).append(prop)
    finest = by_lod[max(by_lod)] if by_lod else []
    return [_face(polygon) for prop in finest for polygon in prop.iter(*POLYGONS)]


def _face(polygon: Element) -> _Face:
    ids = [_gml_id(polygon), *(_gml_id(above) for above in polygon.iterancestors())]
    rings = []
    for ring in polygon.iter("{*}LinearRing", "{*}Ring"):
        texts = [numbers.text or "" for numbers in ring.iter("{*}posList", "{*}pos")]
        rings.append(_Ring(_gml_id(ring), " ".join(texts)))
    return _Face(tuple(name for name in ids if name), tuple(rings))


class _Assembly:
    """Puts faces and appearances of one file together."""

    def __init__(
        self, path: Path, folder: TextureFolder, options: ReadOptions, appearances: Appearances
    ) -> None:
        self._path, self._folder, self._options, self._found = path, folder, options, appearances
        self._numbers: dict[str, int] = {}
        self._pictures: list[NDArray[np.uint8]] = []
        self._faults: Counter[str] = Counter()

    def mesh(self, faces: list[_Face], srs_name: str | None) -> TexturedMesh:
        """Returns the faces as triangles with textures."""
        texts = [ring.text for face in faces for ring in face.rings]
        values, counts, is_bad = parse_rings(texts)
        starts = starts_of(counts)
        points, uvs, picture, colours = [], [], [], []
        ring_counts, ring_lengths, ring = [], [], 0
        for face in faces:
            mine = range(ring, ring + len(face.rings))
            ring += len(face.rings)
            if any(is_bad[k] or counts[k] % 3 or counts[k] < 12 for k in mine) or not mine:
                self._faults["x polygon without three points"] += 1
                continue
            corners = [values[starts[k] : starts[k + 1]].reshape(-1, 3) for k in mine]
            number, textured = self._texture(face, corners)
            # Rings end with their first point again.
            points += [corner[:-1] for corner in corners]
            uvs += [part[:-1] for part in textured]
            ring_lengths += [len(corner) - 1 for corner in corners]
            ring_counts.append(len(corners))
            picture.append(number)
            colours.append(self._colour(face))
        if not points:
            raise CityModelError(
                f"{self._path} has no building with surfaces.", "Look at lodbench city check."
            )
        if not self._numbers:
            raise DatasetError(f"{self._path} has no surface with a texture that fits it.", self._told())
        if not self._pictures:
            raise DatasetError(
                f"None of the {len(self._numbers)} pictures of {self._path} is there: "
                f"{', '.join(sorted(self._numbers)[:3])}.",
                "Download the pictures of the tile too, and keep their folder beside it.",
            )
        flat = np.concatenate(points)
        to_metres(flat, srs_name, self._options.crs, Findings(), self._options.axis_order)
        rings = np.array(ring_lengths), np.array(ring_counts)
        painted = np.array(picture), np.array(colours, np.uint8)
        return self._triangles(flat, np.concatenate(uvs), *painted, rings)

    def _told(self) -> str:
        return "; ".join(f"{times} {what}" for what, times in sorted(self._faults.items()))

    def _colour(self, face: _Face) -> tuple[int, int, int]:
        materials = self._found.materials
        return next((materials[name] for name in face.ids if name in materials), _GREY)

    def _triangles(
        self,
        points: Floats,
        uv: Floats,
        picture: NDArray[np.int64],
        colours: NDArray[np.uint8],
        rings: tuple[NDArray[np.int64], NDArray[np.int64]],
    ) -> TexturedMesh:
        """Returns polygons, given by points per ring and rings per polygon, as triangles."""
        count, middle = len(picture), np.median(points, axis=0)
        blank = np.zeros(count, np.int32)
        polygons = Polygons(
            points - middle,
            starts_of(rings[0]),
            starts_of(rings[1]),
            blank,
            blank.astype(np.int16),
            blank.astype(np.uint8),
        )
        result = triangulate(polygons, (self._path.name,), Findings())
        of = result.polygon
        notes = (f"{self._path.name}: {self._told()}",) if self._faults else ()
        return TexturedMesh(
            points[result.triangles],
            uv[result.triangles],
            picture[of].astype(np.int32),
            np.repeat(colours[of][:, None], 3, axis=1),
            tuple(self._pictures),
            notes,
        )

    def _texture(self, face: _Face, corners: list[Floats]) -> tuple[int, list[Floats]]:
        """Returns the picture of a face, -1 for none, and (P, 2) coordinates of each of its rings."""
        blank = [np.zeros((len(corner), 2)) for corner in corners]
        named = [self._found.rings.get(ring.id) for ring in face.rings]
        if named and named[0] is not None:
            parts = [numbers_of(entry[1]) if entry else np.zeros(0) for entry in named]
            fits = all(
                len(p) == 2 * len(c) and np.isfinite(p).all() for p, c in zip(parts, corners, strict=True)
            )
            if not fits:
                self._faults["x texture coordinates that do not fit their ring"] += 1
                return _NO_PICTURE, blank
            return self._picture(named[0][0]), [part.reshape(-1, 2) for part in parts]
        for name in face.ids:
            if name in self._found.planes:
                image, matrix = self._found.planes[name]
                homogeneous = [np.column_stack([c, np.ones(len(c))]) @ matrix.T for c in corners]
                return self._picture(image), [h[:, :2] / h[:, 2:] for h in homogeneous]
            if name in self._found.grounds:
                return self._on_ground(self._found.grounds[name], corners)
        return _NO_PICTURE, blank

    def _on_ground(self, ground: Georeference, corners: list[Floats]) -> tuple[int, list[Floats]]:
        number = self._picture(ground.image)
        if number < 0:
            return number, [np.zeros((len(corner), 2)) for corner in corners]
        height, width = self._pictures[number].shape[:2]
        pixels = [(corner[:, :2] - ground.origin) @ ground.inverse.T for corner in corners]
        # The reference point is the middle of the upper left pixel.
        return number, [
            np.column_stack([(p[:, 0] + 0.5) / width, 1.0 - (p[:, 1] + 0.5) / height]) for p in pixels
        ]

    def _picture(self, image: str) -> int:
        """Returns the number of a picture, read when first asked for; -1 where it is not there."""
        if image not in self._numbers:
            if self._folder.path(image) is None:
                self._numbers[image] = _NO_PICTURE
                self._faults[f"x picture not there: {image[:120]}"] += 1
            else:
                self._pictures.append(self._folder.picture(image))
                self._numbers[image] = len(self._pictures) - 1
        return self._numbers[image]


def _gml_id(element: Element) -> str:
    return next((str(element.get(name)) for name in GML_IDS if element.get(name)), "")


def _srs_name(element: Element) -> str | None:
    """Returns the first reference system that an element or one below it declares."""
    for below in element.iter():
        name = below.get("srsName")
        if name is not None:
            return str(name).strip()
    return None
