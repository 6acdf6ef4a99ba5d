"""Reading textured maps: OBJ with materials, glTF, PLY with colours, CityGML with appearances, tiles."""

from __future__ import annotations

import base64
import struct
from collections import Counter
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.gml.reader import read_citygml
from lodbench.citymodel.mesh.reader import load_parts, turned_up
from lodbench.citymodel.mesh.textured import TexturedMesh, join_textured, offset_to_city, textured_model
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.pictures import (
    MAX_ALL_PIXELS,
    PictureTable,
    TextureFolder,
    check_picture,
    counted_lines,
    pixels_of,
)
from lodbench.citymodel.polygons import finish_model
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.source import is_surface
from lodbench.errors import DatasetError
from lodbench.findings import Severity
from lodbench.storage.json_text import parse_json

_TRANSFORM, _WEBP = "KHR_texture_transform", "EXT_texture_webp"
# A transform that leaves every place where it is.
_STAYS = {"offset": [0, 0], "scale": [1, 1], "rotation": 0, "texCoord": 0}
# Head of a binary glTF and of its first chunk, which is JSON; another chunk's.
_GLB_HEAD, _CHUNK_HEAD_BYTES = struct.Struct("<4sIIII"), 8


def named_files(path: Path, folder: TextureFolder) -> tuple[list[str], list[str]]:
    """Returns the files that a mesh file names: materials and buffers, and pictures.

    Raises:
        DatasetError: It names a file outside of the folder, a material that no file of its own defines, or
            lays a picture in a way that is not read.
    """
    suffix = path.suffix.lower()
    if suffix in (".gltf", ".glb"):
        return _named_by_gltf(path)
    return _named_by_obj(path, folder) if suffix == ".obj" else ([], [])


def picture_name(words: str, where: str) -> str:
    """Returns the file that ``map_Kd`` names: what follows it, or the last word where options come first.

    Raises:
        DatasetError: An option moves the picture, or makes it larger or smaller.
    """
    if not words.startswith("-"):
        return words
    *options, name = words.split()
    for option, stays in (("-s", 1.0), ("-o", 0.0), ("-t", 0.0)):
        if option in options:
            for value in options[options.index(option) + 1 :][:3]:
                if value.startswith("-") and value[1:2].isalpha():
                    break
                if _number(value) != stays:
                    raise DatasetError(
                        f"{where}: `map_Kd {words[:80]}` moves its picture, which is not read.",
                        f"Leave {option} out, and write the texture coordinates as they are meant.",
                    )
    return name


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None


def _named_by_obj(path: Path, folder: TextureFolder) -> tuple[list[str], list[str]]:
    found = _after(path, "mtllib", "usemtl")
    libraries, pictures, materials = sorted(set(found["mtllib"])), set(), set()
    files = {library: folder.path(library) for library in libraries}
    for library, file in files.items():
        if file is not None:
            own = _after(file, "map_Kd", "newmtl")
            materials.update(own["newmtl"])
            parent = PurePosixPath(library.replace("\\", "/")).parent.as_posix()
            names = [picture_name(words, file.name) for words in own["map_Kd"]]
            pictures |= {name if parent == "." else f"{parent}/{name}" for name in names}
    undefined = sorted(set(found["usemtl"]) - materials)
    if undefined and None not in files.values():
        raise DatasetError(
            f"{path.name} uses materials that nothing defines: {', '.join(undefined[:3])}.",
            "Name the file that defines them with mtllib, or export the map again.",
        )
    return libraries, sorted(pictures)


def _after(path: Path, *keywords: str) -> dict[str, list[str]]:
    """Returns what follows keywords on the lines of a file, whatever letters they are in."""
    found: dict[str, list[str]] = {keyword: [] for keyword in keywords}
    spelt = {keyword.lower(): keyword for keyword in keywords}
    with path.open(encoding="latin-1") as stream:
        for line in stream:
            words = line.split(maxsplit=1)
            keyword = spelt.get(words[0].lower()) if len(words) == 2 else None
            if keyword is not None:
                found[keyword].append(words[1].strip())
    return found


def _named_by_gltf(path: Path) -> tuple[list[str], list[str]]:
    try:
        content = _gltf_content(path)
        found = [[str(entry.get("uri", "")) for entry in content.get(k, [])] for k in ("buffers", "images")]
        for material in content.get("materials", []):
            _require_plain(material, content, path.name)
    except (ValueError, AttributeError, TypeError, LookupError, struct.error):
        return [], []  # the reader says what is wrong
    others, pictures = ([uri for uri in uris if uri and not uri.startswith("data:")] for uris in found)
    return sorted(set(others)), sorted(set(pictures))


def embedded_pictures(path: Path) -> dict[str, bytes]:
    """Returns the base colour pictures that stand in a glTF file itself, by name; none of those beside it.

    Where the file is no glTF, or not as it should be, there are none: the reader says what is wrong.
    """
    if path.suffix.lower() not in (".gltf", ".glb"):
        return {}
    try:
        content, data = _gltf_content(path), path.read_bytes()
        return {
            str(content["images"][n].get("name") or f"picture {n}"): picture
            for n in sorted(_base_colours(content))
            if (picture := _embedded(data, content, content["images"][n])) is not None
        }
    except (ValueError, AttributeError, TypeError, LookupError, struct.error):
        return {}


def _base_colours(content: dict[str, Any]) -> set[int]:
    """Returns the numbers of the images that materials lay on surfaces."""
    found = set()
    for material in content.get("materials", []):
        texture = material.get("pbrMetallicRoughness", {}).get("baseColorTexture")
        if texture:
            named = content["textures"][texture["index"]]
            found.add(int(named.get("extensions", {}).get(_WEBP, named)["source"]))
    return found


def _embedded(data: bytes, content: dict[str, Any], image: dict[str, Any]) -> bytes | None:
    """Returns the bytes of an image in a data URI or in the second chunk of a binary file, or None."""
    if "bufferView" not in image:
        head, _, text = str(image.get("uri", "")).partition(",")
        return base64.b64decode(text) if head.startswith("data:") else None
    view = content["bufferViews"][image["bufferView"]]
    if not data.startswith(b"glTF") or view["buffer"] != 0:
        return None
    *_, length, _ = _GLB_HEAD.unpack_from(data)
    start = _GLB_HEAD.size + length + _CHUNK_HEAD_BYTES + view.get("byteOffset", 0)
    return data[start : start + view["byteLength"]]


def _gltf_content(path: Path) -> dict[str, Any]:
    """Returns the JSON of a glTF file, which in a binary one is the first chunk."""
    with path.open("rb") as stream:
        if path.suffix.lower() == ".gltf":
            text = stream.read()
        else:
            *_, length, _ = _GLB_HEAD.unpack(stream.read(_GLB_HEAD.size))
            text = stream.read(length)
    content: dict[str, Any] = parse_json(text.decode("utf-8"))
    return content


def _require_plain(material: dict[str, Any], content: dict[str, Any], source: str) -> None:
    """Makes sure that a picture lies by the first texture coordinates, unmoved, and is of a known kind."""
    texture = material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {})
    transform = texture.get("extensions", {}).get(_TRANSFORM, {})
    is_moved = any(transform.get(key, stays) != stays for key, stays in _STAYS.items())
    found: dict[str, Any] = content["textures"][texture["index"]] if texture else {"source": 0}
    faults = {
        f"moves its picture ({_TRANSFORM})": is_moved,
        "lies by its second texture coordinates": texture.get("texCoord", 0) != 0,
        # KTX2 stands in an extension alone.
        "has no PNG, JPEG or WebP": not ("source" in found or _WEBP in found.get("extensions", {})),
    }
    for what, is_so in faults.items():
        if is_so:
            raise DatasetError(
                f"{source}: material {str(material.get('name', ''))!r} {what}, which is not read.",
                "Export it with PNG or JPEG, and one set of texture coordinates that stand as they lie.",
            )


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
        from lodbench.citymodel.surface.orthophoto import read_textured_surface

        return read_textured_surface(path, options or ReadOptions())
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
