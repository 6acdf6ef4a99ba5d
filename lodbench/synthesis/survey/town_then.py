"""The demo town some years before its photos: what stood then, in the colours it had, in another season."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.storage import random_stream
from lodbench.synthesis.objects.mesh_builder import MeshBuilder
from lodbench.synthesis.objects.scene_props import SceneProps, SurfaceClass
from lodbench.synthesis.photo import CameraResponse, Look, LookRanges, draw_look
from lodbench.synthesis.town.building import Age
from lodbench.synthesis.town.citygml_writer import ORIGIN_M
from lodbench.synthesis.town.ground import add_ground
from lodbench.synthesis.town.props import add_buildings, building_colours, fine_bodies
from lodbench.synthesis.town.town import Town
from lodbench.synthesis.town.trees_and_cars import add_greenery

# Shares of what has changed since: facades and roofs in other colours, trees that were not there yet.
REPAINTED, REROOFED, YOUNG_TREES = 0.15, 0.08, 0.08
# A low autumn sun, grass and leaves gone dry; the demo's photos are of late spring to summer.
_DAY = LookRanges(
    sun_elevation_deg=(24.0, 30.0),
    sun_share=(0.5, 0.6),
    sun_warmth=(0.2, 0.5),
    haze_range_m=(1e6, 1e6),
    sky_white=(0.4, 0.7),
    dryness=(0.75, 0.95),
    exposure=(1.05, 1.15),
    saturation=(0.65, 0.75),
    vignette=(0.0, 0.0),
    blur_px=(0.4, 0.5),
    noise=(0.004, 0.008),
)


def town_then(town: Town) -> tuple[SceneProps, NDArray[np.int64]]:
    """Returns the town as it was: houses since pulled down stand, new ones do not, raised ones are lower.

    Returns:
        All that stood, in the frame of ``ORIGIN_M``, without cars, which do not stay; and (T,) the planar
        polygon of each triangle, -1 for what is no building's.
    """
    now = {building.identifier: number for number, building in enumerate(town.standing)}
    builder = MeshBuilder(len(now))
    # As for the photos, so that what is still there has the same number and with it the same patterns.
    add_ground(builder, town)
    add_greenery(builder, town)
    land = builder.build(ORIGIN_M)
    land = land.part(~_is_young(land, town.seed))
    gone = builder.new_objects(len(town.mapped))
    numbers = np.array([now.get(b.identifier, gone[k]) for k, b in enumerate(town.mapped)], dtype=np.int64)
    colours = np.stack([_colours_then(town, building.identifier) for building in town.mapped])
    then = MeshBuilder(len(now))
    bodies = [[(b.lod2, None)] if b.age is Age.RAISED else fine_bodies(b) for b in town.mapped]
    polygon = add_buildings(then, bodies, colours, numbers)
    then.add_props(land)
    return then.build(ORIGIN_M), np.concatenate([polygon, np.full(len(land), -1)])


def survey_look(seed: int) -> tuple[Look, CameraResponse]:
    """Returns the light of the survey's day, and the camera that saw it."""
    look, response = draw_look(_DAY, random_stream(seed, "demo", "survey", "day"))
    return look._replace(seed=seed, haze_per_m=0.0), response


def _colours_then(town: Town, name: str) -> NDArray[np.float64]:
    """Returns a building's colours then, (8, 3) RGB: some facades and roofs have been done over since."""
    colours = building_colours(town, name)
    chances = random_stream(town.seed, "demo", "survey", name)
    other = building_colours(town, f"{name} then")
    draws = chances.random(2)
    if draws[0] < REPAINTED:
        colours[0] = other[0]
    if draws[1] < REROOFED:
        colours[1:3] = other[1:3]
    return colours


def _is_young(props: SceneProps, seed: int) -> NDArray[np.bool_]:
    """Tells which triangles are of trees that were planted since."""
    draws = random_stream(seed, "demo", "survey", "trees").random(int(props.objects.max()) + 1)
    is_tree = np.isin(props.surface, (SurfaceClass.FOLIAGE, SurfaceClass.TRUNK))
    return np.asarray(is_tree & (draws[props.objects] < YOUNG_TREES))
