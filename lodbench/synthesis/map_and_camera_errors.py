"""How the world that is seen differs from the map that is searched, and from what is told of the camera."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np

from lodbench.citymodel.scene import Scene
from lodbench.errors import ConfigError, nearest_names
from lodbench.geometry import Camera

# What a building keeps of its height at least, metres.
_LEAST_RISE_M = 0.5
_LIMITS = {"shared_roofs_m": (-50, 50), "hidden_feet_m": (0, 50), "focal": (-0.5, 0.5), "tilt": (0, 30)}


@dataclass(frozen=True, slots=True)
class World:
    """Errors that all views of a city share.

    Attributes:
        shared_roofs_m: Every building reaches so much higher than in the map; below 0 less high.
        hidden_feet_m: So much of the lowest part of every wall is hidden, by hedges or cars.
        focal: The lens is longer than told by this share of its focal length, in every second view shorter.
        tilt: Pitch and roll of the priors err so many times as far as told.

    Raises:
        ConfigError: A value is not finite or beyond what there is.
    """

    shared_roofs_m: float = 0.0
    hidden_feet_m: float = 0.0
    focal: float = 0.0
    tilt: float = 1.0

    def __post_init__(self) -> None:
        for name, (low, high) in _LIMITS.items():
            if not low <= getattr(self, name) <= high:
                raise ConfigError(f"world.{name} lies within {low} and {high}, not {getattr(self, name)}.")

    @classmethod
    def parse(cls, text: str) -> World:
        """Returns the world of ``NAME=VALUE,NAME=VALUE``; the unit ``_m`` may be left out of a name.

        Raises:
            ConfigError: A name is not known or a value is no number.
        """
        known = {field.name.removesuffix("_m"): field.name for field in fields(cls)}
        values = {}
        for part in filter(None, text.split(",")):
            name, _, value = part.partition("=")
            name = name.strip().removesuffix("_m")
            if name not in known:
                raise ConfigError(f"A world has no {name!r}.", nearest_names(name, known))
            try:
                values[known[name]] = float(value)
            except ValueError as error:
                raise ConfigError(
                    f"{name}={value} is no number.", "Write --world shared_roofs=1.5,focal=0.01"
                ) from error
        return cls(**values)

    def describe(self) -> str:
        """Returns in words what is wrong, or "" where nothing is."""
        plain = World()
        wrong = [f for f in fields(self) if getattr(self, f.name) != getattr(plain, f.name)]
        return ", ".join(f"{f.name}={getattr(self, f.name):g}" for f in wrong)

    def seen(self, scene: Scene) -> Scene:
        """Returns what is seen of a city: its roofs as high as they are, without the feet that are hidden."""
        if not (self.shared_roofs_m or self.hidden_feet_m):
            return scene
        vertices = np.array(scene.vertices)
        for first, last in pairwise(scene.vertex_starts):
            heights = vertices[first:last, 2]
            if len(heights) == 0 or heights.max() == heights.min():
                continue
            floor, rise = heights.min(), heights.max() - heights.min()
            stretch = max(rise + self.shared_roofs_m, min(rise, _LEAST_RISE_M)) / rise
            vertices[first:last, 2] = np.maximum(
                floor + stretch * (heights - floor), floor + self.hidden_feet_m
            )
        return replace(scene, vertices=vertices, stored_digest="")

    def lens(self, camera: Camera, view: int) -> Camera:
        """Returns the camera that takes the view of a number, given the one that is told."""
        stretch = 1.0 + (self.focal if view % 2 == 0 else -self.focal)
        return replace(camera, fx=stretch * camera.fx, fy=stretch * camera.fy)
