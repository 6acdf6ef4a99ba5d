"""Photos of cities, made on the CPU: procedural surfaces, sun and shadow, sky, haze, a camera's faults."""

from lodbench.kernels.looks import LAND_COVER, CameraResponse, LandCover, Look
from lodbench.synthesis.photo.light import LookRanges, draw_look, look_ranges
from lodbench.synthesis.photo.renderer import PhotoRenderer

__all__ = [
    "LAND_COVER",
    "CameraResponse",
    "LandCover",
    "Look",
    "LookRanges",
    "PhotoRenderer",
    "draw_look",
    "look_ranges",
]
