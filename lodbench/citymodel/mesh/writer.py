"""Scenes as Wavefront OBJ, PLY and binary glTF, each with its origin and reference system."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

from lodbench.citymodel.mesh.frames import MeshFrame
from lodbench.citymodel.scene import Scene


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


def ply_bytes(scene: Scene) -> bytes:
    """Returns a scene as binary PLY, one mesh, in the local frame."""
    trimesh: Any = import_module("trimesh")  # half typed, which is worse than not at all

    mesh = trimesh.Trimesh(scene.vertices, scene.triangles, process=False)
    content: bytes = mesh.export(file_type="ply")
    magic, newline, rest = content.partition(b"\n")
    lines = [f"comment {line}\n".encode() for line in MeshFrame.of_scene(scene).comments()]
    form, _, rest = rest.partition(b"\n")  # comments come after the line that names the form
    return b"".join([magic, newline, form, newline, *lines, rest])


def glb_bytes(scene: Scene) -> bytes:
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
