"""What decides the light of triangles where nothing else is given: palettes, grass, no shadows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.kernels.looks import LandCover, Look, Palettes, Shading, Skin, SurfaceClass
from lodbench.rendering.texture_charts import make_charts
from lodbench.synthesis.objects.mesh_builder import palette
from lodbench.synthesis.photo.sunlight import NO_SUN_MAP

_GRASSLAND = np.full((1, 1), int(SurfaceClass.GRASS), dtype=np.uint8)
_FAR, _EAST = np.full((1, 1), 1e6, dtype=np.float32), np.zeros((1, 1), dtype=np.float32)
# One cell of grass, for scenes whose triangles all say what they are.
NO_LAND_COVER = LandCover(_GRASSLAND, _FAR, _EAST, 0.0, 0.0, 1.0, 3.0, 1.5)


def linear(colours: object) -> NDArray[np.float64]:
    """Returns linear RGB, 0 to 1, of 8-bit colours: a square, which the camera response undoes."""
    return (np.asarray(colours, dtype=np.float64) / 255.0) ** 2


_WALLS = "e1dacb d0ceca e4cdac bca48e eeebe4 a66e58 d6be96 b4b2ac 965c4a cad6d6 787674 e8d6be"
_TILES = "9e543e 8a4e40 b06a4c 685c56 545254 784034 92705c 464242 be7c5c 6e7074 603c32 807a70"
_TILES += " 9ea09e 48505c 46608c 587062 d6d6d2"  # fibre cement, slate, painted sheets
_FLATS = "969490 6e6e70 bcbab4 847c70 d6d4d0 5c5c5c 7a826c a8a094 8e969c 524e4a"
_FLATS += " 607446 b6ae9e 2c364e 688096 e4e4e2"  # planted, gravel, solar panels, sheet metal: as over halls
_PAINTS = "e6e6e6 1e2024 787a7e aaacb0 8c181a 22366e 3c3e42 cdc8be 18422c d6d6d2"
PALETTES = Palettes(*(linear(palette(codes)) for codes in (_WALLS, _TILES, _FLATS, _PAINTS)))


def plain_shading(skin: Skin, look: Look) -> Shading:
    """Returns the shading of triangles that all say what they are: no land cover, no textures; no shadows."""
    return Shading(skin, look, NO_LAND_COVER, NO_SUN_MAP, PALETTES, make_charts(None))
