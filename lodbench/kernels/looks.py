"""What kernels that draw photos are given: classes of surfaces, textures, light, land cover."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Triple = tuple[float, float, float]


class SurfaceClass(IntEnum):
    """What a surface is made of. Numbers are written to files: never change or reuse one."""

    # Ground below 20, then what belongs to buildings and hence to their masks, then occluders from 40 on.
    GROUND = 0  # bare earth, gravel
    GRASS = 1
    FIELD = 2  # crops, meadows beyond the town
    ROAD = 3
    MARKING = 4
    PAVEMENT = 5  # pavements, squares, yards
    WATER = 6
    WALL = 20
    ROOF_FLAT = 21
    ROOF_TILE = 22
    WINDOW = 23
    DOOR = 24
    FRAME = 25  # window reveals and sills, eaves, railings
    CHIMNEY = 26
    FLOOR = 27  # undersides
    TRUNK = 40
    FOLIAGE = 41
    CAR_BODY = 42
    CAR_GLASS = 43
    FENCE = 44  # hedges, walls of gardens
    CLUTTER = 45  # containers, tents

    @property
    def is_ground(self) -> bool:
        """Whether it lies on the ground or is the ground."""
        return self < SurfaceClass.WALL


# Ground whose class, cell by cell, is in a ``LandCover``.
LAND_COVER = np.uint8(255)
# Surfaces that carry their own light: those of a textured mesh.
TEXTURED = np.uint8(254)


class Charts(NamedTuple):
    """Where on its texture each triangle is, for the kernel.

    On a triangle, texture coordinates (or red, green and blue) are affine in the place in the world, so
    a look-up by the place is free of perspective errors.

    Attributes:
        slope: (T, 3, 3) float64: change of u and v, or of red, green and blue, per metre.
        start: (T, 3, 2) float64: of each, at the first corner; and that corner's coordinates.
        picture: (T,) int32 texture, or -1.
        texels: (N,) uint8 all textures at all sizes, RGB after RGB.
        offset: (P, levels) int64 where each begins.
        size: (P, levels, 2) int64 its width and height.
    """

    slope: NDArray[np.float64]
    start: NDArray[np.float64]
    picture: NDArray[np.int32]
    texels: NDArray[np.uint8]
    offset: NDArray[np.int64]
    size: NDArray[np.int64]


class Look(NamedTuple):
    """The look of one picture, for the kernel; see ``LookRanges`` for what is not explained here."""

    sun: Triple  # unit vector towards the sun, world axes
    sun_rgb: Triple  # its light, linear
    sky_rgb: Triple  # light of the whole sky on level ground, linear
    haze_rgb: Triple  # colour of far air, linear
    zenith_rgb: Triple  # colour of the sky straight up, linear
    haze_per_m: float  # share of contrast lost per metre
    dryness: float
    texture: float
    tint_jitter: float
    dirt: float
    windows: float
    window_light: float
    storey_m: float
    window_spacing_m: float
    skylights: float
    roof_units: float
    repaint: float
    seed: int  # of patterns and of objects' colours


class CameraResponse(NamedTuple):
    """How light becomes a picture file; see ``LookRanges``."""

    exposure: float
    contrast: float
    saturation: float
    white_balance: float
    vignette: float
    blur_px: float
    noise: float
    jpeg_quality: int
    seed: int


class Skin(NamedTuple):
    """What the triangles of a render scene look like, for the kernel."""

    normal: NDArray[np.float32]  # (T, 3) float32 unit normals, whichever side
    surface: NDArray[np.uint8]  # (T,) uint8 ``SurfaceClass``, or ``LAND_COVER``
    number: NDArray[np.int32]  # (T,) int32 of the object
    tint: NDArray[np.float32]  # (T, 3) float32 linear base colour; a negative red one for the palette's
    # (T, 7) float32. Walls: tangent x, y, where the wall begins along it, its width, base and top heights; a
    # width of 0 for no painted windows. Leaves: centre of the crown at 0 to 2, and 1 at 6, for light as round
    # a crown.
    place: NDArray[np.float32]


class LandCover(NamedTuple):
    """What covers the ground, on a grid."""

    # (rows, columns) uint8 ``SurfaceClass``, south to north; roads are in ``road_m2``.
    classes: NDArray[np.uint8]
    # (rows, columns) float32 square of the distance to the middle of the nearest road.
    road_m2: NDArray[np.float32]
    # (rows, columns) float32 direction of that road, counter-clockwise from east.
    road_rad: NDArray[np.float32]
    west: float  # left edge of the first column, local metres
    south: float  # lower edge of the first row
    cell_m: float  # size of a cell
    half_road_m: float  # half the width of a carriageway
    pavement_m: float  # width of the pavement beside it


class SunMap(NamedTuple):
    """Depth towards the sun, for the kernel."""

    depth: NDArray[np.float32]  # (N, N) float32 metres from the map's camera; 0 where there is nothing
    rotation: tuple[tuple[float, float, float], ...]  # (3, 3) sun_from_world
    center: tuple[float, float, float]  # (3,) of the camera, local metres
    focal: float  # focal length, pixels
    texel_m: float  # size of a map pixel on the scene


class Palettes(NamedTuple):
    """Linear RGB colours, (N, 3) each, for objects that have none of their own."""

    walls: NDArray[np.float64]
    tiles: NDArray[np.float64]
    flats: NDArray[np.float64]
    paints: NDArray[np.float64]


class Shading(NamedTuple):
    """All that decides the light of a triangle at a point."""

    skin: Skin
    look: Look
    cover: LandCover
    sun_map: SunMap
    palettes: Palettes
    charts: Charts
