"""Pictures of surfaces in CityGML: from appearances, which name rings and surfaces by id, to polygons."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.gml_appearance import (
    Appearances,
    Floats,
    Georeference,
    Image,
    numbers_of,
    read_appearances,
)
from lodbench.citymodel.gml_names import GML_IDS
from lodbench.citymodel.pictures import NO_PICTURE, PictureTable, blank
from lodbench.citymodel.xml import Element
from lodbench.errors import DatasetError


class SurfacePictures:
    """Gathers what the members of a document say of pictures, and puts it together at its end."""

    def __init__(self, pictures: PictureTable) -> None:
        self._pictures = pictures
        self._found = Appearances()
        self._rings: dict[int, tuple[str, ...]] = {}
        self._surfaces: dict[int, tuple[str, ...]] = {}

    def read_member(self, member: Element, polygons: dict[Element, int], first_serial: int) -> None:
        """Adds the appearances of a member, and the ids of its polygons and their rings."""
        read_appearances(member, self._found, self._pictures.folder)
        above: dict[Element | None, tuple[str, ...]] = {None: ()}
        for element, number in polygons.items():
            serial = first_serial + number
            self._surfaces[serial] = _ids_up(element, above)
            self._rings[serial] = tuple(_gml_id(ring) for ring in element.iter("{*}LinearRing", "{*}Ring"))

    def paint(
        self,
        serial: NDArray[np.int64],
        points: NDArray[np.float64],
        ring_starts: NDArray[np.int64],
        polygon_starts: NDArray[np.int64],
        flipped: set[int],
    ) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
        """Returns the picture of each polygon and the place of each point on it.

        Args:
            serial: (N,) serial number of each polygon, -1 for copies.
            points: (P, 3) in the coordinates of the file.
            ring_starts: (R + 1,) offsets into the points.
            polygon_starts: (N + 1,) offsets into the rings.
            flipped: Serial numbers of the polygons whose rings were turned round.
        """
        picture, uv = blank(len(serial), len(points))
        found, notes = self._found, self._pictures.notes
        if not (found.rings or found.planes or found.grounds or found.materials):
            return picture, uv
        for polygon, number in enumerate(serial.tolist()):
            starts = ring_starts[polygon_starts[polygon] : polygon_starts[polygon + 1] + 1]
            own = points[starts[0] : starts[-1]]
            if number < 0:
                notes["surface borrowed from another object, whose picture stays with that"] += 1
                continue
            name, places = self._by_ring(number, np.diff(starts), number in flipped)
            if name is None:
                name, places = self._by_surface(number, own)
            if name is not None and places is not None:
                picture[polygon] = self._pictures.number(*name)
                if picture[polygon] != NO_PICTURE:
                    uv[starts[0] : starts[-1]] = places
                    continue
                notes["surface whose picture is not there"] += 1
            picture[polygon] = self._colour(number)
        return picture, uv

    def _colour(self, serial: int) -> int:
        """Returns the number of the colour of a polygon's material, or of that of what it is part of."""
        colours = (self._found.materials.get(name) for name in self._surfaces.get(serial, ()))
        return next((self._pictures.colour(each) for each in colours if each is not None), NO_PICTURE)

    def _by_ring(
        self, serial: int, lengths: NDArray[np.int64], is_flipped: bool
    ) -> tuple[Image | None, Floats | None]:
        """Returns the picture that the outline of a polygon has, and the places of all its corners."""
        rings = self._rings.get(serial, ())
        entries = [self._found.rings.get(name) if name else None for name in rings]
        if not entries or entries[0] is None:
            return None, None
        if len(entries) != len(lengths):
            self._pictures.notes["surface with ambiguous rings"] += 1
            return entries[0][0], None
        image = entries[0][0]
        parts: list[Floats] = []
        for entry, length in zip(entries, lengths.tolist(), strict=True):
            places = np.full((length, 2), np.nan)
            numbers = numbers_of(entry[1]) if entry is not None and entry[0] == image else np.zeros(0)
            if len(numbers) == 2 * length - 2:  # some writers leave out the closing point
                numbers = np.append(numbers, numbers[:2])
            if len(numbers) == 2 * length and np.isfinite(numbers).all():
                places[:] = numbers.reshape(-1, 2)
            elif not parts:
                self._pictures.notes["surface whose places on its picture do not fit its corners"] += 1
                return image, None
            parts.append(places[::-1] if is_flipped else places)
        return image, np.concatenate(parts)

    def _by_surface(self, serial: int, points: Floats) -> tuple[Image | None, Floats | None]:
        """Returns the picture of a polygon or of what it is part of, by a matrix or a place on the ground."""
        for name in self._surfaces.get(serial, ()):
            if name in self._found.planes:
                image, matrix = self._found.planes[name]
                homogeneous = np.column_stack([points, np.ones(len(points))]) @ matrix.T
                places: Floats = homogeneous[:, :2] / homogeneous[:, 2:]
                return image, places if np.isfinite(places).all() else None
            if name in self._found.grounds:
                return Image(self._found.grounds[name].image), self._on_ground(
                    self._found.grounds[name], points
                )
        return None, None

    def _on_ground(self, ground: Georeference, points: Floats) -> Floats | None:
        try:
            width, height = self._pictures.folder.size(ground.image)
        except DatasetError:
            return None
        pixels = (points[:, :2] - ground.origin) @ ground.inverse.T
        # The reference point is the middle of the upper left pixel.
        return np.column_stack([(pixels[:, 0] + 0.5) / width, 1.0 - (pixels[:, 1] + 0.5) / height])


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
