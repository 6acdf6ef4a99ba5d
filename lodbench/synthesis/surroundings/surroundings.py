"""The surroundings of a city without any: ground, land cover, trees and cars from its footprints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lodbench.citymodel.scene import Scene
from lodbench.storage import random_stream
from lodbench.synthesis.photo import LAND, Land
from lodbench.synthesis.props import SceneProps
from lodbench.synthesis.surroundings.land import Plan, cover_land, look_down
from lodbench.synthesis.surroundings.street_life import park_cars, plant_trees
from lodbench.synthesis.surroundings.terrain_mesh import Ground, ground_from_bases, ground_from_raster


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """What was made up around a city.

    Attributes:
        plan: The city from above.
        ground: Ground heights.
        land: Land cover.
        props: Ground, trees and cars, in the scene's frame.
    """

    plan: Plan
    ground: Ground
    land: Land
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
    plan = look_down(scene, threads=1)
    ground = ground_from_raster(plan, scene, terrain) if terrain else ground_from_bases(plan)
    land = cover_land(plan, random_stream(seed, "training", "land"))
    trees = plant_trees(plan, land, ground, random_stream(seed, "training", "trees"))
    cars = park_cars(plan, land, ground, random_stream(seed, "training", "cars"))
    vertices, triangles = ground.mesh()
    corners = [vertices[triangles], trees.corners, cars.corners]
    first_tree = scene.num_buildings + 1
    first_car = first_tree + int(trees.number.max(initial=-1)) + 1
    count = sum(map(len, corners))
    props = SceneProps(
        vertices=np.concatenate(corners).reshape(-1, 3).astype(np.float32),
        triangles=np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
        surface=np.concatenate([np.full(len(triangles), LAND), trees.surface, cars.surface]).astype(np.uint8),
        objects=np.concatenate(
            [
                np.full(len(triangles), scene.num_buildings),
                trees.number + first_tree,
                cars.number + first_car,
            ]
        ).astype(np.int32),
        tint=np.concatenate([np.zeros((len(triangles), 3)), trees.tint, cars.tint]).astype(np.uint8),
        num_buildings=scene.num_buildings,
        origin=scene.origin,
    )
    return Surroundings(plan, ground, land, props)
