"""From a z-buffer of two by two samples per pixel to light: texture, sun, sky, haze."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lodbench.rendering.compiled import per_pixel, pixel_loop
from lodbench.rendering.pixel_samples import same_samples
from lodbench.rendering.texture_charts import Charts, make_charts, texture_light
from lodbench.synthesis.photo.ground import NO_LAND_COVER, TEXTURED, LandCover
from lodbench.synthesis.photo.look import Look
from lodbench.synthesis.photo.noise import dot, mix, plus, scaled
from lodbench.synthesis.photo.render_scene import Skin
from lodbench.synthesis.photo.sunlight import NO_SUN_MAP, SunMap, sun_share
from lodbench.synthesis.photo.surfaces import PALETTES, Palettes, surface_colour

_TEXTURED = int(TEXTURED)


class Shading(NamedTuple):
    """All that decides the light of a triangle at a point."""

    skin: Skin
    look: Look
    cover: LandCover
    sun_map: SunMap
    palettes: Palettes
    charts: Charts


def plain_shading(skin: Skin, look: Look) -> Shading:
    """Returns the shading of triangles that all say what they are: no land cover, no textures; no shadows."""
    return Shading(skin, look, NO_LAND_COVER, NO_SUN_MAP, PALETTES, make_charts(None))


@per_pixel
def sky_colour(ray, look):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns the linear RGB of the sky along a unit direction."""
    height = min(1.0, max(0.0, ray[2])) ** 0.45
    colour = mix(look.haze_rgb, look.zenith_rgb, height)
    glow = max(0.0, dot(ray, look.sun)) ** 24.0
    return colour[0] * (1.0 + 0.5 * glow), colour[1] * (1.0 + 0.45 * glow), colour[2] * (1.0 + 0.35 * glow)


@per_pixel
def flat_normal(skin, triangle):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns a triangle's unit normal, (3,), whichever side."""
    normal = skin.normal
    return np.float64(normal[triangle, 0]), np.float64(normal[triangle, 1]), np.float64(normal[triangle, 2])


@per_pixel
def out_of_crown(skin, triangle, point):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns the unit direction, (3,), from the middle of a leaf's crown to a point, (3,) local metres."""
    place, (x, y, z) = skin.place, point
    return _unit((x - place[triangle, 0], y - place[triangle, 1], z - place[triangle, 2]))


@per_pixel
def _unit(way):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    length = np.sqrt(dot(way, way)) + 1e-6
    return way[0] / length, way[1] / length, way[2] / length


@per_pixel
def _shading_normal(skin, triangle, point, back):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns a triangle's unit normal at a point, (3,) local metres, on the camera's side.

    ``back``, (3,), leads from the point to the camera. The normal of leaves is round a crown.
    """
    normal = flat_normal(skin, triangle)
    if dot(normal, back) < 0.0:
        normal = scaled(normal, -1.0)
    if skin.place[triangle, 6] > 0.0:
        normal = _unit(plus(out_of_crown(skin, triangle, point), normal, 0.5))
    return normal


@per_pixel
def surface_light(albedo, mirrored, point, normal, ray, shading):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns the light that a surface of a linear albedo sends to the camera from a point, (3,) metres.

    ``mirrored`` is the share of sky it mirrors, looked at straight; more when grazed. Normal and ray, from
    the camera to the point, are unit.
    """
    look = shading.look
    facing = dot(normal, look.sun)
    sun = facing * sun_share(point, normal, facing, shading.sun_map) if facing > 0.0 else 0.0
    # A surface sees as much sky as it looks up; the rest is ground, lit and grey-green.
    open_sky = 0.5 + 0.5 * normal[2]
    ground = 0.16 * (1.0 - open_sky)
    red, green, blue = plus(scaled(look.sun_rgb, sun), look.sky_rgb, open_sky)
    light = (albedo[0] * (red + ground), albedo[1] * (green + ground), albedo[2] * (blue + ground))
    if mirrored <= 0.0:
        return light
    cosine = -dot(ray, normal)
    bounced = plus(ray, normal, 2.0 * cosine)
    grazing = (1.0 - min(1.0, max(0.0, cosine))) ** 4
    share = mirrored + (1.0 - mirrored) * grazing * min(1.0, 4.0 * mirrored)
    # What looks down mirrors the ground.
    sky = sky_colour(bounced, look) if bounced[2] > 0.0 else (0.09, 0.09, 0.08)
    return mix(light, sky, min(1.0, share))


@per_pixel
def _pixel(triangle, inverse, column, row, f, rotation, center, shading):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns the linear RGB of one triangle, or of the sky, -1, at a place of the picture, sample pixels.

    ``inverse`` is 1 / depth there, ``f`` (4,) intrinsics, sample pixels; the rest is as in ``resolve_photo``.
    """
    skin, look = shading.skin, shading.look
    a, b = (column - f[2]) / f[0], (row - f[3]) / f[1]
    dx = rotation[0, 0] * a + rotation[1, 0] * b + rotation[2, 0]
    dy = rotation[0, 1] * a + rotation[1, 1] * b + rotation[2, 1]
    dz = rotation[0, 2] * a + rotation[1, 2] * b + rotation[2, 2]
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    ray = (dx / length, dy / length, dz / length)
    if triangle < 0:
        return sky_colour(ray, look)
    depth = 1.0 / inverse
    point = plus(center, (dx, dy, dz), depth)
    if skin.surface[triangle] == _TEXTURED:
        x, y, z = point
        light = texture_light(np.int64(skin.number[triangle]), x, y, z, 2.0 * depth / f[0], shading.charts)
        return mix(look.haze_rgb, light, np.exp(-depth * length * look.haze_per_m))
    normal = _shading_normal(skin, triangle, point, scaled(ray, -1.0))
    # Two samples are one pixel; a grazed surface is seen coarser, at most by 4.
    pixel_m = 2.0 * depth / f[0] / max(0.25, np.sqrt(abs(dot(ray, normal))))
    albedo, mirrored = surface_colour(triangle, point, normal, pixel_m, shading)
    light = surface_light(albedo, mirrored, point, normal, ray, shading)
    return mix(look.haze_rgb, light, np.exp(-depth * length * look.haze_per_m))


@pixel_loop
def resolve_photo(band, buffer, rotation, center, shading, out):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Writes the linear RGB of a band's pixels, each the mean of two by two samples, into ``out``, (H, W, 3).

    A triangle is shaded once per pixel, in the middle of its samples. The band is of the view at twice the
    picture's size; its first column is even. The pose is (3, 3) cam_from_world and the camera's centre, (3,).
    """
    # Columns lie along memory in the buffer, as for the raster.
    for column in range(band.first // 2, band.stop // 2):
        left = 2 * column - band.first
        for row in range(band.height // 2):
            top = 2 * row
            red = green = blue = 0.0
            to_do = 15
            while to_do:
                triangle, to_do, count, inverse, x, y = same_samples(buffer, left, top, to_do)
                x += band.first
                colour = _pixel(triangle, inverse, x, y, band.intrinsics, rotation, center, shading)
                red += 0.25 * count * colour[0]
                green += 0.25 * count * colour[1]
                blue += 0.25 * count * colour[2]
            out[row, column, 0], out[row, column, 1], out[row, column, 2] = red, green, blue
