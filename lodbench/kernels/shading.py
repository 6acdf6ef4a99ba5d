"""Pixels of drawn photos: sun and shadow, sky, haze, a camera, and the same light baked into textures."""

from __future__ import annotations

import numpy as np

from lodbench.kernels.arguments import BRIGHTEST, TONE_STEPS
from lodbench.kernels.compiled import kernel, per_pixel, uncounted
from lodbench.kernels.looks import TEXTURED
from lodbench.kernels.patterns import dot, mix, plus, scaled, unit_hash
from lodbench.kernels.surfaces import surface_colour
from lodbench.kernels.textures import same_samples, texture_light


@per_pixel
def sun_share(point, normal, facing, sun_map):
    """Returns how much of the sun reaches a point, (3,) local metres, 0 to 1: four map pixels, weighted.

    The normal, (3,), is on the camera's side; ``facing`` is the cosine between it and the sun, above 0.
    """
    # Off the surface by a map pixel and more where light grazes it: it must not shade itself.
    push = sun_map.texel_m * (0.6 + 0.8 * (1.0 - facing))
    c, r = sun_map.center, sun_map.rotation
    way = plus(plus(point, normal, push), c, -1.0)
    depth = dot(r[2], way)
    size = sun_map.depth.shape[0]
    scale = sun_map.focal / depth
    u = dot(r[0], way) * scale + 0.5 * size - 0.5
    v = dot(r[1], way) * scale + 0.5 * size - 0.5
    i, j = np.int64(np.floor(u)), np.int64(np.floor(v))
    if i < 0 or j < 0 or i >= size - 1 or j >= size - 1:
        return 1.0
    bias = depth - 0.08 - 0.5 * sun_map.texel_m
    fu, fv = u - i, v - j
    lit = 0.0
    for row in range(2):
        for column in range(2):
            first = sun_map.depth[j + row, i + column]
            if first == 0.0 or first >= bias:
                lit += (fu if column else 1.0 - fu) * (fv if row else 1.0 - fv)
    return lit


_TEXTURED = int(TEXTURED)


@per_pixel
def sky_colour(ray, look):
    """Returns the linear RGB of the sky along a unit direction."""
    height = min(1.0, max(0.0, ray[2])) ** 0.45
    colour = mix(look.haze_rgb, look.zenith_rgb, height)
    glow = max(0.0, dot(ray, look.sun)) ** 24.0
    return colour[0] * (1.0 + 0.5 * glow), colour[1] * (1.0 + 0.45 * glow), colour[2] * (1.0 + 0.35 * glow)


@per_pixel
def flat_normal(skin, triangle):
    """Returns a triangle's unit normal, (3,), whichever side."""
    normal = skin.normal
    return np.float64(normal[triangle, 0]), np.float64(normal[triangle, 1]), np.float64(normal[triangle, 2])


@per_pixel
def out_of_crown(skin, triangle, point):
    """Returns the unit direction, (3,), from the middle of a leaf's crown to a point, (3,) local metres."""
    place, (x, y, z) = skin.place, point
    return _unit((x - place[triangle, 0], y - place[triangle, 1], z - place[triangle, 2]))


@per_pixel
def _unit(way):
    length = np.sqrt(dot(way, way)) + 1e-6
    return way[0] / length, way[1] / length, way[2] / length


@per_pixel
def _shading_normal(skin, triangle, point, back):
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
def surface_light(albedo, mirrored, point, normal, ray, shading):
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
def _pixel(triangle, inverse, column, row, f, rotation, center, shading):
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


@uncounted
def resolve_photo(band, buffer, rotation, center, shading, out):
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


@kernel
def expose(light, how, curve, picture):
    """Writes the (H, W, 3) uint8 picture of (H, W, 3) linear light: vignette, saturation, tone and noise.

    ``how`` is a CameraResponse, ``curve`` the brightness of light 0, 1 / TONE_STEPS, 2 / TONE_STEPS, ...
    """
    height, width, _ = light.shape
    balance = (1.0 + how.white_balance, 1.0, 1.0 - how.white_balance)
    reach = 4.0 / (height * height + width * width)
    for row in range(height):
        for column in range(width):
            dx, dy = column + 0.5 - 0.5 * width, row + 0.5 - 0.5 * height
            gain = how.exposure * (1.0 - how.vignette * (dx * dx + dy * dy) * reach)
            grey = 0.3 * light[row, column, 0] + 0.6 * light[row, column, 1] + 0.1 * light[row, column, 2]
            for c in range(3):
                value = grey + how.saturation * (light[row, column, c] - grey)
                place = min(BRIGHTEST * 1.0, max(0.0, gain * balance[c] * value)) * TONE_STEPS
                step = np.int64(place)
                value = curve[step] + (curve[step + 1] - curve[step]) * (place - step)
                # Photons come by chance: brighter is noisier, by the root, which the curve undoes.
                # The four bytes of a hash, added up, are near enough normal.
                bits = np.int64(unit_hash(column, row, how.seed + c) * 4294967296.0)
                total = (bits & 255) + ((bits >> 8) & 255) + ((bits >> 16) & 255) + ((bits >> 24) & 255)
                value += how.noise * (0.6 + 0.5 * value) * ((total - 510.0) * (1.0 / 147.8))
                picture[row, column, c] = np.uint8(min(255.0, max(0.0, 255.0 * value + 0.5)))


@per_pixel
def _straight_light(triangle, point, pixel_m, shading):
    """Returns the linear RGB of a triangle at a point, looked at straight."""
    skin = shading.skin
    normal = flat_normal(skin, triangle)
    if skin.place[triangle, 6] > 0.0:
        # Leaves: light as round a crown, from outside of it.
        normal = out_of_crown(skin, triangle, point)
    albedo, _ = surface_colour(triangle, point, normal, pixel_m, shading)
    # What mirrors the sky looks different from everywhere: a map shows it dull.
    return surface_light(albedo, 0.0, point, normal, scaled(normal, -1.0), shading)


@uncounted
def bake(triangles, texels, corners, texel_m, margin, shading, out):
    """Writes the light of texels within triangles; with a margin, of those up to so many texels outside."""
    height, width, _ = out.shape
    for k in range(len(triangles)):
        t = triangles[k]
        ax, ay = texels[k, 0, 0], texels[k, 0, 1]
        bx, by = texels[k, 1, 0] - ax, texels[k, 1, 1] - ay
        cx, cy = texels[k, 2, 0] - ax, texels[k, 2, 1] - ay
        area = bx * cy - by * cx
        if abs(area) < 1e-9:
            continue
        # What one texel across an edge changes of each barycentric coordinate.
        slope_b, slope_c = np.sqrt(cx * cx + cy * cy) / abs(area), np.sqrt(bx * bx + by * by) / abs(area)
        slope_a = np.sqrt((bx - cx) ** 2 + (by - cy) ** 2) / abs(area)
        left = max(0, np.int64(np.floor(ax + min(0.0, bx, cx) - margin)))
        right = min(width, np.int64(np.ceil(ax + max(0.0, bx, cx) + margin)))
        top = max(0, np.int64(np.floor(ay + min(0.0, by, cy) - margin)))
        bottom = min(height, np.int64(np.ceil(ay + max(0.0, by, cy) + margin)))
        for row in range(top, bottom):
            for column in range(left, right):
                dx, dy = column + 0.5 - ax, row + 0.5 - ay
                b, c = (dx * cy - dy * cx) / area, (bx * dy - by * dx) / area
                a = 1.0 - b - c
                if a < -margin * slope_a or b < -margin * slope_b or c < -margin * slope_c:
                    continue
                if margin > 0.0 and a >= 0.0 and b >= 0.0 and c >= 0.0:
                    continue
                x = a * corners[t, 0, 0] + b * corners[t, 1, 0] + c * corners[t, 2, 0]
                y = a * corners[t, 0, 1] + b * corners[t, 1, 1] + c * corners[t, 2, 1]
                z = a * corners[t, 0, 2] + b * corners[t, 1, 2] + c * corners[t, 2, 2]
                red, green, blue = _straight_light(t, (x, y, z), texel_m, shading)
                out[row, column, 0], out[row, column, 1], out[row, column, 2] = red, green, blue


@uncounted
def light_corners(triangles, corners, shading, out):
    """Writes the light of triangles' corners."""
    for k in range(len(triangles)):
        t = triangles[k]
        for corner in range(3):
            point = (corners[t, corner, 0], corners[t, corner, 1], corners[t, corner, 2])
            red, green, blue = _straight_light(t, point, 0.5, shading)
            out[k, corner, 0], out[k, corner, 1], out[k, corner, 2] = red, green, blue
