"""Drawn photos of seeded views: a city among made-up ground, trees and cars, in a named look."""

from __future__ import annotations

from dataclasses import replace

from lodbench.citymodel.scene import Scene
from lodbench.geometry import Camera
from lodbench.storage import random_stream
from lodbench.synthesis.photo import PhotoRenderer, draw_look, look_ranges
from lodbench.synthesis.queries import SyntheticQuery
from lodbench.synthesis.surroundings.surroundings import make_surroundings


def with_photos(
    queries: list[SyntheticQuery], scene: Scene, camera: Camera, look: str, seed: int
) -> list[SyntheticQuery]:
    """Returns queries with photos; the photo of one depends on the seed and its name only.

    A query's name becomes that of a JPEG file.

    Raises:
        ConfigError: There is no such look.
    """
    ranges = look_ranges(look)
    made = make_surroundings(scene, seed)
    renderer = PhotoRenderer(scene, made.props, made.land_cover)
    pictured = []
    for query in queries:
        light, response = draw_look(ranges, random_stream(seed, "views", "look", query.name))
        photo = renderer.jpeg(camera, query.truth, light, response)
        pictured.append(replace(query, name=f"{query.name}.jpg", photo=photo))
    return pictured
