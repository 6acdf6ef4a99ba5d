"""Textures of OBJ, glTF and PLY: the files that such a mesh names, and its triangles with their pictures."""

from __future__ import annotations

import base64
import struct
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.mesh.reader import GLB_HEAD, gltf_document, load_parts, turned_up
from lodbench.citymodel.textures import TexturedPart, TextureFolder, check_picture, pixels_of
from lodbench.errors import DatasetError

_TRANSFORM, _WEBP = "KHR_texture_transform", "EXT_texture_webp"
# A transform that leaves every place where it is.
_STAYS = {"offset": [0, 0], "scale": [1, 1], "rotation": 0, "texCoord": 0}
_CHUNK_HEAD_BYTES = 8  # of the second chunk of a binary file


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
    by_keyword = _after(path, "mtllib", "usemtl")
    libraries, pictures, materials = sorted(set(by_keyword["mtllib"])), set(), set()
    files = {library: folder.path(library) for library in libraries}
    for library, file in files.items():
        if file is not None:
            own = _after(file, "map_Kd", "newmtl")
            materials.update(own["newmtl"])
            parent = PurePosixPath(library.replace("\\", "/")).parent.as_posix()
            names = [picture_name(words, file.name) for words in own["map_Kd"]]
            pictures |= {name if parent == "." else f"{parent}/{name}" for name in names}
    undefined = sorted(set(by_keyword["usemtl"]) - materials)
    if undefined and None not in files.values():
        raise DatasetError(
            f"{path.name} uses materials that nothing defines: {', '.join(undefined[:3])}.",
            "Name the file that defines them with mtllib, or export the map again.",
        )
    return libraries, sorted(pictures)


def _after(path: Path, *keywords: str) -> dict[str, list[str]]:
    """Returns what follows keywords on the lines of a file, whatever letters they are in."""
    by_keyword: dict[str, list[str]] = {keyword: [] for keyword in keywords}
    spelt = {keyword.lower(): keyword for keyword in keywords}
    with path.open(encoding="latin-1") as stream:
        for line in stream:
            words = line.split(maxsplit=1)
            keyword = spelt.get(words[0].lower()) if len(words) == 2 else None
            if keyword is not None:
                by_keyword[keyword].append(words[1].strip())
    return by_keyword


def _named_by_gltf(path: Path) -> tuple[list[str], list[str]]:
    content = gltf_document(path.read_bytes()) or {}
    try:
        names = [[str(entry.get("uri", "")) for entry in content.get(k, [])] for k in ("buffers", "images")]
        for material in content.get("materials", []):
            _require_plain(material, content, path.name)
    except (ValueError, AttributeError, TypeError, LookupError):
        return [], []  # the reader says what is wrong
    others, pictures = ([uri for uri in uris if uri and not uri.startswith("data:")] for uris in names)
    return sorted(set(others)), sorted(set(pictures))


def embedded_pictures(path: Path) -> dict[str, bytes]:
    """Returns the base colour pictures that stand in a glTF file itself, by name; none of those beside it.

    Where the file is no glTF, or not as it should be, there are none: the reader says what is wrong.
    """
    if path.suffix.lower() not in (".gltf", ".glb"):
        return {}
    data = path.read_bytes()
    content = gltf_document(data) or {}
    try:
        return {
            str(content["images"][n].get("name") or f"picture {n}"): picture
            for n in sorted(set(_base_colours(content)))
            if (picture := _embedded(data, content, content["images"][n])) is not None
        }
    except (ValueError, AttributeError, TypeError, LookupError, struct.error):
        return {}


def _base_colours(content: dict[str, Any]) -> Iterator[int]:
    """Yields the numbers of the images that materials lay on surfaces."""
    for material in content.get("materials", []):
        texture = material.get("pbrMetallicRoughness", {}).get("baseColorTexture")
        if texture:
            named = content["textures"][texture["index"]]
            yield int(named.get("extensions", {}).get(_WEBP, named)["source"])


def _embedded(data: bytes, content: dict[str, Any], image: dict[str, Any]) -> bytes | None:
    """Returns the bytes of an image in a data URI or in the second chunk of a binary file, or None."""
    if "bufferView" not in image:
        head, _, text = str(image.get("uri", "")).partition(",")
        return base64.b64decode(text) if head.startswith("data:") else None
    view = content["bufferViews"][image["bufferView"]]
    if not data.startswith(b"glTF") or view["buffer"] != 0:
        return None
    *_, length, _ = GLB_HEAD.unpack_from(data)
    start = GLB_HEAD.size + length + _CHUNK_HEAD_BYTES + view.get("byteOffset", 0)
    return data[start : start + view["byteLength"]]


def _require_plain(material: dict[str, Any], content: dict[str, Any], source: str) -> None:
    """Makes sure that a picture lies by the first texture coordinates, unmoved, and is of a known kind."""
    texture = material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {})
    transform = texture.get("extensions", {}).get(_TRANSFORM, {})
    is_moved = any(transform.get(key, stays) != stays for key, stays in _STAYS.items())
    entry: dict[str, Any] = content["textures"][texture["index"]] if texture else {"source": 0}
    faults = {
        f"moves its picture ({_TRANSFORM})": is_moved,
        "lies by its second texture coordinates": texture.get("texCoord", 0) != 0,
        # KTX2 stands in an extension alone.
        "has no PNG, JPEG or WebP": not ("source" in entry or _WEBP in entry.get("extensions", {})),
    }
    for what, is_so in faults.items():
        if is_so:
            raise DatasetError(
                f"{source}: material {str(material.get('name', ''))!r} {what}, which is not read.",
                "Export it with PNG or JPEG, and one set of texture coordinates that stand as they lie.",
            )


def read_textured_mesh(path: Path, folder: TextureFolder, up_axis: str) -> list[TexturedPart]:
    """Returns the triangles of a mesh file under their pictures or in their colours, z up.

    Args:
        path: OBJ, glTF or PLY.
        folder: Where the files that it names lie.
        up_axis: ``y``, ``z``, or ``auto``: y for glTF, z for the others.

    Raises:
        DatasetError: As for ``named_files``, a file that it names is missing, no picture or too large, or
            coordinates are not finite.
        CityModelError: It cannot be read, or has no triangles.
    """
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
    suffix = path.suffix.lower()
    _, parts = load_parts(path.read_bytes(), str(path), suffix, _part, _resolver(folder))
    if not all(np.isfinite(each).all() for part in parts for each in (part.corners, part.uv)):
        raise DatasetError(f"{path} has coordinates that are not finite.", "Repair or export it again.")
    return [part._replace(corners=turned_up(part.corners, up_axis, suffix)) for part in parts]


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


def _part(loaded: Any, node: str) -> TexturedPart:
    """Returns one node of a trimesh scene, set in place."""
    transform, name = loaded.graph[node]
    part = loaded.geometry[name]
    corners = np.asarray(part.vertices, np.float64) @ transform[:3, :3].T + transform[:3, 3]
    faces = np.asarray(part.faces)
    material = getattr(part.visual, "material", None)
    image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
    uv = getattr(part.visual, "uv", None)
    if image is not None and uv is not None:
        picture = _tinted(pixels_of(image, name), getattr(material, "baseColorFactor", None))
        return TexturedPart(corners[faces], np.asarray(uv, np.float64)[:, :2][faces], picture)
    bare = TexturedPart(corners[faces])
    if material is not None:
        return bare._replace(colours=np.asarray(material.main_color)[:3])
    return bare._replace(colours=part.visual.vertex_colors[:, :3][faces]) if part.visual.defined else bare


def _tinted(picture: NDArray[np.uint8], factor: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
    """Returns a picture, (H, W, 3) sRGB, times a material's colour, RGBA, which multiplies light."""
    if factor is None or (factor[:3] == 255).all():
        return picture
    shades = np.arange(256) / 255.0
    light = np.where(shades <= 0.04045, shades / 12.92, ((shades + 0.055) / 1.055) ** 2.4)
    light = light * (factor[:3, None] / 255.0)
    table = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    channels = [own[picture[..., k]] for k, own in enumerate(np.rint(255.0 * table).astype(np.uint8))]
    return np.stack(channels, axis=-1)
