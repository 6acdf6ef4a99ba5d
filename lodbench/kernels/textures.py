"""Textures for the raster: samples of a pixel taken together, and looking a place up on a picture."""

from __future__ import annotations

import numpy as np

from lodbench.kernels.compiled import per_pixel, uncounted


@per_pixel
def same_samples(buffer, left, top, to_do):
    """Returns what the samples have in common that show the same triangle as the first that is left.

    Args:
        buffer: Z-buffer of the samples.
        left: Column of the pixel's first sample, in the buffer.
        top: Its row.
        to_do: Which of the four samples are left, a bit each.

    Returns:
        The triangle (-1 for none), which samples are left now, how many were taken, and the means of their
        inverse depths, columns and rows, in the buffer and at their centres.
    """
    first = 0 if to_do & 1 else (1 if to_do & 2 else (2 if to_do & 4 else 3))
    triangle = buffer.winner[left + (first & 1), top + (first >> 1)]
    count, inverse, x, y = 0, 0.0, 0.0, 0.0
    for k in range(first, 4):
        u, v = left + (k & 1), top + (k >> 1)
        if buffer.winner[u, v] == triangle:
            to_do &= ~(1 << k)
            count += 1
            inverse += buffer.inverse[u, v]
            x += u
            y += v
    share = 1.0 / count
    return triangle, to_do, count, inverse * share, x * share + 0.5, y * share + 0.5


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
    picture = charts.picture[row]
    if picture < 0:
        c = start[row, 2, 0] + slope[row, 2, 0] * dx + slope[row, 2, 1] * dy + slope[row, 2, 2] * dz
        return a, b, c
    # The coarser direction decides the size of the texture to look at.
    across = np.sqrt(slope[row, 0, 0] ** 2 + slope[row, 0, 1] ** 2 + slope[row, 0, 2] ** 2)
    along = np.sqrt(slope[row, 1, 0] ** 2 + slope[row, 1, 1] ** 2 + slope[row, 1, 2] ** 2)
    texels = pixel_m * max(across * charts.size[picture, 0, 0], along * charts.size[picture, 0, 1])
    level = 0
    while texels > 1.5 and level < charts.size.shape[1] - 1:
        texels *= 0.5
        level += 1
    width, height = charts.size[picture, level, 0], charts.size[picture, level, 1]
    begin = charts.offset[picture, level]
    u, v = (a - np.floor(a)) * width - 0.5, (1.0 - (b - np.floor(b))) * height - 0.5
    i, j = np.int64(np.floor(u)), np.int64(np.floor(v))
    fu, fv = u - i, v - j
    red = green = blue = 0.0
    for k in range(4):
        column, line = (i + (k & 1)) % width, (j + (k >> 1)) % height
        weight = (fu if k & 1 else 1.0 - fu) * (fv if k >> 1 else 1.0 - fv)
        place = begin + 3 * (line * width + column)
        red += weight * charts.texels[place]
        green += weight * charts.texels[place + 1]
        blue += weight * charts.texels[place + 2]
    return red, green, blue


@per_pixel
def _sample(triangle, inverse, column, row, f, rotation, center, charts, background):
    """Returns the RGB of a triangle, or the background's for -1, at a place of the picture.

    Args:
        triangle: Number, or -1.
        inverse: 1 / depth there.
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
    depth = 1.0 / inverse
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
            to_do = 15
            while to_do:
                triangle, to_do, count, inverse, x, y = same_samples(buffer, left, top, to_do)
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
