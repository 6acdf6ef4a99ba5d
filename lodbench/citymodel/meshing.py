"""Meshing: one level of detail of a city model as a scene, with an account of every square metre."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import INTERIOR_SKIPPED, LOD_ABSENT, OPTION_UNUSED
from lodbench.citymodel.derive import AT_EAVES, derive_lod1, require_rule
from lodbench.citymodel.extrude import FLAT, tell_flat
from lodbench.citymodel.lods import has_lod, lod_in_words, polygon_blocks, polygons_at
from lodbench.citymodel.model import CityModel, SurfaceKind
from lodbench.citymodel.scene import Scene, SceneBuilder
from lodbench.citymodel.triangulate import CHUNK_POLYGONS, triangulate
from lodbench.errors import CityModelError
from lodbench.findings import Findings


class NothingToMesh(CityModelError):
    """A level of detail whose polygons make no triangle.

    Attributes:
        area_m2: Newell area of the polygons, all of it lost.
        findings: Why.
    """

    def __init__(self, source: str, lod: str, area_m2: float, findings: Findings) -> None:
        super().__init__(
            f"{source} has no surface to mesh at level of detail {lod}.", "Try lodbench city check."
        )
        self.area_m2, self.findings = area_m2, findings


@dataclass(frozen=True, slots=True)
class CityMesh:
    """A scene and what became of the model's area on the way to it."""

    scene: Scene  # triangles, ready for the renderers
    num_polygons: int  # polygons meshed
    area_m2: float  # their Newell area
    meshed_m2: float  # area of their triangles; larger where polygons are bent
    lost_m2: float  # area no triangle covers
    excess_m2: float  # area triangles cover beyond their polygons
    findings: Findings  # what was met while meshing; the model's own findings are not repeated


def mesh_model(
    model: CityModel, lod: str | None = None, *, roof_height: str | None = None, stands_in: bool = True
) -> CityMesh:
    """Returns the mesh of one level of detail, with its areas and findings.

    Args:
        model: The city as read.
        lod: Level name, ``finest`` or ``coarsest`` for each building's own (see ``polygons_at``), or None
            for the lowest that has walls.
        roof_height: Rule by which level 1 is derived where it is requested and absent; None makes
            that an error.
        stands_in: Whether objects that are no buildings and lack the level come with one of theirs.

    Raises:
        CityModelError: The level is absent, or holds no surface.
        ConfigError: The rule is unknown.
    """
    findings = Findings()
    lod = None if lod is None else str(lod)  # in notebooks levels are numbers
    if roof_height is not None:
        require_rule(roof_height)
        if lod is None or lod.lower().removeprefix("lod") != "1":
            findings.add(OPTION_UNUSED, "", "roof_height: only level 1 is derived, with lod=1")
        elif not has_lod(model.lods, lod):
            blocks = derive_lod1(model, roof_height, findings)
            # Blocks that end at eaves are not too high.
            pitched = None if roof_height == AT_EAVES else model.pitched
            counts = (len(blocks),)
            model = replace(model, lods=("1",), polygons=blocks, polygons_read=counts, pitched=pitched)
    name, at_level = polygons_at(model, lod, findings, stands_in)
    if name.startswith(FLAT):
        tell_flat(model, findings)
    polygons = model.polygons
    is_interior = (polygons.kind == SurfaceKind.INTERIOR) & (not model.has_interiors)
    for building, count in sorted(Counter(polygons.building[at_level & is_interior].tolist()).items()):
        findings.add(INTERIOR_SKIPPED, model.building_ids[building], f"{count} polygons")
    return _mesh_level(model, name, np.flatnonzero(at_level & ~is_interior), findings)


def _mesh_level(model: CityModel, lod: str, chosen: NDArray[np.int64], findings: Findings) -> CityMesh:
    """Returns the mesh of some polygons of a model, made a few thousand polygons at a time."""
    has_level = np.zeros(len(model.building_ids), np.bool_)
    has_level[model.polygons.building[chosen]] = True
    for building in np.flatnonzero(~has_level):
        findings.add(LOD_ABSENT, model.building_ids[building], f"no {lod_in_words(lod)}")
    for part in _absent_parts(model, chosen, has_level):
        findings.add(LOD_ABSENT, part, f"a building part, no {lod_in_words(lod)}")
    builder = SceneBuilder(model.building_ids)
    areas = np.zeros(4)
    num_triangles = 0
    for num_before, block in polygon_blocks(model.polygons, chosen, CHUNK_POLYGONS):
        result = triangulate(block, model.building_ids, findings, num_before=num_before)
        builder.add(block.points, result.triangles, block.building[result.polygon])
        areas += result.area_m2.sum(), result.meshed_m2.sum(), result.lost_m2, result.excess_m2
        num_triangles += len(result.triangles)
    if num_triangles == 0:
        raise NothingToMesh(model.source, lod, float(areas[0]), findings)
    area_m2, meshed_m2, lost_m2, excess_m2 = areas.tolist()
    scene = builder.finish(lod=lod, crs=model.crs, origin=model.origin, pitched=model.pitched)
    return CityMesh(scene, len(chosen), area_m2, meshed_m2, lost_m2, excess_m2, findings)


def _absent_parts(model: CityModel, chosen: NDArray[np.int64], has_level: NDArray[np.bool_]) -> list[str]:
    """Returns the ids of parts with walls of which nothing is chosen, nor of their building itself."""
    objects, part = model.objects, model.polygons.part
    if objects is None or part is None:
        return []
    is_chosen, has_walls = np.zeros((2, len(objects)), np.bool_)
    is_chosen[part[chosen]] = True
    is_flat = np.array([name.startswith("0") for name in model.lods], np.bool_)
    has_walls[part[~is_flat[model.polygons.lod]]] = True
    is_whole = np.zeros(len(has_level), np.bool_)
    is_whole[objects.building[is_chosen & (objects.parents < 0)]] = True
    is_open = has_walls & ~is_chosen & (has_level & ~is_whole)[objects.building]
    return [objects.ids[n] for n in np.flatnonzero(is_open) if objects.types[n] == "BuildingPart"]


def mesh_city(model: CityModel, lod: str | None = None, *, roof_height: str | None = None) -> Scene:
    """Returns one level of detail of a city as a scene; see ``mesh_model`` for the account of it.

    Args:
        model: The city as read.
        lod: Level name (``"1"``, ``"2.2"``, ``"finest"``), or None for the lowest that has walls.
        roof_height: Rule by which an absent level 1 is derived: median, max, p70 or eave.

    Raises:
        CityModelError: The level is absent, or holds no surface.
    """
    return mesh_model(model, lod, roof_height=roof_height).scene
