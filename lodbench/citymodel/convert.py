"""Writing cities: OBJ, PLY and glTF for viewers, CityJSON for GIS, a scene folder for lodbench itself."""

from __future__ import annotations

import json
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from lodbench.citymodel.cache import open_city, store_city
from lodbench.citymodel.mesh import CityMesh, mesh_model
from lodbench.citymodel.mesh_frames import MeshFrame
from lodbench.citymodel.model import CityModel, SurfaceKind
from lodbench.citymodel.scene import Scene
from lodbench.errors import CityModelError
from lodbench.storage import write_bytes

_SURFACE_NAMES = {
    SurfaceKind.WALL: "WallSurface",
    SurfaceKind.ROOF: "RoofSurface",
    SurfaceKind.GROUND: "GroundSurface",
    SurfaceKind.CLOSURE: "ClosureSurface",
    SurfaceKind.OPENING: "Window",
    SurfaceKind.FLOOR: "OuterFloorSurface",
    SurfaceKind.INTERIOR: "InteriorWallSurface",
}
_MILLIMETRE = 0.001


def check_target(target: Path) -> None:
    """Refuses a target whose ending names no format, before a long read is spent on it.

    Raises:
        CityModelError: The ending is unknown, or the folder missing.
    """
    if target.suffix.lower() not in FORMATS:
        raise CityModelError(
            f"No format is known by the ending of {target}.", f"Known: {', '.join(FORMATS)}."
        )
    if not target.parent.is_dir():
        raise CityModelError(f"{target} cannot be written: {target.parent} is no folder.", "Make it first.")


def convert_city(
    model: CityModel, target: Path, *, lod: str | None = None, roof_height: str | None = None
) -> CityMesh | None:
    """Writes a city in the format the target's ending names; a file is written whole or not at all.

    ``.obj``, ``.ply``, ``.glb`` and ``.scene`` hold one level of detail, in the local frame (the
    origin is written beside it where the format has room). ``.json`` is CityJSON 2.0 with all
    levels, in the model's reference system, to the millimetre.

    Args:
        model: The city as read.
        target: Where to write.
        lod: Level for the mesh formats, as in ``mesh_city``.
        roof_height: As in ``mesh_city``.

    Returns:
        The mesh written, with its account of area; None for CityJSON, which has the polygons.

    Raises:
        CityModelError: The ending is unknown, the level absent, or the folder not writable.
    """
    check_target(target)
    suffix = target.suffix.lower()
    mesh = None if suffix == ".json" else mesh_model(model, lod, roof_height=roof_height)
    try:
        if mesh is None:
            write_bytes(target, _cityjson(model))
        elif suffix == ".scene":
            store_city(open_city(model, mesh), target)
        else:
            write_bytes(target, _MESH_WRITERS[suffix](mesh.scene))
    except OSError as error:
        raise CityModelError(
            f"{target} cannot be written: {error.strerror}.", "Choose another place or name."
        ) from None
    return mesh


def obj_text(scene: Scene) -> str:
    """Returns a scene as Wavefront OBJ, one object per building, in the local frame."""
    lines = [f"# {line}" for line in MeshFrame.of_scene(scene).comments()]
    vertices = scene.vertices.astype(np.float64)
    triangles = scene.triangles + 1
    for b, building_id in enumerate(scene.building_ids):
        lines.append(f"o {' '.join(building_id.split())}")
        own = vertices[scene.vertex_starts[b] : scene.vertex_starts[b + 1]]
        faces = triangles[scene.triangle_starts[b] : scene.triangle_starts[b + 1]]
        # One format of many lines at once takes half the time of one per line.
        for line, rows in (("v %.4f %.4f %.4f", own), ("f %d %d %d", faces)):
            if len(rows):
                lines.append("\n".join([line] * len(rows)) % tuple(rows.ravel().tolist()))
    return "\n".join(lines) + "\n"


def _ply(scene: Scene) -> bytes:
    trimesh: Any = import_module("trimesh")  # half typed, which is worse than not at all

    mesh = trimesh.Trimesh(scene.vertices, scene.triangles, process=False)
    content: bytes = mesh.export(file_type="ply")
    magic, newline, rest = content.partition(b"\n")
    lines = [f"comment {line}\n".encode() for line in MeshFrame.of_scene(scene).comments()]
    form, _, rest = rest.partition(b"\n")  # comments come after the line that names the form
    return b"".join([magic, newline, form, newline, *lines, rest])


def _glb(scene: Scene) -> bytes:
    """Returns binary glTF with one node per building; glTF looks along -z with y up."""
    trimesh: Any = import_module("trimesh")  # half typed, which is worse than not at all

    points = np.stack([scene.vertices[:, 0], scene.vertices[:, 2], -scene.vertices[:, 1]], axis=1)
    graph = trimesh.Scene()
    graph.metadata.update(MeshFrame.of_scene(scene).extras())
    for b, building_id in enumerate(scene.building_ids):
        first, last = scene.vertex_starts[b], scene.vertex_starts[b + 1]
        triangles = scene.triangles[scene.triangle_starts[b] : scene.triangle_starts[b + 1]] - first
        if len(triangles):
            mesh = trimesh.Trimesh(points[first:last], triangles, process=False)
            graph.add_geometry(mesh, node_name=building_id, geom_name=building_id)
    content: bytes = graph.export(file_type="glb")
    return content


def _cityjson(model: CityModel) -> bytes:
    polygons = model.polygons
    low = polygons.points.min(axis=0) if len(polygons.points) else np.zeros(3)
    whole = np.rint((polygons.points - low) / _MILLIMETRE).astype(np.int64)
    vertices, inverse = np.unique(whole, axis=0, return_inverse=True)
    indices = inverse.reshape(-1)
    objects: dict[str, Any] = {
        building_id: {"type": "Building", "geometry": []} for building_id in model.building_ids
    }
    order = np.lexsort((polygons.lod, polygons.building))
    key = polygons.building[order].astype(np.int64) * len(model.lods) + polygons.lod[order]
    for group in np.split(order, np.flatnonzero(np.diff(key)) + 1):
        if len(group):
            building_id = model.building_ids[polygons.building[group[0]]]
            objects[building_id]["geometry"].append(_multi_surface(model, group, indices))
    document: dict[str, Any] = {
        "type": "CityJSON",
        "version": "2.0",
        "transform": {"scale": [_MILLIMETRE] * 3, "translate": (low + model.origin).tolist()},
        "CityObjects": objects,
        "vertices": vertices.tolist(),
    }
    name = _reference_system(model.crs)
    if name is not None:
        document["metadata"] = {"referenceSystem": name}
    return json.dumps(document, separators=(",", ":")).encode()


def _multi_surface(
    model: CityModel, group: np.ndarray[Any, Any], indices: np.ndarray[Any, Any]
) -> dict[str, Any]:
    polygons = model.polygons
    boundaries = []
    for n in group.tolist():
        rings = range(polygons.polygon_starts[n], polygons.polygon_starts[n + 1])
        bounds = [(polygons.ring_starts[r], polygons.ring_starts[r + 1]) for r in rings]
        boundaries.append([indices[first:last].tolist() for first, last in bounds])
    kinds = [_SURFACE_NAMES.get(SurfaceKind(kind)) for kind in polygons.kind[group].tolist()]
    names = sorted({kind for kind in kinds if kind is not None})
    geometry: dict[str, Any] = {
        "type": "MultiSurface",
        "lod": model.lods[polygons.lod[group[0]]] or "1",
        "boundaries": boundaries,
    }
    if names:
        geometry["semantics"] = {
            "surfaces": [{"type": name} for name in names],
            "values": [names.index(kind) if kind is not None else None for kind in kinds],
        }
    return geometry


def _reference_system(crs: str | None) -> str | None:
    """Returns the name in CityJSON's form, which has one code; a compound of two keeps its plane."""
    if crs is None or not crs.startswith("EPSG:"):
        return None
    return f"https://www.opengis.net/def/crs/EPSG/0/{crs[5:].partition('+')[0]}"


_MESH_WRITERS: dict[str, Callable[[Scene], bytes]] = {
    ".obj": lambda scene: obj_text(scene).encode(),
    ".ply": _ply,
    ".glb": _glb,
}
FORMATS = (*_MESH_WRITERS, ".json", ".scene")
