"""Triangle meshes through trimesh: PLY, STL and glTF as LoD-less cities."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any, BinaryIO, TypeVar

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.gltf_features import require_readable
from lodbench.citymodel.identity import connected_components, number_rows, point_bits
from lodbench.citymodel.mesh_frames import frame_of_comments, frame_of_extras
from lodbench.citymodel.model import SurfaceKind
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.raw import RawCity
from lodbench.errors import CityModelError, LodbenchError

T = TypeVar("T")

_PLY_HEADER_BYTES = 4096
MESH_FORMATS = {".ply": "PLY", ".stl": "STL", ".glb": "glTF", ".gltf": "glTF"}


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
    if frame is not None:
        points = points + frame.origin
    if len(parts) > 1:
        building = np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts])
        ids = [str(part.metadata.get("name") or f"mesh-{i + 1}") for i, part in enumerate(parts)]
    else:
        building = _components(points)
        ids = [f"component-{i + 1}" for i in range(int(building.max()) + 1)]
    count = len(building)
    return RawCity(
        source=source,
        format=MESH_FORMATS[suffix],
        srs_names=(frame.crs,) if frame is not None and frame.crs is not None else (),
        building_ids=tuple(ids),
        lods=("",),
        points=points,
        ring_starts=np.arange(count + 1) * 3,
        polygon_starts=np.arange(count + 1),
        building=building.astype(np.int32),
        lod=np.zeros(count, np.int16),
        kind=np.full(count, SurfaceKind.UNKNOWN, np.uint8),
        srs=np.zeros(count, np.int16),
        axis_orders=("east_first",) if frame is not None and frame.crs is not None else (),
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


def _components(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Returns the component of each triangle, by shared positions."""
    node = number_rows(point_bits(points))[0].reshape(-1, 3)
    first = np.concatenate([node[:, 0], node[:, 1]])
    second = np.concatenate([node[:, 1], node[:, 2]])
    root = connected_components(int(node.max()) + 1, first, second)
    return np.unique(root[node[:, 0]], return_inverse=True)[1].reshape(-1)
