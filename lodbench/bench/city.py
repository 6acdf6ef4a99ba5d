"""How fast, and in how little memory, cities are read, beside the naive way and other readers.

Each job is timed several times in one run and the fastest counts, for peers as for us. The memory
of a large file is that of a process of its own: the peak of what is resident (which Linux states)
above what is resident after a small file, when everything is loaded and compiled.
"""

from __future__ import annotations

import json
import math
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

from lodbench.bench import (
    Figure,
    Progress,
    Report,
    no_progress,
    plain_report,
    python_output,
    seconds_of_command,
)
from lodbench.citymodel import mesh_model, open_scene, read_city_model
from lodbench.citymodel.derive import keep_buildings
from lodbench.citymodel.gml.writer import CityGmlWriter
from lodbench.citymodel.gml.xml import Element, local_name, parse_document
from lodbench.citymodel.mesh.writer import obj_text
from lodbench.citymodel.model import CityModel
from lodbench.citymodel.scene_file import read_scene
from lodbench.errors import CityModelError, ConfigError
from lodbench.params import flag
from lodbench.storage import write_chunks

_MEGABYTE = 1e6
_PASSES_IN_TURN = 12
_MEASURING = "The measurement"
_CLEAR_REFS = Path("/proc/self/clear_refs")
# What the allocator kept from the small file is given back first, or the large one could hide in it.
_MEMORY_SCRIPT = """
import ctypes, gc, json, re, sys
import numba  # which a small file goes without
from lodbench.citymodel import open_scene
def resident(name):
    with open("/proc/self/status") as status:
        return int(re.search(name + r":\\s*(\\d+) kB", status.read())[1]) * 1024
small, large, lod = sys.argv[1:]
open_scene(small, lod=lod)
gc.collect()
getattr(ctypes.CDLL(None), "malloc_trim", int)(0)
with open("/proc/self/clear_refs", "w") as peak:
    peak.write("5")
before = resident("VmRSS")
scene = open_scene(large, lod=lod)
peak = resident("VmHWM")
arrays = sum(a.nbytes for a in (scene.vertices, scene.triangles, scene.vertex_starts, scene.triangle_starts))
print(json.dumps({"before": before, "peak": peak, "arrays": arrays, "buildings": scene.num_buildings}))
"""
# CPU seconds of reading and meshing, the least of many passes, the digest of what came out.
_TURN_SCRIPT = """
import json, sys, time
import numba  # which small cities go without
from lodbench.citymodel import open_scene
city, lod, passes = sys.argv[1], sys.argv[2] or None, int(sys.argv[3])
digest, times = open_scene(city, lod=lod).digest(), []
for _ in range(passes):
    start = time.process_time()
    open_scene(city, lod=lod)
    times.append(time.process_time() - start)
print(json.dumps([min(times), digest]))
"""
_GAP_M = 50.0
_TILE_BUILDINGS = 5
_GML = ("{http://www.opengis.net/gml}", "{http://www.opengis.net/gml/3.2}")
_PEER_TIMEOUT_S = 600
Projection = Callable[[NDArray[np.float64]], NDArray[np.float64] | None]


@dataclass(frozen=True, slots=True)
class CityOptions:
    """What to measure; with tiles nothing else is."""

    lod: str | None = flag(None, "level of detail, or finest (lowest with walls)")
    repeats: int = flag(5, "passes, the fastest counts (5)")
    tiles: int = flag(0, "instead: make one scene of so many tiles of its buildings; 0 for none (0)")
    workers: int | None = flag(None, "processes for the tiles (one per core)")
    beside: str | None = flag(None, "Python whose lodbench reads the city in turns with this one")
    large_mb: int = flag(137, "size of the city repeated, for the memory figure; 0 for none (137)")

    def __post_init__(self) -> None:
        if self.repeats < 1 or self.large_mb < 0 or self.tiles < 0:
            raise ConfigError("repeats is at least 1, large_mb and tiles at least 0.")
        if self.beside is not None and not Path(self.beside).is_file():
            raise ConfigError(f"There is no Python {self.beside}.", "Name the one of another environment.")


def measure_city(city: Path, options: CityOptions | None = None, progress: Progress = no_progress) -> Report:
    """Returns the figures of a city file.

    CityGML stands beside the naive way, at the same level of detail; CityJSON beside cjio's export
    to OBJ, all levels, where cjio is installed.

    Raises:
        CityModelError: The file cannot be read.
    """
    options = options or CityOptions()
    progress(0, 4)
    model = read_city_model(city)
    if options.tiles:
        with tempfile.TemporaryDirectory() as folder:
            rows = measure_tiles(model, options.tiles, Path(folder), options.workers)
        return plain_report(city.name, rows)
    mesh = mesh_model(model, options.lod)
    lod = mesh.scene.lod
    size_mb = city.stat().st_size / _MEGABYTE
    seconds = _best(lambda: open_scene(city, lod=options.lod), options.repeats)
    progress(1, 4)
    rows = _beside_naive(city, model, lod, seconds, options.repeats)
    rows.append(Figure("read and mesh, data rate", size_mb / seconds, "MB/s"))
    if options.beside is not None:
        rows.append(_beside_build(city, options))
    rows.append(Figure("triangles", len(mesh.scene.triangles), ""))
    rows.append(Figure("area lost", round(mesh.lost_m2, 3), "m2"))
    progress(2, 4)
    if model.format == "CityJSON":
        rows += _beside_cjio(city, options.repeats)
    progress(3, 4)
    if options.large_mb and model.format == "CityGML" and _CLEAR_REFS.exists():
        rows += _memory(city, lod, options.large_mb)
    progress(4, 4)
    return plain_report(city.name, rows)


def _beside_build(city: Path, options: CityOptions) -> Figure:
    """Returns what this build and another take for the city, processes in turns.

    Raises:
        CityModelError: One of them fails, or they make different scenes of it.
    """
    builds: dict[str, list[tuple[float, str]]] = {
        sys.executable: [],
        str(Path(options.beside or "").absolute()): [],
    }
    for _ in range(options.repeats):
        for python, stated in builds.items():
            words = [str(city.resolve()), options.lod or "", str(_PASSES_IN_TURN)]
            cpu_s, digest = json.loads(python_output(_MEASURING, ["-P", "-c", _TURN_SCRIPT, *words], python))
            stated.append((float(cpu_s), str(digest)))
    if len({digest for stated in builds.values() for _, digest in stated}) > 1:
        raise CityModelError("The two builds make different scenes of this city.")
    own, other = (min(cpu_s for cpu_s, _ in stated) for stated in builds.values())
    name = "read and mesh, CPU time"
    return Figure(name, own * 1e3, "ms", "the other build, in turns", other * 1e3, other / own)


def _best(job: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        job()
        times.append(time.perf_counter() - start)
    return min(times)


def _beside_naive(city: Path, model: CityModel, lod: str, seconds: float, repeats: int) -> list[Figure]:
    title = f"read and mesh LoD{lod}" if lod else "read and mesh"
    if model.format != "CityGML":
        return [Figure(title, seconds * 1e3, "ms")]
    figures: list[Figure] = []
    for peer, project in _NAIVE_WAYS.items():
        try:
            peer_seconds = _best(partial(naive_mesh, city, lod, project), min(repeats, 3))
        except CityModelError as error:
            return [Figure(title, seconds * 1e3, "ms", f"naive ({error.message})")]
        name = title if not figures else f"{title}, the peer tuned"
        figures.append(Figure(name, seconds * 1e3, "ms", peer, peer_seconds * 1e3, peer_seconds / seconds))
    return figures


def _beside_cjio(city: Path, repeats: int) -> list[Figure]:
    def export() -> float:
        model = read_city_model(city)
        meshes = [mesh_model(model, lod) for lod in model.lods]
        for mesh in meshes:
            obj_text(mesh.scene)
        return sum(mesh.area_m2 for mesh in meshes)

    area = export()
    seconds = _best(export, repeats)
    title = "read, mesh and write OBJ, all LoDs"
    peer = time_cjio(city)
    if isinstance(peer, str):
        return [Figure(title, seconds, "s", peer)]
    peer_seconds, peer_area = peer
    return [
        Figure(title, seconds, "s", "cjio export obj", peer_seconds, peer_seconds / seconds),
        Figure("area meshed, all LoDs", area, "m2", "cjio export obj", peer_area),
    ]


def _memory(city: Path, lod: str, large_mb: int) -> list[Figure]:
    with tempfile.TemporaryDirectory() as folder:
        large = Path(folder) / "large.gml"
        repeat_members(city, large, int(large_mb * _MEGABYTE))
        words = ["-P", "-c", _MEMORY_SCRIPT, str(city), str(large), lod]
        result = json.loads(python_output(_MEASURING, words))
        size_mb = large.stat().st_size / _MEGABYTE
    above = result["peak"] - result["before"] - result["arrays"]
    title = f"{size_mb:.0f} MB file, {result['buildings']:,} buildings: peak memory"
    return [
        Figure(f"{title} above its {result['arrays'] / _MEGABYTE:.0f} MB of arrays", above / _MEGABYTE, "MB")
    ]


def repeat_members(source: Path, target: Path, num_bytes: int) -> None:
    """Writes a large CityGML file: the members of a small one, over and over.

    Raises:
        CityModelError: The source has no members.
    """
    content = source.read_bytes()
    first = re.search(rb"<(?:\w+:)?cityObjectMember\b", content)
    ends = list(re.finditer(rb"</(?:\w+:)?cityObjectMember>", content))
    if first is None or not ends:
        raise CityModelError(f"{source} has no cityObjectMember to repeat.")
    start, end = first.start(), ends[-1].end()
    with target.open("wb") as stream:
        stream.write(content[:start])
        for _ in range(max(1, round((num_bytes - len(content)) / (end - start)) + 1)):
            stream.write(content[start:end])
        stream.write(content[end:])


def measure_tiles(model: CityModel, tiles: int, folder: Path, workers: int | None) -> list[Figure]:
    """Returns the figures of so many tiles.

    Args:
        model: The city whose first buildings every tile has.
        tiles: How many.
        folder: An empty one, for tiles and scene.
        workers: Processes; None for one per core.
    """
    own = keep_buildings(model, np.arange(len(model.building_ids)) < _TILE_BUILDINGS)
    (folder / "tiles").mkdir()
    size_mb = write_tiles(own, tiles, folder / "tiles") / 1e6
    scene = folder / "city.scene"
    words = [] if workers is None else ["--workers", str(workers)]
    seconds = seconds_of_command("city", "convert", str(folder / "tiles"), str(scene), *words)
    # Linux states kilobytes: the largest of the processes, the one that joins included.
    peak_mb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e3
    stated = f"{tiles:,} tiles, {size_mb:,.0f} MB, {tiles * len(own.building_ids):,} buildings"
    start = time.perf_counter()
    opened, _ = read_scene(scene)
    open_seconds = time.perf_counter() - start
    return [
        Figure(f"{stated}: into one scene", seconds, "s"),
        Figure("tiles", tiles / seconds, "1/s"),
        Figure("peak memory of the largest process", peak_mb, "MB"),
        Figure("triangles of the scene", len(opened.triangles), ""),
        Figure("opening the scene, all its bytes checked", open_seconds, "s"),
        Figure("lodbench city info SCENE", seconds_of_command("city", "info", str(scene)), "s"),
    ]


def write_tiles(model: CityModel, tiles: int, folder: Path) -> int:
    """Writes a city so many times, side by side; returns the bytes written."""
    x, y, _ = np.ptp(model.polygons.points, axis=0) + _GAP_M
    columns = int(np.ceil(np.sqrt(tiles)))
    size = 0
    for n in range(tiles):
        shift = np.array([n % columns * x, n // columns * y, 0.0])
        ids = tuple(f"t{n}-{name}" for name in model.building_ids)
        moved = replace(model, origin=model.origin + shift, building_ids=ids, objects=None, polygon_ids=())
        moved = replace(moved, solids=None, polygons=replace(model.polygons, part=None))
        path = folder / f"{n:06d}.gml"
        write_chunks(path, CityGmlWriter(moved).chunks(), survives_power_cut=False)
        size += path.stat().st_size
    return size


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


_NAIVE_WAYS = {
    "naive DOM, earcut per polygon": project_plainly,
    "naive with scalar projection": project_tuned,
}


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
