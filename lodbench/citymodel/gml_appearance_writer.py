"""Appearances of CityGML: which part of a picture lies on which ring."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from lodbench.citymodel.gml_dialect import Dialect, tag
from lodbench.citymodel.gml_properties import text_of
from lodbench.citymodel.model import Polygons

_THEME = "pictures"


class AppearanceXml:
    """Collects the rings of polygons with pictures while these are written.

    Args:
        polygons: Of the city.
        dialect: The version of CityGML.
        names: Name of each picture that is there, by number.
        wraps: How they go on beyond their edges, likewise, where that is known.
    """

    def __init__(
        self, polygons: Polygons, dialect: Dialect, names: dict[int, str], wraps: dict[int, str]
    ) -> None:
        self._polygons, self._dialect, self._names, self._wraps = polygons, dialect, names, wraps
        self._found: dict[int, dict[str, list[tuple[str, str]]]] = defaultdict(lambda: defaultdict(list))

    def add(self, polygon: int, polygon_id: str, ring: int, points: slice) -> str | None:
        """Returns the id that a ring gets because a picture lies on it, or None.

        Args:
            polygon: Its polygon.
            polygon_id: And that one's id.
            ring: Which of its rings.
            points: The ring's points among those of the city.
        """
        picture, uv = self._polygons.picture, self._polygons.uv
        if picture is None or uv is None or int(picture[polygon]) not in self._names:
            return None
        places = uv[points]
        if not np.isfinite(places).all():
            return None
        closed = np.concatenate([places, places[:1]])
        text = " ".join(["%.7g"] * closed.size) % tuple(closed.ravel().tolist())
        ring_id = f"{polygon_id}-ring{ring}"
        self._found[int(picture[polygon])][polygon_id].append((ring_id, text))
        return ring_id

    def take(self) -> str:
        """Returns the appearance of all that was added, and forgets it; nothing where there is none."""
        textures = [self._texture(number, targets) for number, targets in sorted(self._found.items())]
        self._found.clear()
        if not textures:
            return ""
        is_old = self._dialect.version == "2.0"
        holder = "app:surfaceDataMember" if is_old else "app:surfaceData"
        data = "".join(tag(holder, texture) for texture in textures)
        appearance = tag("app:Appearance", tag("app:theme", _THEME) + data)
        return tag("app:appearanceMember" if is_old else "core:appearanceMember", appearance) + "\n"

    def _texture(self, picture: int, targets: dict[str, list[tuple[str, str]]]) -> str:
        name = self._names[picture]
        mime = "image/jpeg" if name.endswith(".jpg") else "image/png"
        head = tag("app:imageURI", text_of(name)) + tag("app:mimeType", mime)
        head += tag("app:wrapMode", self._wraps[picture]) if picture in self._wraps else ""
        target = self._target_2 if self._dialect.version == "2.0" else self._target_3
        return tag(
            "app:ParameterizedTexture", head + "".join(target(name, rings) for name, rings in targets.items())
        )

    def _target_2(self, polygon_id: str, rings: list[tuple[str, str]]) -> str:
        places = "".join(tag("app:textureCoordinates", text, ring=f"#{ring}") for ring, text in rings)
        return tag("app:target", tag("app:TexCoordList", places), uri=f"#{polygon_id}")

    def _target_3(self, polygon_id: str, rings: list[tuple[str, str]]) -> str:
        places = "".join(tag("app:textureCoordinates", text) for _, text in rings)
        places += "".join(tag("app:ring", f"#{ring}") for ring, _ in rings)
        inside = tag("app:textureParameterization", tag("app:TexCoordList", places))
        association = tag("app:TextureAssociation", tag("app:target", f"#{polygon_id}") + inside)
        return tag("app:textureParameterization", association)
