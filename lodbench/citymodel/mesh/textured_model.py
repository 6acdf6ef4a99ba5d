"""A city with pictures as textured triangles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.lods import FINEST, polygons_at
from lodbench.citymodel.mesh.textured import TexturedMesh
from lodbench.citymodel.model import CityModel, Polygons
from lodbench.citymodel.pictures import FIRST_COLOUR, NO_PICTURE
from lodbench.citymodel.selection import select_polygons
from lodbench.citymodel.texture_pictures import MAX_ALL_PIXELS, TextureFolder
from lodbench.citymodel.triangulate import triangulate
from lodbench.errors import DatasetError
from lodbench.findings import Findings

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
        told = "" if model.pictures is None else "; ".join(model.pictures.notes)
        raise DatasetError(f"{model.source} has no surface with a picture.", told or hint)
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
