"""Pictures of surfaces in CityJSON: read from appearances, and written as such."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.model import Polygons
from lodbench.citymodel.pictures import NO_PICTURE, PictureTable
from lodbench.errors import CityModelError

Json = dict[str, Any]
_THEME = "pictures"


class TextureReader:
    """Reads which pictures lie on the surfaces of geometries, of the default theme or else the first.

    Raises:
        CityModelError: The places on the pictures are no pairs of numbers.
    """

    def __init__(self, appearance: Json, pictures: PictureTable, source: str) -> None:
        self._pictures = pictures
        self._theme = appearance.get("default-theme-texture")
        textures = appearance.get("textures")
        self._images = [
            (str(texture.get("image", "")), str(texture.get("wrapMode") or ""))
            if isinstance(texture, dict)
            else ("", "")
            for texture in (textures if isinstance(textures, list) else ())
        ]
        try:
            self._places = np.asarray(appearance.get("vertices-texture") or [], np.float64).reshape(-1, 2)
        except (TypeError, ValueError, OverflowError) as error:
            raise CityModelError(
                f"{source} has malformed vertices of textures ({error}).",
                "Mend them, or leave out `--textures`.",
            ) from None
        if appearance.get("materials"):
            pictures.notes["list of materials: colours of surfaces"] += 1

    def read(
        self, geometry: Json, surfaces: Sequence[Any], depth: int
    ) -> dict[int, tuple[int, NDArray[np.float64]]]:
        """Returns the picture of surfaces that have one, and the places of all their corners on it.

        Args:
            geometry: With a member ``texture``.
            surfaces: Its surfaces, in their order.
            depth: How many lists stand around a surface.
        """
        themes = geometry["texture"]
        if not isinstance(themes, dict) or not themes:
            return {}
        theme = self._theme if self._theme in themes else next(iter(themes))
        if len(themes) > 1:
            self._pictures.notes[f"theme of pictures besides {str(theme)[:60]!r}"] += len(themes) - 1
        values = themes[theme].get("values") if isinstance(themes[theme], dict) else None
        try:
            for _ in range(depth):
                values = list(chain.from_iterable(values or ()))
            if values is None or len(values) != len(surfaces):
                raise ValueError("another number of surfaces")
            found = {n: self._surface(*pair) for n, pair in enumerate(zip(surfaces, values, strict=True))}
        except (TypeError, ValueError, LookupError):
            self._pictures.notes["geometry with textures nested otherwise than its surfaces"] += 1
            return {}
        return {n: one for n, one in found.items() if one is not None}

    def _surface(self, surface: list[Any], labels: Any) -> tuple[int, NDArray[np.float64]] | None:
        """Returns the picture of a surface and (P, 2) places of its corners, NaN on rings without any."""
        if not labels or not labels[0] or type(labels[0][0]) is not int:
            return None
        image = labels[0][0]
        picture = (
            self._pictures.number(*self._images[image]) if 0 <= image < len(self._images) else NO_PICTURE
        )
        if picture == NO_PICTURE:
            self._pictures.notes["surface whose picture is not there"] += 1
            return None
        places = [np.full((len(ring), 2), np.nan) for ring in surface]
        for own, label in zip(places, labels, strict=False):
            corners = label[1:] if label else []
            if not label or label[0] != image or len(corners) != len(own):
                continue
            if all(type(k) is int and 0 <= k < len(self._places) for k in corners):
                own[:] = self._places[corners]
        if not np.isfinite(places[0]).all():
            self._pictures.notes["surface whose places on its picture do not fit its corners"] += 1
            return None
        return picture, np.concatenate(places)


class TextureWriter:
    """Collects the textures of a document or feature."""

    def __init__(self, polygons: Polygons, names: dict[int, str], wraps: dict[int, str]) -> None:
        self._polygons, self._names, self._wraps = polygons, names, wraps
        self._textures: dict[int, int] = {}
        self._places: dict[tuple[float, ...], int] = {}

    def values(self, faces: Any) -> Any:
        """Returns the texture values of polygons, nested as these are; a polygon is (number, is turned)."""
        if isinstance(faces, list):
            return [self.values(face) for face in faces]
        polygon, is_flipped = faces
        polygons = self._polygons
        rings = range(polygons.polygon_starts[polygon], polygons.polygon_starts[polygon + 1])
        if polygons.picture is None or polygons.uv is None or polygons.picture[polygon] not in self._names:
            return [[None] for _ in rings]
        number = self._textures.setdefault(int(polygons.picture[polygon]), len(self._textures))
        values: list[list[int | None]] = []
        for ring in rings:
            uv = polygons.uv[polygons.ring_starts[ring] : polygons.ring_starts[ring + 1]]
            if not np.isfinite(uv).all():
                values.append([None])
                continue
            places = [tuple(place) for place in np.round(uv, 7).tolist()]
            indices = [self._places.setdefault(place, len(self._places)) for place in places]
            values.append([number, *(indices[::-1] if is_flipped else indices)])
        return values

    def texture(self, faces: list[Any]) -> Json:
        """Returns the member ``texture`` of a geometry, or nothing where it has none."""
        values = self.values(faces)
        return {"texture": {_THEME: {"values": values}}} if _has_any(values) else {}

    def appearance(self) -> Json:
        """Returns the member ``appearance`` of the document, or nothing where it has none."""
        if not self._textures:
            return {}
        names = [(self._names[picture], self._wraps.get(picture)) for picture in self._textures]
        textures = [
            {"type": "JPG" if name.endswith(".jpg") else "PNG", "image": name}
            | ({"wrapMode": wrap} if wrap else {})
            for name, wrap in names
        ]
        places = [list(place) for place in self._places]
        return {
            "appearance": {
                "textures": textures, "vertices-texture": places, "default-theme-texture": _THEME,
            }
        }  # fmt: skip


def _has_any(values: Any) -> bool:
    if isinstance(values, list):
        return any(map(_has_any, values))
    return values is not None
