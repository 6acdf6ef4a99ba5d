"""From a z-buffer of two by two samples per pixel to light: texture, sun, sky, haze."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lodbench.rendering.compiled import per_pixel, pixel_loop
from lodbench.rendering.pixel_samples import same_samples
from lodbench.rendering.texture_charts import Charts, make_charts, texture_light
from lodbench.synthesis.photo.ground import NO_LAND_COVER, TEXTURED, LandCover
from lodbench.synthesis.photo.look import Look
from lodbench.synthesis.photo.noise import mix
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
def sky_colour(up, towards_sun, look):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns the linear RGB of the sky, by sine of elevation and by cosine of the angle to the sun."""
    height = min(1.0, max(0.0, up)) ** 0.45
    colour = mix(look.haze_rgb, look.zenith_rgb, height)
    glow = max(0.0, towards_sun) ** 24.0
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
    cx, cy, cz = x - place[triangle, 0], y - place[triangle, 1], z - place[triangle, 2]
    length = np.sqrt(cx * cx + cy * cy + cz * cz) + 1e-6
    return cx / length, cy / length, cz / length


@per_pixel
def _shading_normal(skin, triangle, point, back):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns a triangle's unit normal at a point, (3,) local metres, on the camera's side.

    ``back``, (3,), leads from the point to the camera. The normal of leaves is round a crown.
    """
    nx, ny, nz = flat_normal(skin, triangle)
    if nx * back[0] + ny * back[1] + nz * back[2] < 0.0:
        nx, ny, nz = -nx, -ny, -nz
    if skin.place[triangle, 6] > 0.0:
        cx, cy, cz = out_of_crown(skin, triangle, point)
        nx, ny, nz = 0.5 * nx + cx, 0.5 * ny + cy, 0.5 * nz + cz
        length = np.sqrt(nx * nx + ny * ny + nz * nz) + 1e-6
        nx, ny, nz = nx / length, ny / length, nz / length
    return nx, ny, nz


@per_pixel
def surface_light(albedo, mirrored, point, normal, ray, shading):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns the light a surface sends to the camera.

    Args:
        albedo: (3,) linear.
        mirrored: Share of sky it mirrors, looked at straight; more when grazed.
        point: (3,) local metres.
        normal: (3,) unit.
        ray: (3,) unit, from the camera to the point.
        shading: Of the picture.
    """
    look = shading.look
    facing = normal[0] * look.sun[0] + normal[1] * look.sun[1] + normal[2] * look.sun[2]
    sun = 0.0
    if facing > 0.0:
        sun = facing * sun_share(point, normal, facing, shading.sun_map)
    # A surface sees as much sky as it looks up; the rest is ground, lit and grey-green.
    open_sky = 0.5 + 0.5 * normal[2]
    ground = 0.16 * (1.0 - open_sky)
    red = albedo[0] * (sun * look.sun_rgb[0] + open_sky * look.sky_rgb[0] + ground)
    green = albedo[1] * (sun * look.sun_rgb[1] + open_sky * look.sky_rgb[1] + ground)
    blue = albedo[2] * (sun * look.sun_rgb[2] + open_sky * look.sky_rgb[2] + ground)
    if mirrored <= 0.0:
        return red, green, blue
    cosine = -(ray[0] * normal[0] + ray[1] * normal[1] + ray[2] * normal[2])
    bounce = 2.0 * cosine
    rx, ry, rz = ray[0] + bounce * normal[0], ray[1] + bounce * normal[1], ray[2] + bounce * normal[2]
    grazing = (1.0 - min(1.0, max(0.0, cosine))) ** 4
    share = mirrored + (1.0 - mirrored) * grazing * min(1.0, 4.0 * mirrored)
    towards_sun = rx * look.sun[0] + ry * look.sun[1] + rz * look.sun[2]
    # What looks down mirrors the ground.
    sky = sky_colour(rz, towards_sun, look) if rz > 0.0 else (0.09, 0.09, 0.08)
    return mix((red, green, blue), sky, min(1.0, share))


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
    towards_sun = ray[0] * look.sun[0] + ray[1] * look.sun[1] + ray[2] * look.sun[2]
    if triangle < 0:
        return sky_colour(ray[2], towards_sun, look)
    depth = 1.0 / inverse
    point = (center[0] + dx * depth, center[1] + dy * depth, center[2] + dz * depth)
    if skin.surface[triangle] == _TEXTURED:
        x, y, z = point
        light = texture_light(np.int64(skin.number[triangle]), x, y, z, 2.0 * depth / f[0], shading.charts)
        return mix(look.haze_rgb, light, np.exp(-depth * length * look.haze_per_m))
    normal = _shading_normal(skin, triangle, point, (-ray[0], -ray[1], -ray[2]))
    # Two samples are one pixel; a grazed surface is seen coarser, at most by 4.
    cosine = abs(ray[0] * normal[0] + ray[1] * normal[1] + ray[2] * normal[2])
    pixel_m = 2.0 * depth / f[0] / max(0.25, np.sqrt(cosine))
    albedo, mirrored = surface_colour(triangle, point, normal, pixel_m, shading)
    light = surface_light(albedo, mirrored, point, normal, ray, shading)
    return mix(look.haze_rgb, light, np.exp(-depth * length * look.haze_per_m))


@pixel_loop
def resolve_photo(band, buffer, rotation, center, shading, out):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Writes the linear RGB of a band's pixels, each the mean of two by two samples.

    A triangle is shaded once per pixel, in the middle of its samples.

    Args:
        band: Band of the view at twice the picture's size; its first column is even.
        buffer: Its z-buffer.
        rotation: (3, 3) cam_from_world.
        center: (3,) of the camera.
        shading: Of the picture.
        out: (H, W, 3) float32.
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
