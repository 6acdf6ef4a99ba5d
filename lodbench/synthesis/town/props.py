"""The demo town as scene props: its buildings at level of detail 3, and all that stands between them."""

from __future__ import annotations

from collections.abc import Sequence, Sized
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.model import Polygons, SurfaceKind
from lodbench.citymodel.triangulate import triangulate
from lodbench.findings import Findings
from lodbench.storage import random_stream
from lodbench.synthesis.objects.mesh_builder import MeshBuilder, palette, pick
from lodbench.synthesis.objects.scene_props import SceneProps, SurfaceClass
from lodbench.synthesis.town.building import Building
from lodbench.synthesis.town.citygml_writer import ORIGIN_M
from lodbench.synthesis.town.ground import add_ground
from lodbench.synthesis.town.looks import TownLook
from lodbench.synthesis.town.shapes import Points
from lodbench.synthesis.town.solid import Face, Solid
from lodbench.synthesis.town.town import Town
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
    _add_buildings(builder, town)
    add_ground(builder, town)
    add_greenery(builder, town)
    add_traffic(builder, town)
    return builder.build(ORIGIN_M)


class BuildingSurfaces(NamedTuple):
    """The surfaces of buildings as triangles.

    Attributes:
        points: (P, 3) local metres.
        triangles: (T, 3) indices into ``points``, counter-clockwise seen from outside.
        polygon: (T,) planar polygon that a triangle is part of.
        surface: (T,) ``SurfaceClass``.
        building: (T,) number of the building, in the order given.
    """

    points: Points
    triangles: NDArray[np.int64]
    polygon: NDArray[np.int64]
    surface: NDArray[np.uint8]
    building: NDArray[np.int64]


def _add_buildings(builder: MeshBuilder, town: Town) -> None:
    """Adds walls, roofs, windows, doors, chimneys and balconies, each building in colours of its own."""
    names = tuple(building.identifier for building in town.standing)
    found = building_surfaces([fine_bodies(building) for building in town.standing], names)
    colours = np.stack([building_colours(town.look, town.seed, name) for name in names])
    tint = colours[found.building, found.surface - SurfaceClass.WALL]
    builder.add(found.surface, found.points, found.triangles, tint, found.building)


def building_surfaces(buildings: Sequence[Sequence[Body]], names: tuple[str, ...]) -> BuildingSurfaces:
    """Returns the surfaces of buildings, each one or more bodies with the class of all their surfaces."""
    faces = [
        (number, solid.points, face, part or _class_of(face))
        for number, bodies in enumerate(buildings)
        for solid, part in bodies
        for face in solid.faces
    ]
    rings = [points[list(ring)] for _, points, face, _ in faces for ring in face.rings]
    polygons = Polygons(
        points=np.concatenate(rings),
        ring_starts=_starts(rings),
        polygon_starts=_starts([face.rings for _, _, face, _ in faces]),
        building=np.array([number for number, *_ in faces], np.int32),
        lod=np.zeros(len(faces), np.int16),
        kind=np.array([kind for *_, kind in faces], np.uint8),
    )
    result = triangulate(polygons, names, Findings())
    surface = polygons.kind[result.polygon]
    surface[_is_flat_roof(polygons.points[result.triangles], surface)] = SurfaceClass.ROOF_FLAT
    owner = polygons.building[result.polygon].astype(np.int64)
    return BuildingSurfaces(polygons.points, result.triangles, result.polygon, surface, owner)


def _class_of(face: Face) -> SurfaceClass:
    return _CLASSES.get(face.kind, SurfaceClass.DOOR if face.is_door else SurfaceClass.WINDOW)


def _starts(parts: Sequence[Sized]) -> NDArray[np.int64]:
    """Returns where each part begins once all are put in a row, and where the last ends."""
    return np.cumsum([0, *map(len, parts)], dtype=np.int64)


def fine_bodies(building: Building) -> list[Body]:
    """Returns the bodies of a building at LoD3, and the class of all surfaces of those that have one."""
    eave = building.lod2.points[:, 2].min() + building.plan.roof.eave_m
    extra = [
        (solid, SurfaceClass.CHIMNEY if solid.points[:, 2].max() > eave + 0.3 else SurfaceClass.FRAME)
        for solid in building.installations
    ]
    return [(building.lod3, None), *extra]


def _is_flat_roof(corners: Points, surface: NDArray[np.uint8]) -> NDArray[np.bool_]:
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    upright = np.abs(normal[:, 2]) > _FLAT_COSINE * np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    return np.asarray(upright & (surface == SurfaceClass.ROOF_TILE))


def building_colours(look: TownLook, seed: int, name: str) -> Points:
    """Returns the colours of a building, (8, 3) RGB by surface class from ``WALL`` on."""
    chances = random_stream(seed, "demo", name, "colour")
    wall, tile, flat = (
        pick(colours, chances, 0.92, 1.06) for colours in (look.walls, look.tiles, look.flat_roofs)
    )
    chances.uniform()
    fittings = [pick(colours, chances, low, high) for colours, low, high in _FITTINGS.values()]
    return np.stack([wall, flat, tile, *fittings, _SOFFIT])
