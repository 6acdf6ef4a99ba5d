"""The surroundings of a city without any: ground, land cover, trees, cars and clutter from its footprints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lodbench.citymodel.scene import Scene
from lodbench.storage import random_stream
from lodbench.synthesis.objects.mesh_builder import MeshBuilder, Points
from lodbench.synthesis.objects.scene_props import SceneProps, SurfaceClass
from lodbench.synthesis.objects.trees_and_cars import add_cars, add_trees
from lodbench.synthesis.photo import LAND_COVER, LandCover
from lodbench.synthesis.surroundings.clutter import add_clutter
from lodbench.synthesis.surroundings.ground import Ground, ground_from_bases, ground_from_raster
from lodbench.synthesis.surroundings.land_cover import TopView, draw_land_cover, look_down

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


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """What was made up around a city.

    Attributes:
        view: The city from above.
        ground: Ground heights.
        land_cover: What covers the ground.
        props: Ground, trees and cars, in the scene's frame.
    """

    view: TopView
    ground: Ground
    land_cover: LandCover
    props: SceneProps


def make_surroundings(scene: Scene, seed: int, terrain: str | None = None) -> Surroundings:
    """Returns ground, roads, trees and cars that fit a city; the same for a seed everywhere.

    Args:
        scene: The city.
        seed: Seed of all that is made up.
        terrain: Raster of ground heights; None to take them from the buildings' bases.

    Raises:
        LodbenchError: The raster cannot be read, or covers no part of the city.
    """
    view = look_down(scene, threads=1)
    ground = ground_from_raster(view, scene, terrain) if terrain else ground_from_bases(view)
    cover = draw_land_cover(view, random_stream(seed, "training", "land"))
    builder = MeshBuilder(scene.num_buildings)
    # Black, as what has no colour of its own: the cover decides, place by place.
    builder.add(np.full(1, LAND_COVER), *ground.mesh(), (0, 0, 0))
    _plant_trees(builder, view, cover, ground, random_stream(seed, "training", "trees"))
    _park_cars(builder, view, cover, ground, random_stream(seed, "training", "cars"))
    add_clutter(builder, view, cover, ground, random_stream(seed, "training", "clutter"))
    return Surroundings(view, ground, cover, builder.build(scene.origin))


def _plant_trees(
    builder: MeshBuilder, view: TopView, cover: LandCover, ground: Ground, generator: np.random.Generator
) -> None:
    """Adds trees in gardens, along streets and in copses; none on a building or a carriageway."""
    places = view.jittered(_TREE_SPACING_M, generator)
    row, column = view.cells_of(places)
    away = np.sqrt(cover.road_m2[row, column])
    chance = np.zeros(len(places))
    for kind, share in _TREE_CHANCE.items():
        chance[cover.classes[row, column] == kind] = share
    copse = _patches(places, generator)
    chance = np.where(
        copse > 0.45, np.maximum(2.0 * chance, 0.0) + 0.25 * (chance > 0), chance * (0.4 + copse)
    )
    verge = cover.half_road_m + cover.pavement_m
    chance[(away > verge) & (away < verge + 2.5)] += 0.18
    chance[away < verge + 0.4] = 0.0
    chance[cover.classes[row, column] == SurfaceClass.WATER] = 0.0
    free_m = view.free_m[row, column].astype(np.float64)
    chance[free_m < _TREE_GAP_M] = 0.0
    kept = np.flatnonzero(generator.random(len(places)) < chance)
    kept = kept[generator.permutation(len(kept))[:_MAX_TREES]]
    # A crown may touch a wall.
    add_trees(builder, ground.on_ground(places[kept]), generator, _BROADLEAF, free_m[kept] + 0.4)


def _park_cars(
    builder: MeshBuilder, view: TopView, cover: LandCover, ground: Ground, generator: np.random.Generator
) -> None:
    """Adds cars on the carriageways, most of them at the kerb."""
    places = view.jittered(_CAR_SPACING_M, generator)
    row, column = view.cells_of(places)
    away, turn = np.sqrt(cover.road_m2[row, column]), cover.road_rad[row, column].astype(np.float64)
    on_road = (away < cover.half_road_m) & (view.free_m[row, column] > _CAR_GAP_M)
    chosen = on_road & (generator.random(len(places)) < 0.45)
    chosen &= cover.classes[row, column] != SurfaceClass.FIELD
    places, away, turn = places[chosen][:_MAX_CARS], away[chosen][:_MAX_CARS], turn[chosen][:_MAX_CARS]
    # Aside, onto the kerb or a lane: the way there is across the road, away from its middle.
    across = np.stack([-np.sin(turn), np.cos(turn)], axis=1)
    wanted = np.where(generator.random(len(away)) < 0.75, cover.half_road_m - 1.05, 0.5 * cover.half_road_m)
    row, column = view.cells_of(places + across * 0.8)
    outward = np.where(np.sqrt(cover.road_m2[row, column]) > away, 1.0, -1.0)
    places = places + across * (outward * (wanted - away))[:, None]
    ways = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    rise = ground.at(places + 2.0 * ways) - ground.at(places - 2.0 * ways)
    add_cars(builder, ground.on_ground(places), ways, rise / 4.0, generator)


def _patches(places: Points, generator: np.random.Generator) -> Points:
    """Returns a sum of waves in [-1, 1] at places: trees stand in groups."""
    total = np.zeros(len(places))
    for length_m in (130.0, 61.0, 37.0):
        turn, phase = generator.uniform(0.0, 2 * np.pi, size=2)
        total += np.sin((places @ [np.cos(turn), np.sin(turn)]) * (2 * np.pi / length_m) + phase)
    return total / 3.0
