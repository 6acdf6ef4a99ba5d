"""Pixels of drawn photos: textures, sun and shadow, sky, haze, a camera, and light baked into textures."""

from __future__ import annotations

import numpy as np

from lodbench.kernels.arguments import MAX_LIGHT, TONE_STEPS
from lodbench.kernels.compiled import kernel, per_pixel, uncounted
from lodbench.kernels.looks import TEXTURED
from lodbench.kernels.surfaces import add_scaled, dot, mix, scaled, surface_colour, unit_hash


@per_pixel
def same_samples(buffer, left, top, remaining):
    """Returns what the samples have in common that show the same triangle as the first that is left.

    Args:
        buffer: Z-buffer of the samples.
        left: Column of the pixel's first sample, in the buffer.
        top: Its row.
        remaining: Which of the four samples are left, a bit each.

    Returns:
        The triangle (-1 for none), which samples are left now, how many were taken, and the means of their
        inverse depths, columns and rows, in the buffer and at their centres.
    """
    first = 0 if remaining & 1 else (1 if remaining & 2 else (2 if remaining & 4 else 3))
    triangle = buffer.triangle[left + (first & 1), top + (first >> 1)]
    count, inverse, x, y = 0, 0.0, 0.0, 0.0
    for k in range(first, 4):
        u, v = left + (k & 1), top + (k >> 1)
        if buffer.triangle[u, v] == triangle:
            remaining &= ~(1 << k)
            count += 1
            inverse += buffer.inverse[u, v]
            x += u
            y += v
    share = 1.0 / count
    return triangle, remaining, count, inverse * share, x * share + 0.5, y * share + 0.5


@per_pixel
def texture_light(row, x, y, z, pixel_m, charts):
    """Returns the linear RGB of a textured triangle at a point; arguments as for ``texture_colour``."""
    red, green, blue = texture_colour(row, x, y, z, pixel_m, charts)
    scale = 1.0 / 65025.0
    return red * red * scale, green * green * scale, blue * blue * scale


@per_pixel
def texture_colour(row, x, y, z, pixel_m, charts):
    """Returns the RGB of a textured triangle at a point, 0 to 255.

    Args:
        row: Of the triangle in the charts.
        x: Point, east, local metres.
        y: North.
        z: Up.
        pixel_m: Size of a pixel there.
        charts: Charts.
    """
    start, slope = charts.start, charts.slope
    dx, dy, dz = x - start[row, 0, 1], y - start[row, 1, 1], z - start[row, 2, 1]
    a = start[row, 0, 0] + slope[row, 0, 0] * dx + slope[row, 0, 1] * dy + slope[row, 0, 2] * dz
    b = start[row, 1, 0] + slope[row, 1, 0] * dx + slope[row, 1, 1] * dy + slope[row, 1, 2] * dz
    texture = charts.picture[row]
    if texture < 0:
        c = start[row, 2, 0] + slope[row, 2, 0] * dx + slope[row, 2, 1] * dy + slope[row, 2, 2] * dz
        return a, b, c
    # The coarser direction decides the size of the texture to look at.
    across = np.sqrt(slope[row, 0, 0] ** 2 + slope[row, 0, 1] ** 2 + slope[row, 0, 2] ** 2)
    along = np.sqrt(slope[row, 1, 0] ** 2 + slope[row, 1, 1] ** 2 + slope[row, 1, 2] ** 2)
    texels = pixel_m * max(across * charts.size[texture, 0, 0], along * charts.size[texture, 0, 1])
    level = 0
    while texels > 1.5 and level < charts.size.shape[1] - 1:
        texels *= 0.5
        level += 1
    width, height = charts.size[texture, level, 0], charts.size[texture, level, 1]
    begin = charts.offset[texture, level]
    u, v = (a - np.floor(a)) * width - 0.5, (1.0 - (b - np.floor(b))) * height - 0.5
    i, j = np.int64(np.floor(u)), np.int64(np.floor(v))
    fu, fv = u - i, v - j
    red = green = blue = 0.0
    for k in range(4):
        column, line = (i + (k & 1)) % width, (j + (k >> 1)) % height
        weight = (fu if k & 1 else 1.0 - fu) * (fv if k >> 1 else 1.0 - fv)
        texel = begin + 3 * (line * width + column)
        red += weight * charts.texels[texel]
        green += weight * charts.texels[texel + 1]
        blue += weight * charts.texels[texel + 2]
    return red, green, blue


@per_pixel
def _sample(triangle, inverse_depth, column, row, f, rotation, center, charts, background):
    """Returns the RGB of a triangle, or the background's for -1, at a place of the picture.

    Args:
        triangle: Number, or -1.
        inverse_depth: 1 / depth there.
        column: Place, sample pixels.
        row: Likewise.
        f: (4,) intrinsics, sample pixels.
        rotation: (3, 3) cam_from_world.
        center: (3,) of the camera.
        charts: Charts.
        background: (3,) RGB.
    """
    if triangle < 0:
        return background[0], background[1], background[2]
    depth = 1.0 / inverse_depth
    a, b = depth * (column - f[2]) / f[0], depth * (row - f[3]) / f[1]
    x = center[0] + rotation[0, 0] * a + rotation[1, 0] * b + rotation[2, 0] * depth
    y = center[1] + rotation[0, 1] * a + rotation[1, 1] * b + rotation[2, 1] * depth
    z = center[2] + rotation[0, 2] * a + rotation[1, 2] * b + rotation[2, 2] * depth
    return texture_colour(np.int64(triangle), x, y, z, 2.0 * depth / f[0], charts)


@uncounted
def resolve_textured(band, buffer, rotation, center, charts, background, out):
    """Writes a band's pixels, each the mean of two by two samples; a triangle is looked up once in each.

    Args:
        band: Band of the view at twice the picture's size; its first column is even.
        buffer: Its z-buffer.
        rotation: (3, 3) cam_from_world.
        center: (3,) of the camera.
        charts: Charts.
        background: (3,) RGB.
        out: (H, W, 3) uint8.
    """
    for column in range(band.first // 2, band.stop // 2):
        left = 2 * column - band.first
        for row in range(band.height // 2):
            top = 2 * row
            red = green = blue = 0.0
            remaining = 15
            while remaining:
                triangle, remaining, count, inverse, x, y = same_samples(buffer, left, top, remaining)
                colour = _sample(
                    triangle,
                    inverse,
                    x + band.first,
                    y,
                    band.intrinsics,
                    rotation,
                    center,
                    charts,
                    background,
                )
                red += 0.25 * count * colour[0]
                green += 0.25 * count * colour[1]
                blue += 0.25 * count * colour[2]
            out[row, column, 0] = np.uint8(min(max(red + 0.5, 0.0), 255.0))
            out[row, column, 1] = np.uint8(min(max(green + 0.5, 0.0), 255.0))
            out[row, column, 2] = np.uint8(min(max(blue + 0.5, 0.0), 255.0))


@per_pixel
def sun_share(point, normal, cosine, sun_map):
    """Returns how much of the sun reaches a point, (3,) local metres, 0 to 1: four map pixels, weighted.

    The normal, (3,), is on the camera's side; ``cosine`` is that of its angle to the sun, above 0.
    """
    # Off the surface by a map pixel and more where light grazes it: it must not shade itself.
    offset_m = sun_map.texel_m * (0.6 + 0.8 * (1.0 - cosine))
    c, r = sun_map.center, sun_map.rotation
    to_point = add_scaled(add_scaled(point, normal, offset_m), c, -1.0)
    depth = dot(r[2], to_point)
    size = sun_map.depth.shape[0]
    scale = sun_map.focal / depth
    u = dot(r[0], to_point) * scale + 0.5 * size - 0.5
    v = dot(r[1], to_point) * scale + 0.5 * size - 0.5
    i, j = np.int64(np.floor(u)), np.int64(np.floor(v))
    if i < 0 or j < 0 or i >= size - 1 or j >= size - 1:
        return 1.0
    bias = depth - 0.08 - 0.5 * sun_map.texel_m
    fu, fv = u - i, v - j
    lit = 0.0
    for row in range(2):
        for column in range(2):
            occluder_m = sun_map.depth[j + row, i + column]
            if occluder_m == 0.0 or occluder_m >= bias:
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
def crown_normal(skin, triangle, point):
    """Returns the unit direction, (3,), from the middle of a leaf's crown to a point, (3,) local metres."""
    place, (x, y, z) = skin.place, point
    return _unit((x - place[triangle, 0], y - place[triangle, 1], z - place[triangle, 2]))


@per_pixel
def _unit(vector):
    length = np.sqrt(dot(vector, vector)) + 1e-6
    return vector[0] / length, vector[1] / length, vector[2] / length


@per_pixel
def _shading_normal(skin, triangle, point, to_camera):
    """Returns a triangle's unit normal at a point, (3,) local metres, on the camera's side.

    ``to_camera``, (3,), leads from the point to the camera. The normal of leaves is round a crown.
    """
    normal = flat_normal(skin, triangle)
    if dot(normal, to_camera) < 0.0:
        normal = scaled(normal, -1.0)
    if skin.place[triangle, 6] > 0.0:
        normal = _unit(add_scaled(crown_normal(skin, triangle, point), normal, 0.5))
    return normal


@per_pixel
def surface_light(albedo, reflectance, point, normal, ray, shading):
    """Returns the light that a surface of a linear albedo sends to the camera from a point, (3,) metres.

    ``reflectance`` is the share of sky it mirrors, looked at straight; more when grazed. Normal and ray, from
    the camera to the point, are unit.
    """
    look = shading.look
    sun_cosine = dot(normal, look.sun)
    sun = sun_cosine * sun_share(point, normal, sun_cosine, shading.sun_map) if sun_cosine > 0.0 else 0.0
    # A surface sees as much sky as it looks up; the rest is ground, lit and grey-green.
    sky_fraction = 0.5 + 0.5 * normal[2]
    ground = 0.16 * (1.0 - sky_fraction)
    red, green, blue = add_scaled(scaled(look.sun_rgb, sun), look.sky_rgb, sky_fraction)
    light = (albedo[0] * (red + ground), albedo[1] * (green + ground), albedo[2] * (blue + ground))
    if reflectance <= 0.0:
        return light
    cosine = -dot(ray, normal)
    reflected = add_scaled(ray, normal, 2.0 * cosine)
    grazing = (1.0 - min(1.0, max(0.0, cosine))) ** 4
    sky_weight = reflectance + (1.0 - reflectance) * grazing * min(1.0, 4.0 * reflectance)
    # What looks down mirrors the ground.
    sky = sky_colour(reflected, look) if reflected[2] > 0.0 else (0.09, 0.09, 0.08)
    return mix(light, sky, min(1.0, sky_weight))


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
    point = add_scaled(center, (dx, dy, dz), depth)
    if skin.surface[triangle] == _TEXTURED:
        x, y, z = point
        light = texture_light(np.int64(skin.number[triangle]), x, y, z, 2.0 * depth / f[0], shading.charts)
        return mix(look.haze_rgb, light, np.exp(-depth * length * look.haze_per_m))
    normal = _shading_normal(skin, triangle, point, scaled(ray, -1.0))
    # Two samples are one pixel; a grazed surface is seen coarser, at most by 4.
    pixel_m = 2.0 * depth / f[0] / max(0.25, np.sqrt(abs(dot(ray, normal))))
    albedo, reflectance = surface_colour(triangle, point, normal, pixel_m, shading)
    light = surface_light(albedo, reflectance, point, normal, ray, shading)
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
            remaining = 15
            while remaining:
                triangle, remaining, count, inverse, x, y = same_samples(buffer, left, top, remaining)
                x += band.first
                colour = _pixel(triangle, inverse, x, y, band.intrinsics, rotation, center, shading)
                red += 0.25 * count * colour[0]
                green += 0.25 * count * colour[1]
                blue += 0.25 * count * colour[2]
            out[row, column, 0], out[row, column, 1], out[row, column, 2] = red, green, blue


@kernel
def expose(light, response, tone_curve, picture):
    """Writes the (H, W, 3) uint8 picture of (H, W, 3) linear light: vignette, saturation, tone and noise.

    ``response`` is a CameraResponse, ``tone_curve`` the brightness of light 0, 1 / TONE_STEPS, ...
    """
    height, width, _ = light.shape
    balance = (1.0 + response.white_balance, 1.0, 1.0 - response.white_balance)
    radius_scale = 4.0 / (height * height + width * width)
    for row in range(height):
        for column in range(width):
            dx, dy = column + 0.5 - 0.5 * width, row + 0.5 - 0.5 * height
            gain = response.exposure * (1.0 - response.vignette * (dx * dx + dy * dy) * radius_scale)
            grey = 0.3 * light[row, column, 0] + 0.6 * light[row, column, 1] + 0.1 * light[row, column, 2]
            for c in range(3):
                value = grey + response.saturation * (light[row, column, c] - grey)
                position = min(MAX_LIGHT * 1.0, max(0.0, gain * balance[c] * value)) * TONE_STEPS
                step = np.int64(position)
                value = tone_curve[step] + (tone_curve[step + 1] - tone_curve[step]) * (position - step)
                # Photons come by chance: brighter is noisier, by the root, which the tone curve undoes.
                # The four bytes of a hash, added up, are near enough normal.
                bits = np.int64(unit_hash(column, row, response.seed + c) * 4294967296.0)
                total = (bits & 255) + ((bits >> 8) & 255) + ((bits >> 16) & 255) + ((bits >> 24) & 255)
                value += response.noise * (0.6 + 0.5 * value) * ((total - 510.0) * (1.0 / 147.8))
                picture[row, column, c] = np.uint8(min(255.0, max(0.0, 255.0 * value + 0.5)))


@per_pixel
def _frontal_light(triangle, point, pixel_m, shading):
    """Returns the linear RGB of a triangle at a point, looked at straight."""
    skin = shading.skin
    normal = flat_normal(skin, triangle)
    if skin.place[triangle, 6] > 0.0:
        # Leaves: light as round a crown, from outside of it.
        normal = crown_normal(skin, triangle, point)
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
                red, green, blue = _frontal_light(t, (x, y, z), texel_m, shading)
                out[row, column, 0], out[row, column, 1], out[row, column, 2] = red, green, blue


@uncounted
def light_corners(triangles, corners, shading, out):
    """Writes the light of triangles' corners."""
    for k in range(len(triangles)):
        t = triangles[k]
        for corner in range(3):
            point = (corners[t, corner, 0], corners[t, corner, 1], corners[t, corner, 2])
            red, green, blue = _frontal_light(t, point, 0.5, shading)
            out[k, corner, 0], out[k, corner, 1], out[k, corner, 2] = red, green, blue
