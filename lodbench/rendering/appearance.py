"""Plain colours for city models that have none: walls, roofs and the sun.

Real appearance (textures, weather, ground) is for training images, and replaces this palette.
"""

from __future__ import annotations

import numpy as np

from lodbench.kernels.arguments import Appearance

_WALLS = [(222, 214, 198), (205, 205, 203), (226, 203, 172), (196, 178, 160), (235, 231, 222)]
_ROOFS = [(166, 92, 70), (140, 84, 72), (120, 122, 126), (150, 150, 148), (96, 88, 86), (182, 120, 88)]


def plain_appearance() -> Appearance:
    """Returns pale walls and red or grey roofs under a sun in the south-west, 50 degrees up."""
    south_west, up = np.cos(np.radians(50.0)) * np.sqrt(0.5), np.sin(np.radians(50.0))
    return Appearance(
        np.array(_WALLS, dtype=np.uint8),
        np.array(_ROOFS, dtype=np.uint8),
        np.array((218, 222, 214), dtype=np.uint8),
        np.array([-south_west, -south_west, up]),
        0.45,
    )
