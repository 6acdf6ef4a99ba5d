"""Reading textured meshes: OBJ with materials, glTF, PLY with colours; and setting them over the city."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.errors import DatasetError
from lodbench.synthesis.photo.textured import TexturedMesh

Floats = NDArray[np.float64]

_ENDINGS = (".obj", ".glb", ".gltf", ".ply")
# Share of the smaller of two plans that must lie on the other for both to be of one place.
_LEAST_OVERLAP = 0.2
_GREY = 170


def read_textured(path: Path, up_axis: str) -> TexturedMesh:
    """Returns a textured mesh, in the coordinates of its file, z up.

    Args:
        path: OBJ, glTF or PLY.
        up_axis: ``y``, ``z``, or ``auto``: y for glTF, z for the others.

    Raises:
        DatasetError: It is missing, unreadable, of another kind, or files it names are missing; the
            message lists them.
    """
    import trimesh

    if not path.is_file() or path.suffix.lower() not in _ENDINGS:
        what = "is no textured mesh" if path.is_file() else "does not exist"
        raise DatasetError(f"{path} {what}.", f"texture_model takes {', '.join(_ENDINGS)}.")
    missing = [name for name in _named_files(path) if not (path.parent / name).is_file()]
    if missing:
        raise DatasetError(
            f"{path.name} names files that are not there: {', '.join(missing)}.",
            f"Put them into {path.parent}, or mend the names.",
        )
    try:
        loaded = trimesh.load_scene(path, process=False)
        parts = [_part(loaded, node) for node in loaded.graph.nodes_geometry]
    except Exception as error:  # trimesh lets the errors of every parser it uses through
        raise DatasetError(f"{path} cannot be read as a mesh ({error}).", "Try it in a viewer.") from None
    if not parts:
        raise DatasetError(f"{path} has no triangles.", "A point cloud has no surface to picture.")
    mesh = _joined(parts)
    if not np.isfinite(mesh.corners).all():
        raise DatasetError(f"{path} has coordinates that are not finite.", "Repair or export it again.")
    if up_axis == "y" or (up_axis == "auto" and path.suffix.lower() in (".glb", ".gltf")):
        x, y, z = np.moveaxis(mesh.corners, 2, 0)
        mesh = TexturedMesh(np.stack([x, -z, y], axis=2), mesh.uv, mesh.picture, mesh.colours, mesh.pictures)
    return mesh


def offset_to_city(mesh: TexturedMesh, scene: Scene, name: str) -> tuple[Floats, str]:
    """Returns what brings a mesh into a scene's frame, (3,) metres, and what was found out about it.

    Its coordinates may be the city's, or the scene's local ones; where it lies over the city decides.

    Raises:
        DatasetError: It lies over the city in neither.
    """
    low, high = scene.extent_m
    found = []
    for frame, offset in (("the city's coordinates", -scene.origin), ("local coordinates", np.zeros(3))):
        points = mesh.corners.reshape(-1, 3) + offset
        share = _overlap(points.min(axis=0), points.max(axis=0), low, high)
        if share >= _LEAST_OVERLAP:
            return offset, f"{name} is in {frame}; {share:.0%} of the smaller plan overlap"
        found.append(f"{share:.0%} in {frame}")
    box = mesh.corners.reshape(-1, 3)
    raise DatasetError(
        f"{name} is not where the city is: their plans overlap {', '.join(found)}. It spans x "
        f"{box[:, 0].min():.0f} to {box[:, 0].max():.0f}, y {box[:, 1].min():.0f} to {box[:, 1].max():.0f}.",
        "Move it into the city's coordinates, or set texture_up=y or z if it lies on its side.",
    )


def _overlap(low: Floats, high: Floats, other_low: Floats, other_high: Floats) -> float:
    """Returns the common share of the smaller of two plans; 0 where their heights have nothing in common."""
    common = np.minimum(high, other_high) - np.maximum(low, other_low)
    if (common[:2] <= 0).any() or common[2] < 0:
        return 0.0
    areas = [float((b - a)[:2].prod()) for a, b in ((low, high), (other_low, other_high))]
    return float(common[:2].prod()) / max(min(areas), 1e-9)


def _named_files(path: Path) -> list[str]:
    """Returns the files that a mesh file names: materials, textures, buffers."""
    suffix = path.suffix.lower()
    if suffix == ".gltf":
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except ValueError:
            return []
        entries = [*content.get("images", []), *content.get("buffers", [])]
        uris = [str(entry.get("uri", "")) for entry in entries]
        return sorted({uri for uri in uris if uri and not uri.startswith("data:")})
    if suffix != ".obj":
        return []
    libraries = _after(path, "mtllib")
    textures = [
        f"{Path(library).parent.as_posix()}/{name}" if Path(library).parent != Path() else name
        for library in libraries
        if (path.parent / library).is_file()
        for name in _after(path.parent / library, "map_Kd")
    ]
    return sorted({*libraries, *textures})


def _after(path: Path, keyword: str) -> list[str]:
    """Returns what follows a keyword on its lines; of a texture with options, the last word."""
    found = []
    with path.open(encoding="latin-1") as stream:
        for line in stream:
            words = line.strip().split(maxsplit=1)
            if len(words) == 2 and words[0] == keyword:
                found.append(words[1].split()[-1] if words[1].startswith("-") else words[1])
    return found


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
        picture = np.asarray(image.convert("RGB"), dtype=np.uint8)
        blank = np.zeros((count, 3, 3), dtype=np.uint8)
        return TexturedMesh(
            corners[faces], np.asarray(uv, np.float64)[faces], np.zeros(count, np.int32), blank, (picture,)
        )
    if material is not None:
        colours = np.broadcast_to(np.asarray(material.main_color)[:3], (count, 3, 3))
    elif part.visual.defined:
        colours = np.asarray(part.visual.vertex_colors)[:, :3][faces]
    else:
        colours = np.full((count, 3, 3), _GREY)
    none = np.full(count, -1, dtype=np.int32)
    return TexturedMesh(corners[faces], np.zeros((count, 3, 2)), none, colours.astype(np.uint8), ())


def _joined(parts: list[TexturedMesh]) -> TexturedMesh:
    starts = np.cumsum([0, *[len(part.pictures) for part in parts[:-1]]])
    numbers = [
        np.where(part.picture < 0, -1, part.picture + start)
        for part, start in zip(parts, starts, strict=True)
    ]
    return TexturedMesh(
        np.concatenate([part.corners for part in parts]),
        np.concatenate([part.uv for part in parts]),
        np.concatenate(numbers).astype(np.int32),
        np.concatenate([part.colours for part in parts]),
        tuple(picture for part in parts for picture in part.pictures),
    )
