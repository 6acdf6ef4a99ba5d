"""The demo town as scene props: its buildings at level of detail 3, and all that stands between them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.model import Polygons, SurfaceKind
from lodbench.citymodel.raw import starts_of
from lodbench.citymodel.triangulate import triangulate
from lodbench.findings import Findings
from lodbench.kernels.looks import SurfaceClass
from lodbench.storage import random_stream
from lodbench.synthesis.objects.mesh_builder import MeshBuilder, palette, pick
from lodbench.synthesis.objects.scene_props import SceneProps
from lodbench.synthesis.town.buildings import Building
from lodbench.synthesis.town.ground import add_ground
from lodbench.synthesis.town.shapes import Points
from lodbench.synthesis.town.solid import Solid
from lodbench.synthesis.town.town import ORIGIN_M, Town
from lodbench.synthesis.town.trees_and_cars import add_greenery, add_traffic

# A body, and the class of all its surfaces where they have one.
Body = tuple[Solid, SurfaceClass | None]

_FLAT_COSINE = 0.985  # roofs that lean less are flat: ten degrees
_CLASSES = {
    SurfaceKind.WALL: SurfaceClass.WALL,
    SurfaceKind.ROOF: SurfaceClass.ROOF_TILE,
    SurfaceKind.GROUND: SurfaceClass.FLOOR,
    SurfaceKind.FLOOR: SurfaceClass.FLOOR,
}
_OPENINGS = {False: SurfaceClass.WINDOW, True: SurfaceClass.DOOR}
# What is alike on all buildings: its colour, and how much darker and brighter it may be.
_FITTINGS = {
    SurfaceClass.WINDOW: (palette("3a444e"), 0.8, 1.25),
    SurfaceClass.DOOR: (palette("604634"), 0.7, 1.4),
    SurfaceClass.FRAME: (palette("c4c4c0"), 0.8, 1.1),
    SurfaceClass.CHIMNEY: (palette("8e5c4c"), 0.8, 1.2),
}
_SOFFIT = palette("cec8bc")[0]


def demo_props(town: Town) -> SceneProps:
    """Returns what a photo of the town shows, in the frame of ``ORIGIN_M``."""
    builder = MeshBuilder(len(town.standing))
    # Each building is in colours of its own, with windows, doors, chimneys and balconies.
    colours = np.stack([building_colours(town, building.identifier) for building in town.standing])
    bodies = [fine_bodies(building) for building in town.standing]
    add_buildings(builder, bodies, colours, np.arange(len(bodies)))
    add_ground(builder, town)
    add_greenery(builder, town)
    add_traffic(builder, town)
    return builder.build(ORIGIN_M)


def add_buildings(
    builder: MeshBuilder, buildings: Sequence[Sequence[Body]], colours: Points, objects: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Adds the surfaces of buildings, each of one or more bodies; returns the polygon of each triangle, (T,).

    Colours are (B, 8, 3) RGB by surface class from ``WALL`` on, objects (B,) the buildings' numbers.
    """
    faces = [
        (number, solid.points, face, part or _CLASSES.get(face.kind, _OPENINGS[face.is_door]))
        for number, bodies in enumerate(buildings)
        for solid, part in bodies
        for face in solid.faces
    ]
    rings = [points[list(ring)] for _, points, face, _ in faces for ring in face.rings]
    polygons = Polygons(
        points=np.concatenate(rings),
        ring_starts=starts_of(np.array([len(ring) for ring in rings])),
        polygon_starts=starts_of(np.array([len(face.rings) for _, _, face, _ in faces])),
        building=np.array([number for number, *_ in faces], np.int32),
        lod=np.zeros(len(faces), np.int16),
        kind=np.array([kind for *_, kind in faces], np.uint8),
    )
    result = triangulate(polygons, tuple(map(str, objects)), Findings())
    surface, owner = polygons.kind[result.polygon], polygons.building[result.polygon]
    a, b, c = polygons.points[result.triangles].swapaxes(0, 1)
    normal = np.cross(b - a, c - a)
    is_level = np.abs(normal[:, 2]) > _FLAT_COSINE * np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    surface[is_level & (surface == SurfaceClass.ROOF_TILE)] = SurfaceClass.ROOF_FLAT
    tint = colours[owner, surface - SurfaceClass.WALL]
    builder.add(surface, polygons.points, result.triangles, tint, objects[owner])
    return result.polygon


def fine_bodies(building: Building) -> list[Body]:
    """Returns the bodies of a building at LoD3, and the class of all surfaces of those that have one."""
    eave = building.lod2.points[:, 2].min() + building.plan.roof.eave_m
    extra = [
        (solid, SurfaceClass.CHIMNEY if solid.points[:, 2].max() > eave + 0.3 else SurfaceClass.FRAME)
        for solid in building.installations
    ]
    return [(building.lod3, None), *extra]


def building_colours(town: Town, name: str) -> Points:
    """Returns the colours of a building, (8, 3) RGB by surface class from ``WALL`` on."""
    chances, look = random_stream(town.seed, "demo", name, "colour"), town.look
    palettes = (look.walls, look.tiles, look.flat_roofs)
    wall, tile, flat = (pick(colours, chances, 0.92, 1.06) for colours in palettes)
    chances.uniform()
    fittings = [pick(colours, chances, low, high) for colours, low, high in _FITTINGS.values()]
    return np.stack([wall, flat, tile, *fittings, _SOFFIT])
