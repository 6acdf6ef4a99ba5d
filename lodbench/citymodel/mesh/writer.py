"""Scenes as Wavefront OBJ, PLY and binary glTF, each with its origin and reference system."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.mesh.reader import MeshFrame
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.textured_map import TexturedMesh
from lodbench.citymodel.textures import png_of
from lodbench.storage import make_folder, write_bytes, write_text


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


def write_textured(mesh: TexturedMesh, frame: MeshFrame, target: Path) -> None:
    """Writes a textured mesh as ``.glb`` or ``.obj``, in the local frame; origin and system stand in it.

    Args:
        mesh: In the coordinates of the frame's reference system.
        frame: What to subtract, and what the coordinates are in.
        target: An OBJ gets ``NAME.mtl`` and a folder ``NAME_pictures`` beside it.

    Raises:
        OSError: The folder is missing or the disk full.
    """
    local = mesh.shifted(-frame.origin)
    if target.suffix.lower() == ".glb":
        write_bytes(target, _glb(local, frame))
    else:
        _write_obj(local, frame, target)


def _groups(mesh: TexturedMesh) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Yields each picture's number, -1 for none, and its triangles."""
    for number in np.unique(mesh.picture).tolist():
        yield number, np.flatnonzero(mesh.picture == number)


def _glb(mesh: TexturedMesh, frame: MeshFrame) -> bytes:
    """Returns binary glTF with one node per picture; glTF looks along -z with y up."""
    trimesh: Any = import_module("trimesh")  # half typed, which is worse than not at all
    image: Any = import_module("PIL.Image")
    graph = trimesh.Scene()
    graph.metadata.update(frame.extras())
    for number, own in _groups(mesh):
        points = mesh.corners[own].reshape(-1, 3)[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
        faces = np.arange(len(points)).reshape(-1, 3)
        if number < 0:
            colours = mesh.colours[own].reshape(-1, 3)
            part = trimesh.Trimesh(points, faces, vertex_colors=colours, process=False)
        else:
            picture = image.fromarray(mesh.pictures[number])
            picture.format = "PNG"  # what was decoded is lost no second time
            material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture, metallicFactor=0.0)
            visual = trimesh.visual.TextureVisuals(uv=mesh.uv[own].reshape(-1, 2), material=material)
            part = trimesh.Trimesh(points, faces, visual=visual, process=False)
        name = "plain" if number < 0 else f"picture_{number}"
        graph.add_geometry(part, node_name=name, geom_name=name)
    content: bytes = graph.export(file_type="glb")
    return content


def _write_obj(mesh: TexturedMesh, frame: MeshFrame, target: Path) -> None:
    lines = [*(f"# {line}" for line in frame.comments()), f"mtllib {target.stem}.mtl"]
    materials, first = [], 1
    pictures = target.with_name(f"{target.stem}_pictures")
    for number, own in _groups(mesh):
        name = "plain" if number < 0 else f"picture_{number}"
        lines += [f"o {name}", f"usemtl {name}"]
        corners = mesh.corners[own].reshape(-1, 3)
        lines += ["v {:.4f} {:.4f} {:.4f}".format(*corner) for corner in corners.tolist()]
        lines += ["vt {:.6f} {:.6f}".format(*place) for place in mesh.uv[own].reshape(-1, 2).tolist()]
        lines += ["f {0}/{0} {1}/{1} {2}/{2}".format(n, n + 1, n + 2)
                  for n in range(first, first + len(corners), 3)]  # fmt: skip
        first += len(corners)
        if number < 0:
            red, green, blue = (mesh.colours[own].reshape(-1, 3).mean(axis=0) / 255).tolist()
            materials += [f"newmtl {name}", f"Kd {red:.4f} {green:.4f} {blue:.4f}"]
        else:
            make_folder(pictures)
            write_bytes(pictures / f"{number}.png", png_of(mesh.pictures[number]))
            materials += [f"newmtl {name}", "Kd 1 1 1", f"map_Kd {pictures.name}/{number}.png"]
    write_text(target.with_suffix(".mtl"), "\n".join(materials) + "\n")
    write_text(target, "\n".join(lines) + "\n")
