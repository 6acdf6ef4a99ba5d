"""The naive way to read a city, and other people's readers, to stand beside lodbench's own."""

from __future__ import annotations

import math
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.gml.xml import Element, local_name, parse_document
from lodbench.errors import CityModelError

_GML = ("{http://www.opengis.net/gml}", "{http://www.opengis.net/gml/3.2}")
_PEER_TIMEOUT_S = 600
Projection = Callable[[NDArray[np.float64]], NDArray[np.float64] | None]


def naive_mesh(
    path: Path, lod: str, project: Projection | None = None
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Returns points and triangles of one level of a CityGML file, read the way most scripts do.

    A tree of the whole document, float() per number, one earcut per polygon; no references, no
    reference system, no checks. For files one trusts only.

    Args:
        path: A CityGML file without compression.
        lod: Level of detail, a whole number.
        project: How to find a polygon's plane; ``project_plainly`` by default.

    Returns:
        points: (P, 3) in the coordinates of the file.
        triangles: (T, 3).

    Raises:
        CityModelError: The file is no XML, or has no polygon of that level.
    """
    tree = parse_document(path)
    points: list[NDArray[np.float64]] = []
    triangles: list[NDArray[np.int64]] = []
    count = 0
    for polygon in tree.iter(*(prefix + "Polygon" for prefix in _GML)):
        if _level_of(polygon) != lod:
            continue
        rings = list(_rings(polygon))
        corners = _naive_triangles(rings, project or project_plainly)
        if len(corners):
            points.extend(rings)
            triangles.append(corners + count)
            count += sum(len(ring) for ring in rings)
    if not triangles:
        raise CityModelError(f"The naive reader finds no LoD{lod} in {path}.")
    return np.concatenate(points), np.concatenate(triangles)


def _level_of(element: Element) -> str | None:
    node = element.getparent()
    while node is not None:
        name = local_name(node.tag)
        if name.startswith("lod") and name[3:4].isdigit():
            return name[3]
        node = node.getparent()
    return None


def _rings(polygon: Element) -> Iterator[NDArray[np.float64]]:
    """Returns the rings of a polygon with their closing points."""
    for ring in polygon.iter(*(prefix + "LinearRing" for prefix in _GML)):
        numbers = [float(text) for child in ring for text in (child.text or "").split()]
        yield np.array(numbers).reshape(-1, 3)


def project_plainly(outline: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Returns the axes (2, 3) of a ring's plane by vector algebra as one writes it down, or None."""
    normal = np.cross(outline, np.roll(outline, -1, axis=0)).sum(axis=0)
    length = np.linalg.norm(normal)
    if length == 0.0:
        return None
    normal /= length
    across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(normal, across)])


def project_tuned(outline: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Returns the same with all that can be scalar made scalar: half the time of the naive way."""
    normal = np.cross(outline[:-1], outline[1:]).sum(axis=0)
    length = math.sqrt(normal @ normal)
    if length == 0.0:
        return None
    x, y, z = (normal / length).tolist()
    flat = math.hypot(x, y)
    across = (-y / flat, x / flat, 0.0) if flat > 1e-6 else (1.0, 0.0, 0.0)
    return np.array([across, (-z * across[1], z * across[0], x * across[1] - y * across[0])])


def _naive_triangles(rings: list[NDArray[np.float64]], project: Projection) -> NDArray[np.int64]:
    """Returns triangles of a polygon in its own plane, as bent and narrow ones need it."""
    outline = rings[0] - rings[0][0]  # coordinates far from zero would cost digits
    axes = project(outline)
    if axes is None:
        return np.zeros((0, 3), np.int64)
    points = outline if len(rings) == 1 else np.concatenate(rings) - rings[0][0]
    ends = np.cumsum([len(ring) for ring in rings]).astype(np.uint32)
    corners: NDArray[np.int64] = mapbox_earcut.triangulate_float64(points @ axes.T, ends).astype(np.int64)
    return corners.reshape(-1, 3)


def time_cjio(path: Path) -> tuple[float, float] | str:
    """Returns the seconds cjio's OBJ export takes and the area of its triangles, or why it cannot run.

    Args:
        path: A CityJSON file.
    """
    program = shutil.which("cjio")
    if program is None:
        return "cjio is not installed"
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "cjio.obj"
        start = time.perf_counter()
        try:
            done = subprocess.run(  # noqa: S603 - a program the user installed, with our arguments
                [program, str(path), "export", "obj", str(target)],
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                timeout=_PEER_TIMEOUT_S,
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            return f"cjio failed ({error})"
        seconds = time.perf_counter() - start
        if done.returncode != 0 or not target.is_file():
            last = done.stdout.decode(errors="replace").strip().rpartition("\n")[2]
            return f"cjio failed, exit code {done.returncode}: {last[:60]}"
        return seconds, obj_area(target)


def obj_area(path: Path) -> float:
    """Returns the area of the triangles of an OBJ file, square metres."""
    points, faces = [], []
    for line in path.read_text(encoding="utf-8").splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            points.append([float(word) for word in words[1:4]])
        elif words[:1] == ["f"]:
            faces.append([int(word.partition("/")[0]) - 1 for word in words[1:4]])
    corners = np.array(points)[np.array(faces, np.int64).reshape(-1, 3)]
    vectors = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return 0.5 * float(np.linalg.norm(vectors, axis=1).sum())
