"""Reading textured maps: OBJ with materials, glTF, PLY with colours, CityGML with appearances, tiles."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.citygml import read_citygml
from lodbench.citymodel.mesh_reader import load_parts, turned_up
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.pictures import PictureTable, counted_lines
from lodbench.citymodel.polygons import finish_model
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.texture_names import embedded_pictures, named_files, picture_name
from lodbench.citymodel.texture_pictures import MAX_ALL_PIXELS, TextureFolder, check_picture, pixels_of
from lodbench.citymodel.textured_mesh import TexturedMesh, join_textured, offset_to_city
from lodbench.citymodel.textured_model import textured_model
from lodbench.errors import DatasetError
from lodbench.findings import Severity

_MESHES = (".obj", ".glb", ".gltf", ".ply")
_CITIES = (".gml", ".xml", ".citygml")
# What has neither texture nor colour.
_GREY = 170


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
        path: OBJ, glTF, PLY or CityGML, or a folder of such tiles, all in the same coordinates.
        up_axis: ``y``, ``z``, or ``auto``: y for glTF, z for the others.
        options: How to read CityGML: ``crs`` and ``axis_order``.

    Raises:
        DatasetError: It is missing, unreadable, of another kind, too large, or files it names are missing
            or lie outside; the message lists them.
        CityModelError: It is CityGML or a mesh that cannot be read, or has no triangles.
    """
    if path.is_dir():
        found = sorted(file for file in path.rglob("*") if file.suffix.lower() in _MESHES + _CITIES)
        # Beside each file macOS keeps one of its own, of the same ending.
        files = [file for file in found if not file.name.startswith("._")]
        if not files:
            raise DatasetError(
                f"{path} holds no textured mesh.", f"Looked for {', '.join(_MESHES + _CITIES)}."
            )
        parts = [_read_file(file, path, up_axis, options or ReadOptions()) for file in files]
    else:
        parts = [_read_file(path, path.parent, up_axis, options or ReadOptions())]
    mesh = join_textured(parts)
    pixels = sum(picture.shape[0] * picture.shape[1] for picture in mesh.pictures)
    if pixels > MAX_ALL_PIXELS:
        raise DatasetError(
            f"The pictures of {path} have {pixels / 1e9:.1f} gigapixels; {MAX_ALL_PIXELS / 1e9:.1f} are held "
            "at once.",
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
    folder = TextureFolder(path.parent, path.parent)
    others, pictures = named_files(path, folder)
    found = (folder.path(name) for name in (*others, *pictures))
    return [path, *(file for file in found if file is not None)]


def _read_file(path: Path, root: Path, up_axis: str, options: ReadOptions) -> TexturedMesh:
    suffix = path.suffix.lower()
    if not path.is_file() or suffix not in _MESHES + _CITIES:
        what = "is no textured mesh" if path.is_file() else "does not exist"
        raise DatasetError(f"{path} {what}.", f"It takes {', '.join(_MESHES + _CITIES)}, or a folder.")
    folder = TextureFolder(root, path.parent)
    if suffix in _CITIES:
        return _read_city(path, folder, options)
    mesh = _read_mesh(path, folder)
    return replace(mesh, corners=turned_up(mesh.corners, up_axis, suffix))


def _read_city(path: Path, folder: TextureFolder, options: ReadOptions) -> TexturedMesh:
    """Returns the buildings of a CityGML file at their finest levels, pictured or in colours of materials."""
    table = PictureTable(folder)
    raw = read_citygml(
        lambda: path.open("rb"),
        str(path),
        is_strict=False,
        has_details=True,
        pictures=table,
        day=options.date,
    )
    model = finish_model(raw, options)
    mesh = textured_model(model, "A textured map needs appearances with pictures.")
    lost = Counter(str(item.code) for item in model.findings.items if item.code.severity is Severity.ERROR)
    notes = (*counted_lines(lost), *mesh.notes)
    return replace(mesh, notes=(f"{path.name}: {'; '.join(notes)}",) if notes else ())


def _read_mesh(path: Path, folder: TextureFolder) -> TexturedMesh:
    others, pictures = named_files(path, folder)
    missing = [name for name in (*others, *pictures) if folder.path(name) is None]
    if missing:
        raise DatasetError(
            f"{path.name} names files that are not there: {', '.join(missing)}.",
            f"Put them into {path.parent}, or correct the names.",
        )
    for name in pictures:
        folder.check_picture(name)
    for name, content in embedded_pictures(path).items():
        check_picture(content, f"{path.name}: {name}")
    _, parts = load_parts(path.read_bytes(), str(path), path.suffix.lower(), _part, _resolver(folder))
    mesh = join_textured(parts)
    if not (np.isfinite(mesh.corners).all() and np.isfinite(mesh.uv).all()):
        raise DatasetError(f"{path} has coordinates that are not finite.", "Repair or export it again.")
    return mesh


def _resolver(folder: TextureFolder) -> Any:
    """Returns trimesh's way to other files, closed to all but a folder's."""
    from trimesh.resolvers import Resolver

    class FolderResolver(Resolver):
        def __init__(self) -> None:
            pass

        def get(self, key: str) -> bytes:
            return folder.read(picture_name(key, "a material"))

        def write(self, name: str, data: Any) -> None:
            raise NotImplementedError

        def namespaced(self, namespace: str) -> Any:
            return _resolver(folder.below(namespace))

        def keys(self) -> list[str]:
            return []

    return FolderResolver()


def _part(loaded: Any, node: str) -> TexturedMesh:
    """Returns one node of a trimesh scene, set in place."""
    transform, name = loaded.graph[node]
    part = loaded.geometry[name]
    corners = np.asarray(part.vertices, np.float64) @ transform[:3, :3].T + transform[:3, 3]
    faces = np.asarray(part.faces)
    material = getattr(part.visual, "material", None)
    image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
    uv = getattr(part.visual, "uv", None)
    count = len(faces)
    if image is not None and uv is not None:
        blank = np.zeros((count, 3, 3), dtype=np.uint8)
        coordinates = np.asarray(uv, np.float64)[:, :2][faces]
        numbers = np.zeros(count, np.int32)
        picture = _tinted(pixels_of(image, name), getattr(material, "baseColorFactor", None))
        return TexturedMesh(corners[faces], coordinates, numbers, blank, (picture,))
    if material is not None:
        colours = np.broadcast_to(np.asarray(material.main_color)[:3], (count, 3, 3))
    elif part.visual.defined:
        colours = np.asarray(part.visual.vertex_colors)[:, :3][faces]
    else:
        colours = np.full((count, 3, 3), _GREY)
    none: NDArray[np.int32] = np.full(count, -1, dtype=np.int32)
    return TexturedMesh(corners[faces], np.zeros((count, 3, 2)), none, colours.astype(np.uint8), ())


def _tinted(picture: NDArray[np.uint8], factor: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
    """Returns a picture, (H, W, 3) sRGB, times a material's colour, RGBA, which multiplies light."""
    if factor is None or (factor[:3] == 255).all():
        return picture
    shades = np.arange(256) / 255.0
    light = np.where(shades <= 0.04045, shades / 12.92, ((shades + 0.055) / 1.055) ** 2.4)
    light = light * (factor[:3, None] / 255.0)
    table = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    found = [own[picture[..., k]] for k, own in enumerate(np.rint(255.0 * table).astype(np.uint8))]
    return np.stack(found, axis=-1)
