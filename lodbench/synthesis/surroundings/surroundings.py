"""The surroundings of a city without any: ground, land cover, trees, cars and clutter from its footprints."""

from __future__ import annotations

import numpy as np

from lodbench.citymodel.scene import Scene
from lodbench.storage import random_stream
from lodbench.synthesis.objects.mesh_builder import MeshBuilder, Points
from lodbench.synthesis.objects.scene_props import SceneProps, SurfaceClass
from lodbench.synthesis.objects.trees_and_cars import add_cars, add_trees
from lodbench.synthesis.photo import LAND_COVER
from lodbench.synthesis.surroundings.clutter import add_clutter
from lodbench.synthesis.surroundings.ground import Land, ground_from_bases, ground_from_raster
from lodbench.synthesis.surroundings.land_cover import draw_land_cover, look_down

_TREE_SPACING_M, _MAX_TREES = 6.0, 9000
_CAR_SPACING_M, _MAX_CARS = 7.0, 3000
_BROADLEAF = 0.85
_TREE_GAP_M, _CAR_GAP_M = 2.2, 2.0  # from buildings
# Share of places taken by a tree, by what covers the ground.
_TREE_CHANCE = {
    SurfaceClass.GRASS: 0.42,
    SurfaceClass.GROUND: 0.15,
    SurfaceClass.PAVEMENT: 0.12,
    SurfaceClass.FIELD: 0.015,
}


def make_surroundings(scene: Scene, seed: int, terrain: str | None = None) -> tuple[SceneProps, Land]:
    """Returns ground, roads, trees and cars that fit a city, in its frame; the same for a seed everywhere.

    Ground heights are those of a ``terrain`` raster, or of the buildings' bases.

    Raises:
        LodbenchError: The raster cannot be read, or covers no part of the city.
    """
    view = look_down(scene)
    ground = ground_from_raster(view, scene, terrain) if terrain else ground_from_bases(view)
    land = Land(view, ground, draw_land_cover(view, random_stream(seed, "training", "land")))
    builder = MeshBuilder(scene.num_buildings)
    # Black, as what has no colour of its own: the cover decides, place by place.
    builder.add(np.full(1, LAND_COVER), *ground.mesh(), (0, 0, 0))
    _plant_trees(builder, land, random_stream(seed, "training", "trees"))
    _park_cars(builder, land, random_stream(seed, "training", "cars"))
    add_clutter(builder, land, random_stream(seed, "training", "clutter"))
    return builder.build(scene.origin), land


def _plant_trees(builder: MeshBuilder, land: Land, generator: np.random.Generator) -> None:
    """Adds trees in gardens, along streets and in copses; none on a building or a carriageway."""
    places = land.view.jittered(_TREE_SPACING_M, generator)
    cover, road_m, free_m = land.at(places)
    chance = np.zeros(len(places))
    for kind, share in _TREE_CHANCE.items():
        chance[cover == kind] = share
    copse = _patches(places, generator)
    chance = np.where(copse > 0.45, 2.0 * chance + 0.25 * (chance > 0), chance * (0.4 + copse))
    verge_m = land.cover.half_road_m + land.cover.pavement_m
    chance[(road_m > verge_m) & (road_m < verge_m + 2.5)] += 0.18
    chance[(road_m < verge_m + 0.4) | (cover == SurfaceClass.WATER) | (free_m < _TREE_GAP_M)] = 0.0
    kept = np.flatnonzero(generator.random(len(places)) < chance)
    kept = kept[generator.permutation(len(kept))[:_MAX_TREES]]
    # A crown may touch a wall.
    room_m = free_m[kept].astype(np.float64) + 0.4
    add_trees(builder, land.ground.on_ground(places[kept]), generator, _BROADLEAF, room_m)


def _park_cars(builder: MeshBuilder, land: Land, generator: np.random.Generator) -> None:
    """Adds cars on the carriageways, most of them at the kerb."""
    places = land.view.jittered(_CAR_SPACING_M, generator)
    cover, road_m, free_m = land.at(places)
    half_m = land.cover.half_road_m
    chosen = (road_m < half_m) & (free_m > _CAR_GAP_M) & (cover != SurfaceClass.FIELD)
    chosen &= generator.random(len(places)) < 0.45
    places, away = places[chosen][:_MAX_CARS], road_m[chosen][:_MAX_CARS]
    turn = land.cover.road_rad[land.view.cells_of(places)].astype(np.float64)
    # Aside, onto the kerb or a lane: the way there is across the road, away from its middle.
    across = np.stack([-np.sin(turn), np.cos(turn)], axis=1)
    wanted = np.where(generator.random(len(away)) < 0.75, half_m - 1.05, 0.5 * half_m)
    _, aside_m, _ = land.at(places + across * 0.8)
    outward = np.where(aside_m > away, 1.0, -1.0)
    places = places + across * (outward * (wanted - away))[:, None]
    ways = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    rise = land.ground.at(places + 2.0 * ways) - land.ground.at(places - 2.0 * ways)
    add_cars(builder, land.ground.on_ground(places), ways, rise / 4.0, generator)


def _patches(places: Points, generator: np.random.Generator) -> Points:
    """Returns a sum of waves in [-1, 1] at places: trees stand in groups."""
    total = np.zeros(len(places))
    for length_m in (130.0, 61.0, 37.0):
        turn, phase = generator.uniform(0.0, 2 * np.pi, size=2)
        total += np.sin((places @ [np.cos(turn), np.sin(turn)]) * (2 * np.pi / length_m) + phase)
    return total / 3.0
