"""What a textured mesh names: files beside it, materials, and where on a picture it lies."""

from __future__ import annotations

import base64
import struct
from pathlib import Path, PurePosixPath
from typing import Any

from lodbench.citymodel.texture_pictures import TextureFolder
from lodbench.errors import DatasetError
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
            "Name the file that defines them with `mtllib`, or export the map again.",
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
    """Makes sure that a picture lies by the first texture coordinates, as they stand, and is of a kind read.

    Raises:
        DatasetError: It is of another, lies by others, or they are moved first.
    """
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
