"""A city with pictures as textured triangles."""

from __future__ import annotations

import numpy as np

from lodbench.citymodel.lods import FINEST, polygons_at
from lodbench.citymodel.model import CityModel
from lodbench.citymodel.pictures import NO_PICTURE
from lodbench.citymodel.selection import select_polygons
from lodbench.citymodel.texture_pictures import MAX_ALL_PIXELS, TextureFolder
from lodbench.citymodel.textured_mesh import TexturedMesh
from lodbench.citymodel.triangulate import triangulate
from lodbench.errors import DatasetError
from lodbench.findings import Findings

_GREY = 170  # of surfaces without a picture


def textured_model(model: CityModel) -> TexturedMesh:
    """Returns the surfaces of a city, each building's finest, in the coordinates of its reference system.

    Args:
        model: Read with ``ReadOptions(has_details=True, has_textures=True)``.

    Raises:
        DatasetError: It has no pictures, or more pixels than can be held at once.
    """
    _, is_finest = polygons_at(model, FINEST, Findings())
    polygons = select_polygons(model.polygons, np.flatnonzero(is_finest))
    picture, uv = polygons.picture, polygons.uv
    if model.pictures is None or picture is None or uv is None or not (picture >= 0).any():
        told = "" if model.pictures is None else "; ".join(model.pictures.notes)
        hint = told or "Leave out --textures."
        raise DatasetError(f"{model.source} has no pictures that can be kept.", hint)
    result = triangulate(polygons, model.building_ids, Findings())
    places = uv[result.triangles]
    has_place = ~np.isnan(places.reshape(-1, 6).sum(axis=1))
    used, numbers = np.unique(np.where(has_place, picture[result.polygon], NO_PICTURE), return_inverse=True)
    is_bare = int(used[0] == NO_PICTURE)
    paths = [model.pictures.files[n] for n in used[is_bare:].tolist()]
    folders = [(path, TextureFolder(path.parent, path.parent)) for path in paths]
    pixels = sum(int(np.prod(folder.size(path.name))) for path, folder in folders)
    if pixels > MAX_ALL_PIXELS:
        raise DatasetError(
            f"The pictures of {model.source} have {pixels / 1e9:.1f} gigapixels; {MAX_ALL_PIXELS / 1e9:.1f} "
            "are held at once.",
            "Write tiles of it, or CityJSON or CityGML, which copy them.",
        )
    return TexturedMesh(
        polygons.points[result.triangles] + model.origin,
        np.where(has_place[:, None, None], places, 0.0),
        (numbers.reshape(-1) - is_bare).astype(np.int32),
        np.full((len(places), 3, 3), _GREY, np.uint8),
        tuple(folder.picture(path.name) for path, folder in folders),
        model.pictures.notes,
    )
