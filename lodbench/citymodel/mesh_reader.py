"""Triangle meshes through trimesh: PLY, STL and glTF as LoD-less cities."""

from __future__ import annotations

import io
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.identity import connected_components, number_rows, point_bits
from lodbench.citymodel.mesh_frames import frame_of_comments, frame_of_extras
from lodbench.citymodel.model import SurfaceKind
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.raw import RawCity
from lodbench.errors import CityModelError
from lodbench.findings import Findings

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
    loaded, parts = _load_parts(content, source, suffix)
    corners = np.concatenate([np.asarray(part.vertices, np.float64)[part.faces] for part in parts])
    points = corners.reshape(-1, 3)
    if not np.isfinite(points).all():
        raise CityModelError(
            f"{source} has coordinates that are not finite numbers.", "Repair or export the file again."
        )
    frame = frame_of_extras(loaded.metadata)
    if suffix == ".ply" and frame is None:
        frame = frame_of_comments(_ply_comments(content))
    if options.up_axis == "y" or (options.up_axis == "auto" and MESH_FORMATS[suffix] == "glTF"):
        points = np.stack([points[:, 0], -points[:, 2], points[:, 1]], axis=1)
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
        version=None,
        srs_names=(frame.crs,) if frame is not None and frame.crs is not None else (),
        building_ids=tuple(ids),
        num_parts=0,
        lods=("",),
        points=points,
        ring_starts=np.arange(count + 1) * 3,
        polygon_starts=np.arange(count + 1),
        building=building.astype(np.int32),
        lod=np.zeros(count, np.int16),
        kind=np.full(count, SurfaceKind.UNKNOWN, np.uint8),
        srs=np.zeros(count, np.int16),
        has_closing_points=False,
        findings=Findings(),
        axis_orders=("east_first",) if frame is not None and frame.crs is not None else (),
    )


def _ply_comments(content: bytes) -> list[str]:
    header = content[:_PLY_HEADER_BYTES].partition(b"end_header")[0].decode("latin-1")
    return [
        line.removeprefix("comment ").strip() for line in header.splitlines() if line.startswith("comment ")
    ]


def _load_parts(content: bytes, source: str, suffix: str) -> tuple[Any, list[Any]]:
    """Returns the trimesh scene and its meshes, at least one, or raises as ``read_mesh`` does."""
    import trimesh

    try:
        # From memory, so that trimesh knows no folder to look for other files in.
        loaded = trimesh.load_scene(io.BytesIO(content), file_type=suffix[1:], process=False)
        parts = _parts_in_order(loaded)
    except Exception as error:  # trimesh lets the errors of every parser it uses through
        raise CityModelError(
            f"{source} cannot be read as a {MESH_FORMATS[suffix]} mesh ({error}).",
            "A .gltf that refers to other files must be one .glb.",
        ) from None
    if not parts:
        raise CityModelError(f"{source} has no triangles.", "Point clouds and lines are no city model.")
    return loaded, parts


def _parts_in_order(loaded: Any) -> list[Any]:
    """Returns the meshes of a trimesh scene, set in place, in the order of the file."""
    rank = {name: i for i, name in enumerate(loaded.geometry)}
    nodes = [(rank[loaded.graph[node][1]], node) for node in loaded.graph.nodes_geometry]
    parts = []
    for _, node in sorted(nodes):
        matrix, name = loaded.graph[node]
        part = loaded.geometry[name]
        if len(getattr(part, "faces", ())):
            part = part.copy()
            part.apply_transform(matrix)
            part.metadata["name"] = node
            parts.append(part)
    return parts


def _components(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Returns the component of each triangle, by shared positions."""
    node = number_rows(point_bits(points))[0].reshape(-1, 3)
    first = np.concatenate([node[:, 0], node[:, 1]])
    second = np.concatenate([node[:, 1], node[:, 2]])
    root = connected_components(int(node.max()) + 1, first, second)
    return np.unique(root[node[:, 0]], return_inverse=True)[1].reshape(-1)
