"""The photos of the demo's queries, and what trees and cars hide of the buildings in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.geometry import Camera, Pose
from lodbench.storage import random_stream
from lodbench.synthesis.objects.scene_props import SceneProps
from lodbench.synthesis.photo import LookRanges, PhotoRenderer, draw_look
from lodbench.synthesis.town.town import Town

# The days of the flights: sun and air are drawn once per split, what changes from photo to photo each time.
# Neither town is pictured in the weather of the other.
_DAYS = {
    "test": LookRanges(
        sun_elevation_deg=(30.0, 58.0),
        sun_share=(0.45, 0.8),
        haze_range_m=(2500.0, 8000.0),
        dryness=(0.1, 0.5),
    ),
    "train": LookRanges(
        sun_elevation_deg=(18.0, 45.0),
        sun_share=(0.2, 0.7),
        haze_range_m=(1200.0, 5000.0),
        dryness=(0.3, 0.8),
    ),
}
_OF_THE_DAY = (
    "sun_elevation_deg",
    "sun_azimuth_deg",
    "sun_share",
    "sun_warmth",
    "haze_range_m",
    "sky_white",
    "dryness",
)


class Photographer:
    """Takes the photos of a town."""

    def __init__(self, town: Town, scene: Scene, props: SceneProps) -> None:
        self._town = town
        self._renderer = PhotoRenderer(scene, props)

    def hidden(self, camera: Camera, pose: Pose) -> NDArray[np.bool_]:
        """Returns the (H, W) mask of trees, hedges and cars in a view."""
        return self._renderer.occluders(camera, pose)

    def jpeg(self, camera: Camera, pose: Pose, split: str, name: str) -> bytes:
        """Returns one photo as a JPEG file.

        Args:
            camera: Its pinhole.
            pose: Where it is taken from, in the scene's frame.
            split: Flights of one split share sun and air.
            name: Names the stream of what single photos differ in.
        """
        stream = random_stream(self._town.seed, "demo", name, "photo")
        look, response = draw_look(self._ranges(split), stream)
        # The town's own patterns stay as they are from photo to photo.
        look = look._replace(seed=self._town.seed)
        return self._renderer.jpeg(camera, pose, look, response)

    def _ranges(self, split: str) -> LookRanges:
        day = random_stream(self._town.seed, "demo", split, "day")
        ranges = _DAYS[self._town.look.name]
        drawn = {name: float(day.uniform(*getattr(ranges, name))) for name in _OF_THE_DAY}
        return replace(ranges, **{name: (value, value) for name, value in drawn.items()})
