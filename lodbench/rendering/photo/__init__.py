"""Photos of cities, made on the CPU: procedural surfaces, sun and shadow, sky, haze, a camera's faults."""

from lodbench.rendering.photo.ground import LAND, Land
from lodbench.rendering.photo.look import PLAIN_LOOK, Development, Look, LookRanges, draw_look
from lodbench.rendering.photo.renderer import PhotoRenderer

__all__ = [
    "LAND",
    "PLAIN_LOOK",
    "Development",
    "Land",
    "Look",
    "LookRanges",
    "PhotoRenderer",
    "draw_look",
]
