"""Textured maps, which are rendered: triangles with pictures, of meshes, CityGML, orthophotos, cities read.

``read_textured`` reads files, ``open_textured_map`` sets what they hold over a city, ``textured_model`` takes
the surfaces of a city that was read with its pictures.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.model import FINEST, FIRST_COLOUR, NO_PICTURE, CityModel, Polygons, select_polygons
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.source import is_surface
from lodbench.citymodel.textures import (
    GREY,
    Floats,
    SurfaceTextures,
    TexturedPart,
    TextureFolder,
    counted_lines,
    read_pictures,
    require_room,
)
from lodbench.citymodel.triangulate import polygons_at, triangulate
from lodbench.errors import DatasetError
from lodbench.findings import Findings, Severity

# Share of the smaller of two plans that must lie on the other for both to be of one place.
_LEAST_OVERLAP = 0.2
_MESHES = (".obj", ".glb", ".gltf", ".ply")
_CITIES = (".gml", ".xml", ".citygml")


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

    @classmethod
    def of_parts(cls, parts: Sequence[TexturedPart]) -> TexturedMesh:
        """Returns one or more parts, all in the same coordinates, as one mesh.

        Raises:
            ValueError: There is none.
        """
        counts = [len(part.corners) for part in parts]
        has_picture = np.array([part.picture is not None for part in parts])
        numbers = np.where(has_picture, np.cumsum(has_picture) - 1, NO_PICTURE).astype(np.int32)
        places = [np.broadcast_to(part.uv, (len(part.corners), 3, 2)) for part in parts]
        colours = [
            np.broadcast_to(part.colours if part.picture is None else 0, (len(part.corners), 3, 3))
            for part in parts
        ]
        return cls(
            np.concatenate([part.corners for part in parts]),
            np.concatenate(places),
            np.repeat(numbers, counts),
            np.concatenate(colours).astype(np.uint8),
            tuple(part.picture for part in parts if part.picture is not None),
        )

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


def open_textured_map(path: Path, scene: Scene, options: ReadOptions | None = None) -> TexturedMesh:
    """Returns the textured map of a city's place, in the scene's frame; its notes say how it lay.

    Raises:
        DatasetError: As for ``read_textured``, or it lies elsewhere.
        CityModelError: As for ``read_textured``.
    """
    mesh = read_textured(path, options=options)
    offset, note = offset_to_city(mesh, scene, path.name)
    moved = mesh.shifted(offset)
    return replace(moved, notes=(note, *moved.notes))


def read_textured(path: Path, up_axis: str = "auto", options: ReadOptions | None = None) -> TexturedMesh:
    """Returns a textured mesh, in the coordinates of its file, z up.

    Files that it names lie beside or below it; others, and the network, are refused.

    Args:
        path: OBJ, glTF, PLY or CityGML, or a folder of such tiles, all in the same coordinates; or a surface
            model, with ``options.orthophoto``.
        up_axis: ``y``, ``z``, or ``auto``: y for glTF, z for the others.
        options: How to read CityGML: ``crs`` and ``axis_order``.

    Raises:
        DatasetError: It is missing, unreadable, of another kind, too large, or files it names are missing
            or lie outside; the message lists them.
        CityModelError: It is CityGML or a mesh that cannot be read, or has no triangles.
    """
    if is_surface(path):
        from lodbench.citymodel.surface.orthophoto import textured_parts

        return TexturedMesh.of_parts(textured_parts(path, options or ReadOptions()))
    if path.is_dir():
        paths = sorted(file for file in path.rglob("*") if file.suffix.lower() in _MESHES + _CITIES)
        # Beside each file macOS keeps one of its own, of the same ending.
        files = [file for file in paths if not file.name.startswith("._")]
        if not files:
            raise DatasetError(
                f"{path} holds no textured mesh.", f"Looked for {', '.join(_MESHES + _CITIES)}."
            )
        parts = [_read_file(file, path, up_axis, options or ReadOptions()) for file in files]
    else:
        parts = [_read_file(path, path.parent, up_axis, options or ReadOptions())]
    mesh = join_textured(parts)
    require_room(
        sum(picture.shape[0] * picture.shape[1] for picture in mesh.pictures),
        f"The pictures of {path} have",
        "Take the tiles round your queries only, or save the pictures smaller.",
    )
    return mesh


def files_of_textured(path: Path) -> list[Path]:
    """Returns the files that a textured mesh is read from: its own, and those it names that are there.

    Raises:
        DatasetError: As for ``named_files``.
    """
    if path.is_dir():
        return sorted(file for file in path.rglob("*") if file.is_file())
    from lodbench.citymodel.mesh.textures import named_files

    folder = TextureFolder(path.parent, path.parent)
    others, pictures = named_files(path, folder)
    paths = (folder.path(name) for name in (*others, *pictures))
    return [path, *(file for file in paths if file is not None)]


def _read_file(path: Path, root: Path, up_axis: str, options: ReadOptions) -> TexturedMesh:
    suffix = path.suffix.lower()
    if not path.is_file() or suffix not in _MESHES + _CITIES:
        what = "is no textured mesh" if path.is_file() else "does not exist"
        raise DatasetError(f"{path} {what}.", f"It takes {', '.join(_MESHES + _CITIES)}, or a folder.")
    folder = TextureFolder(root, path.parent)
    if suffix in _CITIES:
        return _read_city(path, folder, options)
    from lodbench.citymodel.mesh.textures import read_textured_mesh

    return TexturedMesh.of_parts(read_textured_mesh(path, folder, up_axis))


def _read_city(path: Path, folder: TextureFolder, options: ReadOptions) -> TexturedMesh:
    """Returns the buildings of a CityGML file at their finest levels, pictured or in colours of materials."""
    from lodbench.citymodel.gml.reader import read_citygml
    from lodbench.citymodel.polygons import finish_model

    surfaces = replace(options, is_strict=False, has_details=True, layers=())
    raw = read_citygml(lambda: path.open("rb"), str(path), surfaces, SurfaceTextures(folder))
    model = finish_model(raw, options)
    mesh = textured_model(model, "A textured map needs appearances with pictures.")
    lost = Counter(str(item.code) for item in model.findings.items if item.code.severity is Severity.ERROR)
    notes = (*counted_lines(lost), *mesh.notes)
    return replace(mesh, notes=(f"{path.name}: {'; '.join(notes)}",) if notes else ())


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
        notes = () if model.pictures is None else model.pictures.notes
        stated = f"Left out: {'; '.join(notes[:3])}." if notes else hint
        raise DatasetError(f"{model.source} has no surface with a picture.", stated)
    is_kept = (picture >= 0) | ~_lies_on_a_picture(polygons, picture)
    polygons = select_polygons(polygons, np.flatnonzero(is_kept))
    picture, uv = picture[is_kept], np.asarray(polygons.uv)
    result = triangulate(polygons, model.building_ids, Findings())
    places = uv[result.triangles]
    has_place = ~np.isnan(places.reshape(-1, 6).sum(axis=1))
    used, numbers = np.unique(np.where(has_place, picture[result.polygon], NO_PICTURE), return_inverse=True)
    is_bare = int(used[0] == NO_PICTURE)
    paths = [model.pictures.files[n] for n in used[is_bare:].tolist()]
    colours = np.array([GREY, *model.pictures.colours], np.uint8)
    colour = colours[np.maximum(FIRST_COLOUR + 1 - picture[result.polygon], 0)]
    return TexturedMesh(
        polygons.points[result.triangles] + model.origin,
        np.where(has_place[:, None, None], places, 0.0),
        (numbers.reshape(-1) - is_bare).astype(np.int32),
        np.repeat(colour[:, None], 3, axis=1),
        read_pictures(paths, model.source),
        model.pictures.notes,
    )


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
    overlaps = []
    for frame, offset in (("the city's coordinates", -scene.origin), ("local coordinates", np.zeros(3))):
        points = mesh.corners.reshape(-1, 3) + offset
        share = _overlap(points.min(axis=0), points.max(axis=0), low, high)
        if share >= _LEAST_OVERLAP:
            return offset, f"{name} is in {frame}; {share:.0%} of the smaller plan overlap"
        overlaps.append(f"{share:.0%} in {frame}")
    box = mesh.corners.reshape(-1, 3)
    raise DatasetError(
        f"{name} is not where the city is: their plans overlap {', '.join(overlaps)}. It spans x "
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
