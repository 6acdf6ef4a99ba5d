"""The surroundings of a city without any: ground, land cover, trees, cars and clutter from its footprints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lodbench.citymodel.scene import Scene
from lodbench.storage import random_stream
from lodbench.synthesis.objects.mesh_builder import MeshBuilder
from lodbench.synthesis.objects.scene_props import SceneProps
from lodbench.synthesis.photo import LAND_COVER, LandCover
from lodbench.synthesis.surroundings.clutter import add_clutter
from lodbench.synthesis.surroundings.ground import Ground, ground_from_bases, ground_from_raster
from lodbench.synthesis.surroundings.land_cover import TopView, draw_land_cover, look_down
from lodbench.synthesis.surroundings.trees_and_cars import park_cars, plant_trees


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
    plant_trees(builder, view, cover, ground, random_stream(seed, "training", "trees"))
    park_cars(builder, view, cover, ground, random_stream(seed, "training", "cars"))
    add_clutter(builder, view, cover, ground, random_stream(seed, "training", "clutter"))
    return Surroundings(view, ground, cover, builder.build(scene.origin))
