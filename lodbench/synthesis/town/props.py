"""The demo town as scene props: its buildings at level of detail 3, and all that stands between them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.model import Polygons, SurfaceKind
from lodbench.citymodel.triangulate import triangulate
from lodbench.findings import Findings
from lodbench.storage import random_stream
from lodbench.synthesis.objects.mesh_builder import MeshBuilder
from lodbench.synthesis.objects.scene_props import SceneProps, SurfaceClass
from lodbench.synthesis.town.building import Building
from lodbench.synthesis.town.citygml_writer import ORIGIN_M
from lodbench.synthesis.town.ground import add_ground
from lodbench.synthesis.town.looks import TownLook
from lodbench.synthesis.town.solid import Solid
from lodbench.synthesis.town.town import Town
from lodbench.synthesis.town.trees_and_cars import add_greenery, add_traffic

Points = NDArray[np.float64]
# A body, and the class of all its surfaces where they have one.
Body = tuple[Solid, SurfaceClass | None]

_FLAT_COSINE = 0.985  # roofs that lean less are flat: ten degrees
_CLASSES = {
    SurfaceKind.WALL: SurfaceClass.WALL,
    SurfaceKind.ROOF: SurfaceClass.ROOF_TILE,
    SurfaceKind.GROUND: SurfaceClass.FLOOR,
    SurfaceKind.FLOOR: SurfaceClass.FLOOR,
}
_CHIMNEY, _RAILING, _GLASS, _WOOD, _SOFFIT = (
    (142, 92, 76),
    (196, 196, 192),
    (58, 68, 78),
    (96, 70, 52),
    (206, 200, 188),
)


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
    points: list[Points] = []
    rings: list[int] = []
    polygon_rings: list[int] = []
    owners: list[int] = []
    surfaces: list[int] = []
    for number, bodies in enumerate(buildings):
        for solid, part in bodies:
            for face in solid.faces:
                for ring in face.rings:
                    points.append(solid.points[list(ring)])
                    rings.append(len(ring))
                polygon_rings.append(len(face.rings))
                owners.append(number)
                kind = SurfaceClass.DOOR if face.is_door else SurfaceClass.WINDOW
                surfaces.append(part or _CLASSES.get(face.kind, kind))
    polygons = Polygons(
        points=np.concatenate(points),
        ring_starts=np.concatenate([[0], np.cumsum(rings)]).astype(np.int64),
        polygon_starts=np.concatenate([[0], np.cumsum(polygon_rings)]).astype(np.int64),
        building=np.array(owners, np.int32),
        lod=np.zeros(len(owners), np.int16),
        kind=np.array(surfaces, np.uint8),
    )
    result = triangulate(polygons, names, Findings())
    surface = polygons.kind[result.polygon]
    surface = np.where(
        _is_flat_roof(polygons.points[result.triangles], surface), SurfaceClass.ROOF_FLAT, surface
    )
    owner = polygons.building[result.polygon].astype(np.int64)
    return BuildingSurfaces(
        polygons.points, result.triangles, result.polygon, surface.astype(np.uint8), owner
    )


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

    def pick(colours: tuple[tuple[int, int, int], ...]) -> Points:
        return np.array(colours[int(chances.integers(len(colours)))]) * chances.uniform(0.92, 1.06)

    wall, tile, flat = pick(look.walls), pick(look.tiles), pick(look.flat_roofs)
    chances.uniform()
    by_class = {
        SurfaceClass.WALL: wall,
        SurfaceClass.ROOF_FLAT: flat,
        SurfaceClass.ROOF_TILE: tile,
        SurfaceClass.WINDOW: np.array(_GLASS) * chances.uniform(0.8, 1.25),
        SurfaceClass.DOOR: np.array(_WOOD) * chances.uniform(0.7, 1.4),
        SurfaceClass.FRAME: np.array(_RAILING) * chances.uniform(0.8, 1.1),
        SurfaceClass.CHIMNEY: np.array(_CHIMNEY) * chances.uniform(0.8, 1.2),
        SurfaceClass.FLOOR: np.array(_SOFFIT),
    }
    return np.stack([by_class[SurfaceClass(SurfaceClass.WALL + k)] for k in range(8)])
