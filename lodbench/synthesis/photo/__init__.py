"""Photos of cities, made on the CPU: procedural surfaces, sun and shadow, sky, haze, a camera's faults."""

from lodbench.synthesis.photo.ground import LAND, Land
from lodbench.synthesis.photo.look import PLAIN_LOOK, Development, Look, LookRanges, draw_look
from lodbench.synthesis.photo.renderer import PhotoRenderer

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
