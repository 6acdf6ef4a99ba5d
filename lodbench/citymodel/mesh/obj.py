"""Wavefront OBJ: metres, x east, y north, z up, or y up where so declared; what hangs together is a building.

Only positions and faces count. Lines, points, texture coordinates, normals, materials and groups
carry no surface. Numbers are read in bulk; a line at fault is looked for only when there is one.
"""

from __future__ import annotations

import re
from codecs import BOM_UTF8
from collections import Counter
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.cleaning import connected_components, number_rows, point_bits
from lodbench.citymodel.codes import ELEMENT_IGNORED
from lodbench.citymodel.coordinates import parse_rings
from lodbench.citymodel.mesh.reader import frame_of_comments, turned_up
from lodbench.citymodel.model import SurfaceKind
from lodbench.citymodel.raw import NotACity, RawCity, starts_of
from lodbench.errors import CityModelError
from lodbench.findings import Findings

# Texture and normal indices: `7/3/2` means point 7.
_TEXTURE_PART = re.compile(r"/[^\s;]*")
# lodbench writes its comments first.
_HEAD_LINES = 8
_SILENT = frozenset({"v", "f", "vt", "vn", "s", "o", "g", "mtllib"})


def read_obj(stream: BinaryIO, source: str, up_axis: str = "auto") -> RawCity:
    """Returns the faces of a Wavefront OBJ, grouped into buildings.

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
    building, num_buildings = _buildings(points, corners, counts)
    frame = frame_of_comments([line[1:].strip() for line in lines[:_HEAD_LINES] if line.startswith("#")])
    if frame is not None:
        points = points + frame.origin
    width = len(str(num_buildings))
    return RawCity(
        source=source,
        format="OBJ",
        srs_names=(frame.crs,) if frame is not None and frame.crs is not None else (),
        building_ids=tuple(f"component-{i + 1:0{width}d}" for i in range(num_buildings)),
        lods=("",),
        points=points[corners],
        ring_starts=starts_of(counts),
        polygon_starts=np.arange(len(counts) + 1),
        building=building.astype(np.int32),
        lod=np.zeros(len(counts), np.int16),
        kind=np.full(len(counts), SurfaceKind.UNKNOWN, np.uint8),
        srs=np.zeros(len(counts), np.int16),
        findings=findings,
        axis_orders=("east_first",) if frame is not None and frame.crs is not None else (),
    )


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


def _buildings(
    points: NDArray[np.float64], corners: NDArray[np.int64], counts: NDArray[np.int64]
) -> tuple[NDArray[np.int64], int]:
    """Returns the building of each face: faces that share a position, directly or through others."""
    node, _ = number_rows(point_bits(points[corners]))
    ends = np.cumsum(counts)
    following = np.concatenate([node[1:], node[:1]])
    following[ends - 1] = node[ends - counts]
    root = connected_components(int(node.max()) + 1, node, following)
    roots, building = np.unique(root[node[ends - counts]], return_inverse=True)
    return building.reshape(-1), len(roots)


def _line_error(source: str, line: int, text: str, what: str) -> CityModelError:
    return CityModelError(f"{source}, line {line + 1}: `{text[:60]}` {what}.", "Mend or remove the line.")
