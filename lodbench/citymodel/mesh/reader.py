"""Meshes as cities without levels: PLY, STL and glTF through trimesh, Wavefront OBJ by lines."""

from __future__ import annotations

import io
import json
import re
import struct
from codecs import BOM_UTF8
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, BinaryIO, TypeVar

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import ELEMENT_IGNORED
from lodbench.citymodel.gml.folding import parse_rings
from lodbench.citymodel.model import starts_of
from lodbench.citymodel.options import MESH_FORMATS, ReadOptions
from lodbench.citymodel.raw import NotACity, RawCity, city_of_columns
from lodbench.citymodel.scene import Scene, connected_components, number_rows, point_bits
from lodbench.errors import CityModelError, LodbenchError
from lodbench.findings import Findings
from lodbench.storage.json_text import list_or_empty

GLB_HEAD = struct.Struct("<4sIII4s")  # of a binary glTF: magic, version, length; then of the first chunk
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
    document = gltf_document(content)
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
    accessors: set[int] = set()
    for mesh in list_or_empty(document.get("meshes")):
        for primitive in list_or_empty(mesh.get("primitives")) if isinstance(mesh, dict) else ():
            if isinstance(primitive, dict):
                attributes = primitive.get("attributes")
                values = [
                    *(attributes.values() if isinstance(attributes, dict) else ()),
                    primitive.get("indices"),
                ]
                accessors.update(value for value in values if type(value) is int)
    return accessors


def gltf_document(content: bytes) -> dict[str, Any] | None:
    """Returns the JSON of a glTF file, None where there is none."""
    try:
        if content.startswith(b"glTF"):
            *_, length, _ = GLB_HEAD.unpack_from(content)
            content = content[GLB_HEAD.size : GLB_HEAD.size + length]
        document = json.loads(content.decode("utf-8-sig"))
    except (ValueError, RecursionError, struct.error):
        return None
    return document if isinstance(document, dict) else None


T = TypeVar("T")

_PLY_HEADER_BYTES = 4096


def read_mesh(stream: BinaryIO, source: str, suffix: str, options: ReadOptions) -> RawCity:
    """Returns a mesh as a city: a node is a building, and in a single mesh what hangs together is.

    Args:
        stream: The file's bytes. Files it refers to are not opened.
        source: Its name, for messages.
        suffix: ``.ply``, ``.stl``, ``.glb`` or ``.gltf``.
        options: ``up_axis``.

    Raises:
        CityModelError: The mesh cannot be read, is not finite, or has no triangles.
    """
    content = stream.read()
    loaded, parts = load_parts(content, source, suffix, _set_in_place)
    rank = {name: i for i, name in enumerate(loaded.geometry)}
    parts.sort(key=lambda part: (rank[part.metadata["geometry"]], part.metadata["name"]))
    corners = np.concatenate([np.asarray(part.vertices, np.float64)[part.faces] for part in parts])
    points = corners.reshape(-1, 3)
    if not np.isfinite(points).all():
        raise CityModelError(
            f"{source} has coordinates that are not finite numbers.", "Repair or export the file again."
        )
    frame = frame_of_extras(loaded.metadata)
    if suffix == ".ply" and frame is None:
        frame = frame_of_comments(_ply_comments(content))
    points = turned_up(points, options.up_axis, suffix)
    counts = np.full(len(points) // 3, 3)
    if len(parts) > 1:
        building = np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts])
        ids = [str(part.metadata.get("name") or f"mesh-{i + 1}") for i, part in enumerate(parts)]
    else:
        building = _components(points, counts)
        ids = [f"component-{i + 1}" for i in range(int(building.max()) + 1)]
    return _city(source, MESH_FORMATS[suffix], points, counts, building, ids, frame)


def _city(
    source: str,
    format: str,
    points: NDArray[np.float64],
    counts: NDArray[np.int64],
    building: NDArray[np.int64],
    ids: list[str],
    frame: MeshFrame | None,
) -> RawCity:
    """Returns faces of one ring each, moved to where their frame says, as a city without levels."""
    has_crs = frame is not None and frame.crs is not None
    columns = {
        "points": points if frame is None else points + frame.origin,
        "ring_lengths": counts,
        "ring_counts": np.ones(len(counts), np.int64),
        "building": building,
    }
    return city_of_columns(
        columns,
        source=source,
        format=format,
        srs_names=(frame.crs,) if frame is not None and has_crs else (),
        building_ids=tuple(ids),
        lods=("",),
        axis_orders=("east_first",) if has_crs else (),
    )


def _ply_comments(content: bytes) -> list[str]:
    header = content[:_PLY_HEADER_BYTES].partition(b"end_header")[0].decode("latin-1")
    return [
        line.removeprefix("comment ").strip() for line in header.splitlines() if line.startswith("comment ")
    ]


def load_parts(
    content: bytes, source: str, suffix: str, part_of: Callable[[Any, str], T], resolver: Any = None
) -> tuple[Any, list[T]]:
    """Returns a trimesh scene and its parts, one or more, in the order of its nodes.

    Args:
        content: The file's bytes.
        source: Its name, for messages.
        suffix: Its ending, which says the format.
        part_of: What to make of a node of the scene that has triangles.
        resolver: trimesh's way to the files it names; None: none is opened.

    Raises:
        CityModelError: It cannot be read, or has no triangles.
        LodbenchError: As ``part_of`` and ``resolver`` raise.
    """
    import trimesh

    if MESH_FORMATS.get(suffix) == "glTF":
        require_readable(content, source)
    try:
        # From memory, so that trimesh knows no folder to look for other files in.
        loaded = trimesh.load_scene(
            io.BytesIO(content), file_type=suffix[1:], process=False, resolver=resolver
        )
        graph, meshes = loaded.graph, loaded.geometry
        nodes = [node for node in graph.nodes_geometry if len(getattr(meshes[graph[node][1]], "faces", ()))]
        for name in {graph[node][1] for node in nodes}:
            _require_corners(meshes[name])
        parts = [part_of(loaded, node) for node in nodes]
    except LodbenchError:
        raise
    except Exception as error:  # trimesh lets the errors of every parser it uses through
        is_lone = suffix == ".gltf" and resolver is None
        raise CityModelError(
            f"{source} cannot be read as {MESH_FORMATS.get(suffix, 'OBJ')} ({error}).",
            "A .gltf that refers to other files must be one .glb." if is_lone else "Try it in a viewer.",
        ) from None
    if not parts:
        raise CityModelError(f"{source} has no triangles.", "Point clouds and lines have no surfaces.")
    return loaded, parts


def _require_corners(mesh: Any) -> None:
    """Raises ValueError if a triangle of a mesh has a corner that is not there."""
    faces = np.asarray(mesh.faces)
    if faces.min() < 0 or faces.max() >= len(mesh.vertices):
        raise ValueError(f"a triangle has corner {faces.max()} of {len(mesh.vertices)}")


def turned_up(points: NDArray[np.float64], up_axis: str, suffix: str) -> NDArray[np.float64]:
    """Returns (..., 3) points with z up; ``auto`` is y for glTF and z for the others."""
    if up_axis == "y" or (up_axis == "auto" and MESH_FORMATS.get(suffix) == "glTF"):
        return np.stack([points[..., 0], -points[..., 2], points[..., 1]], axis=-1)
    return points


def _set_in_place(loaded: Any, node: str) -> Any:
    """Returns the mesh of a node of a trimesh scene, named and placed as the node is."""
    matrix, name = loaded.graph[node]
    part = loaded.geometry[name].copy()
    part.apply_transform(matrix)
    part.metadata.update(name=node, geometry=name)
    return part


def _components(corners: NDArray[np.float64], counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Returns the component of each face: faces that share a position, directly or through others."""
    node = number_rows(point_bits(corners))[0].reshape(-1)
    ends = np.cumsum(counts)
    following = np.concatenate([node[1:], node[:1]])
    following[ends - 1] = node[ends - counts]
    root = connected_components(int(node.max()) + 1, node, following)
    return np.unique(root[node[ends - counts]], return_inverse=True)[1].reshape(-1)


# Texture and normal indices: `7/3/2` means point 7.
_TEXTURE_PART = re.compile(r"/[^\s;]*")
# lodbench writes its comments first.
_HEAD_LINES = 8
_SILENT = frozenset({"v", "f", "vt", "vn", "s", "o", "g", "mtllib"})


def read_obj(stream: BinaryIO, source: str, up_axis: str = "auto") -> RawCity:
    """Returns the faces of a Wavefront OBJ; what hangs together is a building.

    Metres, x east, y north, z up, or y up where so declared. Only positions and faces count: lines, points,
    texture coordinates, normals, materials and groups carry no surface. Numbers are read in bulk; a line at
    fault is looked for only when there is one.

    Args:
        stream: The file's bytes.
        source: Its name, for messages.
        up_axis: ``y``, ``z``, or ``auto``, which is z.

    Raises:
        CityModelError: A number is malformed or not finite, a face has fewer than three corners or
            an index out of range (the message names the line), or there is no face.
    """
    lines = _logical_lines(stream.read().removeprefix(BOM_UTF8).decode("latin-1"))
    findings = Findings()
    positions = [i for i, line in enumerate(lines) if line.startswith("v ")]
    faces = [i for i, line in enumerate(lines) if line.startswith("f ")]
    _report_ignored(lines, source, findings)
    if not faces:
        raise NotACity(f"{source} has no faces.", "A city model in OBJ needs lines of v and f.")
    points = turned_up(_read_points(lines, positions, source), up_axis, ".obj")
    corners, counts = _read_faces(lines, faces, np.asarray(positions, np.int64), source)
    points = points[corners]
    building = _components(points, counts)
    frame = frame_of_comments([line[1:].strip() for line in lines[:_HEAD_LINES] if line.startswith("#")])
    num_buildings = int(building.max()) + 1
    width = len(str(num_buildings))
    ids = [f"component-{i + 1:0{width}d}" for i in range(num_buildings)]
    city = _city(source, "OBJ", points, counts, building, ids, frame)
    city.findings = findings
    return city


def _logical_lines(text: str) -> list[str]:
    """Returns the lines by number; a line continued by a backslash leaves empty lines behind."""
    lines = text.replace("\t", " ").splitlines()
    if any(line.startswith(" ") for line in lines):
        lines = [line.lstrip() for line in lines]
    if "\\" in text:
        for i in range(len(lines) - 2, -1, -1):
            if lines[i].endswith("\\"):
                lines[i], lines[i + 1] = lines[i][:-1] + " " + lines[i + 1], ""
    return lines


def _report_ignored(lines: list[str], source: str, findings: Findings) -> None:
    keywords = Counter(
        line.split(maxsplit=1)[0] for line in lines if line and not line.startswith(("v ", "f ", "v", "#"))
    )
    for keyword, count in sorted(keywords.items()):
        if keyword not in _SILENT:
            findings.add(ELEMENT_IGNORED, source, f"{count} `{keyword}`")


def _read_points(lines: list[str], positions: list[int], source: str) -> NDArray[np.float64]:
    """Returns (V, 3) positions; what follows x, y, z on a line (a weight, a colour) is left."""
    values, counts, is_bad = parse_rings([lines[i][2:].encode() for i in positions])
    is_bad |= (counts < 3) | (counts > 7)
    if is_bad.any():
        line = positions[int(np.argmax(is_bad))]
        raise _line_error(source, line, lines[line], "is not a point of three finite numbers")
    columns: NDArray[np.int64] = starts_of(counts)[:-1, None] + np.arange(3)
    return values.take(columns)


def _read_faces(
    lines: list[str], faces: list[int], positions: NDArray[np.int64], source: str
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns the point index of every corner, face after face, and the corners of each face."""
    texts = [lines[i][2:] for i in faces]
    if any("/" in text for text in texts):
        # A separator in the text would shift the lines; as "?" it is a fault of its own line.
        joined = ";".join(text.replace(";", "?") for text in texts)
        texts = _TEXTURE_PART.sub("", joined).split(";")
    values, counts, is_bad = parse_rings([text.encode() for text in texts])
    face = np.repeat(np.arange(len(counts)), counts)
    # Larger than any index, smaller than an overflow: such a number fails the range check below.
    indices = np.clip(np.nan_to_num(values), -1e15, 1e15).astype(np.int64)
    # A negative index counts back from the last point above the face.
    above = np.searchsorted(positions, np.asarray(faces))
    corners = np.where(indices < 0, above[face] + indices, indices - 1)
    is_bad[face[(values != indices) | (corners < 0) | (corners >= len(positions))]] = True
    is_bad |= counts < 3
    if is_bad.any():
        line = faces[int(np.argmax(is_bad))]
        what = f"is not a face of three or more points out of {len(positions)}"
        raise _line_error(source, line, lines[line], what)
    return corners, counts


def _line_error(source: str, line: int, text: str, what: str) -> CityModelError:
    return CityModelError(f"{source}, line {line + 1}: `{text[:60]}` {what}.", "Mend or remove the line.")


_NO_NAME = "unknown"

_ORIGIN, _CRS = "origin ", "crs "

_KEY = "lodbench"


@dataclass(frozen=True, slots=True)
class MeshFrame:
    """Place of a mesh."""

    origin: NDArray[np.float64]  # (3,) what was subtracted from the coordinates
    crs: str | None  # their reference system, or None where it was unknown

    @classmethod
    def of_scene(cls, scene: Scene) -> MeshFrame:
        """Returns the frame of a scene."""
        return cls(scene.origin, scene.crs)

    def comments(self) -> list[str]:
        """Returns two lines of text, as they stand in the comments of OBJ and PLY."""
        return [_ORIGIN + " ".join(map(repr, self.origin.tolist())), _CRS + (self.crs or _NO_NAME)]

    def extras(self) -> dict[str, Any]:
        """Returns plain values, as they stand in the extras of a glTF scene."""
        return {_KEY: {"origin": self.origin.tolist(), "crs": self.crs}}


def frame_of_comments(comments: list[str]) -> MeshFrame | None:
    """Returns the frame that two comments in a row tell, or None where they are anybody's.

    Example:
        >>> frame_of_comments(["origin 5.0 6.0 0.0", "crs EPSG:25832"]).crs
        'EPSG:25832'
        >>> frame_of_comments(["made by hand"]) is None
        True
    """
    for first, second in pairwise(comments):
        if first.startswith(_ORIGIN) and second.startswith(_CRS):
            name = second.removeprefix(_CRS).strip()
            return _frame(first.removeprefix(_ORIGIN).split(), None if name == _NO_NAME else name)
    return None


def frame_of_extras(metadata: Any) -> MeshFrame | None:
    """Returns the frame in the extras of a glTF scene, or None."""
    values = metadata.get(_KEY) if isinstance(metadata, dict) else None
    if not isinstance(values, dict) or not isinstance(values.get("crs"), str | None):
        return None
    return _frame(values.get("origin"), values.get("crs"))


def _frame(origin: Any, crs: str | None) -> MeshFrame | None:
    try:
        values = np.asarray(origin, np.float64).reshape(3)
    except (TypeError, ValueError):
        return None
    return MeshFrame(values, crs) if np.isfinite(values).all() else None
