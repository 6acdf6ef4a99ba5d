"""Features of glTF that are not supported: refused before a reader ignores them and returns another shape."""

from __future__ import annotations

import json
import struct
from typing import Any

from lodbench.citymodel.cityjson_values import list_or_empty
from lodbench.errors import CityModelError

_CHUNK = struct.Struct("<4sIII4s")  # of a binary file: magic, version, length; then of the first chunk
# Extensions that change looks, or say something of objects, and leave the triangles as they are. Positions in
# whole numbers are read as such.
_LOOKS = ("KHR_materials_", "KHR_texture_", "KHR_lights_", "KHR_xmp", "EXT_texture_", "EXT_lights_")
_HARMLESS = frozenset(
    {
        "KHR_mesh_quantization", "EXT_mesh_features", "EXT_structural_metadata", "EXT_instance_features",
        "EXT_feature_metadata", "CESIUM_primitive_outline", "KHR_animation_pointer", "KHR_node_visibility",
    }
)  # fmt: skip


def require_readable(content: bytes, source: str) -> None:
    """Makes sure that a glTF file, text or binary, holds its triangles in the way that is read.

    Raises:
        CityModelError: It requires an extension that may change them, stores some sparsely, or a number of
            its tables is none. What is no glTF at all passes: its reader says so.
    """
    document = _document(content)
    if document is None:
        return
    required = document.get("extensionsRequired")
    for name in required if isinstance(required, list) else filter(None, [required]):
        if str(name) not in _HARMLESS and not str(name).startswith(_LOOKS):
            raise CityModelError(
                f"{source} requires the glTF extension {str(name)[:60]!r}, which is not read.",
                "Export it again without, as plain triangles: no compression, no instances.",
            )
    _require_counts(document, source)
    accessors = list_or_empty(document.get("accessors"))
    for number in sorted(_of_triangles(document)):
        if number < len(accessors) and isinstance(accessors[number], dict) and "sparse" in accessors[number]:
            raise CityModelError(
                f"{source} stores triangles sparsely (accessors[{number}] of its glTF), which is not read.",
                "Export it again without sparse accessors.",
            )


def _require_counts(document: dict[str, Any], source: str) -> None:
    """Raises CityModelError where a count, a length or an offset of a glTF document is none."""
    for table, least in (
        ("accessors", {"count": 1, "byteOffset": 0}),
        ("bufferViews", {"byteLength": 1, "byteOffset": 0}),
    ):
        for number, entry in enumerate(list_or_empty(document.get(table))):
            for name, lowest in least.items():
                value = entry.get(name, lowest) if isinstance(entry, dict) else lowest
                if type(value) is not int or value < lowest:
                    raise CityModelError(
                        f"{source}: {table}[{number}] of its glTF has the {name} {str(value)[:40]}.",
                        "Export it again.",
                    )


def _of_triangles(document: dict[str, Any]) -> set[int]:
    """Returns the numbers of the accessors that hold corners, places on pictures and indices."""
    found: set[int] = set()
    for mesh in list_or_empty(document.get("meshes")):
        for primitive in list_or_empty(mesh.get("primitives")) if isinstance(mesh, dict) else ():
            if isinstance(primitive, dict):
                attributes = primitive.get("attributes")
                values = [
                    *(attributes.values() if isinstance(attributes, dict) else ()),
                    primitive.get("indices"),
                ]
                found.update(value for value in values if type(value) is int)
    return found


def _document(content: bytes) -> dict[str, Any] | None:
    """Returns the JSON of a glTF file, None where there is none."""
    try:
        if content.startswith(b"glTF"):
            *_, length, _ = _CHUNK.unpack_from(content)
            content = content[_CHUNK.size : _CHUNK.size + length]
        document = json.loads(content.decode("utf-8-sig"))
    except (ValueError, RecursionError, struct.error):
        return None
    return document if isinstance(document, dict) else None
