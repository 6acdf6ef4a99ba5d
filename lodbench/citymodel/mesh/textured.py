"""Textured triangles: a city with photographed surfaces, as every reader of such files hands it over."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.model import FINEST, FIRST_COLOUR, NO_PICTURE, CityModel, Polygons, select_polygons
from lodbench.citymodel.pictures import MAX_ALL_PIXELS, TextureFolder
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.triangulate import polygons_at, triangulate
from lodbench.errors import DatasetError
from lodbench.findings import Findings

Floats = NDArray[np.float64]

# Share of the smaller of two plans that must lie on the other for both to be of one place.
_LEAST_OVERLAP = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class TexturedMesh:
    """Triangles with textures or colours, east, north, up in metres."""

    corners: Floats  # (T, 3, 3) float64, metres
    # (T, 3, 2) float64 texture coordinates; (0, 0) is a picture's lower left corner, and what is outside of 0
    # to 1 repeats the picture
    uv: Floats
    picture: NDArray[np.int32]  # (T,) int32 number of the texture, or -1 for ``colours``
    colours: NDArray[np.uint8]  # (T, 3, 3) uint8 RGB of the corners, where there is no texture
    pictures: tuple[NDArray[np.uint8], ...]  # the textures, (H, W, 3) uint8 RGB
    notes: tuple[str, ...] = ()  # what was met while reading, a line each

    def shifted(self, offset_m: Floats) -> TexturedMesh:
        """Returns the mesh moved by (3,) metres."""
        return replace(self, corners=self.corners + offset_m)

    def in_order(self, order: NDArray[np.int64]) -> TexturedMesh:
        """Returns the mesh of some of its triangles, in an order."""
        return replace(
            self,
            corners=self.corners[order],
            uv=self.uv[order],
            picture=self.picture[order],
            colours=self.colours[order],
        )

    def digest(self) -> str:
        """Returns a 16-digit hexadecimal fingerprint of triangles and pictures."""
        state = hashlib.blake2b(digest_size=8)
        arrays: list[NDArray[np.generic]] = [
            self.corners,
            self.uv,
            self.picture,
            self.colours,
            *self.pictures,
        ]
        for array in arrays:
            state.update(repr(array.shape).encode())
            state.update(np.ascontiguousarray(array).tobytes())
        return state.hexdigest()


def join_textured(parts: Sequence[TexturedMesh]) -> TexturedMesh:
    """Returns one or more meshes, all in the same coordinates, as one."""
    starts = np.cumsum([0, *[len(part.pictures) for part in parts[:-1]]])
    numbers = [
        np.where(part.picture < 0, -1, part.picture + start)
        for part, start in zip(parts, starts, strict=True)
    ]
    return TexturedMesh(
        np.concatenate([part.corners for part in parts]),
        np.concatenate([part.uv for part in parts]),
        np.concatenate(numbers).astype(np.int32),
        np.concatenate([part.colours for part in parts]),
        tuple(picture for part in parts for picture in part.pictures),
        tuple(dict.fromkeys(note for part in parts for note in part.notes)),
    )


def offset_to_city(
    mesh: TexturedMesh, scene: Scene, name: str, cure: str = "glTF is read with y up, other files with z up."
) -> tuple[Floats, str]:
    """Returns what brings a mesh into a scene's frame, (3,) metres, and what was found out about it.

    Its coordinates may be the city's, or the scene's local ones; where it lies over the city decides.

    Args:
        mesh: In the coordinates of its file.
        scene: The city.
        name: The file's, for messages.
        cure: What else to say where it lies elsewhere: it may lie on its side.

    Raises:
        DatasetError: It lies over the city in neither.
    """
    low, high = scene.extent_m
    found = []
    for frame, offset in (("the city's coordinates", -scene.origin), ("local coordinates", np.zeros(3))):
        points = mesh.corners.reshape(-1, 3) + offset
        share = _overlap(points.min(axis=0), points.max(axis=0), low, high)
        if share >= _LEAST_OVERLAP:
            return offset, f"{name} is in {frame}; {share:.0%} of the smaller plan overlap"
        found.append(f"{share:.0%} in {frame}")
    box = mesh.corners.reshape(-1, 3)
    raise DatasetError(
        f"{name} is not where the city is: their plans overlap {', '.join(found)}. It spans x "
        f"{box[:, 0].min():.0f} to {box[:, 0].max():.0f}, y {box[:, 1].min():.0f} to {box[:, 1].max():.0f}.",
        f"Move it into the city's coordinates. {cure}",
    )


def _overlap(low: Floats, high: Floats, other_low: Floats, other_high: Floats) -> float:
    """Returns the common share of the smaller of two plans; 0 where their heights have nothing in common."""
    common = np.minimum(high, other_high) - np.maximum(low, other_low)
    if (common[:2] <= 0).any() or common[2] < 0:
        return 0.0
    areas = [float((b - a)[:2].prod()) for a, b in ((low, high), (other_low, other_high))]
    return float(common[:2].prod()) / max(min(areas), 1e-9)


_GREY = 170  # of surfaces without picture and material


def textured_model(model: CityModel, hint: str = "Leave out --textures.") -> TexturedMesh:
    """Returns the surfaces of a city, each building's finest, in the coordinates of its reference system.

    Those without a picture have the colour of their material, or grey.

    Args:
        model: Read with ``ReadOptions(has_details=True, has_textures=True)``.
        hint: What to do where the file says nothing of pictures.

    Raises:
        DatasetError: It has no pictures, or more pixels than can be held at once.
    """
    _, is_finest = polygons_at(model, FINEST, Findings())
    polygons = select_polygons(model.polygons, np.flatnonzero(is_finest))
    picture, uv = polygons.picture, polygons.uv
    if model.pictures is None or picture is None or uv is None or not (picture >= 0).any():
        stated = "" if model.pictures is None else "; ".join(model.pictures.notes)
        raise DatasetError(f"{model.source} has no surface with a picture.", stated or hint)
    is_seen = (picture >= 0) | ~_lies_on_a_picture(polygons, picture)
    polygons = select_polygons(polygons, np.flatnonzero(is_seen))
    picture, uv = picture[is_seen], np.asarray(polygons.uv)
    result = triangulate(polygons, model.building_ids, Findings())
    places = uv[result.triangles]
    has_place = ~np.isnan(places.reshape(-1, 6).sum(axis=1))
    used, numbers = np.unique(np.where(has_place, picture[result.polygon], NO_PICTURE), return_inverse=True)
    is_bare = int(used[0] == NO_PICTURE)
    paths = [model.pictures.files[n] for n in used[is_bare:].tolist()]
    colours = np.array([(_GREY, _GREY, _GREY), *model.pictures.colours], np.uint8)
    colour = colours[np.maximum(FIRST_COLOUR + 1 - picture[result.polygon], 0)]
    return TexturedMesh(
        polygons.points[result.triangles] + model.origin,
        np.where(has_place[:, None, None], places, 0.0),
        (numbers.reshape(-1) - is_bare).astype(np.int32),
        np.repeat(colour[:, None], 3, axis=1),
        _pictures(paths, model.source),
        model.pictures.notes,
    )


def _pictures(paths: list[Path], source: str) -> tuple[NDArray[np.uint8], ...]:
    """Returns pictures, (H, W, 3) RGB, if all together are few enough to be held."""
    folders = [(path, TextureFolder(path.parent, path.parent)) for path in paths]
    pixels = sum(int(np.prod(folder.size(path.name))) for path, folder in folders)
    if pixels > MAX_ALL_PIXELS:
        raise DatasetError(
            f"The pictures of {source} have {pixels / 1e9:.1f} gigapixels; {MAX_ALL_PIXELS / 1e9:.1f} "
            "are held at once.",
            "Take tiles of it, or save the pictures smaller; CityJSON and CityGML copy them as they are.",
        )
    return tuple(folder.picture(path.name) for path, folder in folders)


def _lies_on_a_picture(polygons: Polygons, picture: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Returns (P,) whether one of the same corners, or the polygon itself, has a picture.

    Buildings borrow each other's walls, but not what lies on them.
    """
    first = polygons.ring_starts[polygons.polygon_starts[:-1]]
    ends = np.stack(
        [np.minimum.reduceat(polygons.points, first), np.maximum.reduceat(polygons.points, first)]
    )
    middle = (
        np.add.reduceat(polygons.points, first) / np.diff(np.append(first, len(polygons.points)))[:, None]
    )
    keys = np.round(np.hstack([*ends, middle]) * 1000).astype(np.int64)
    _, place = np.unique(keys, axis=0, return_inverse=True)
    place = place.reshape(-1)
    return np.asarray((np.bincount(place, picture >= 0) > 0)[place])
