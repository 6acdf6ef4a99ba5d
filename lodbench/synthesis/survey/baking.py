"""Painting surfaces on pictures: texels are shaded where they lie in the world, in the light of one day."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.rendering.compiled import per_pixel, pixel_loop
from lodbench.synthesis.photo.kernel import surface_light
from lodbench.synthesis.photo.surfaces import surface_colour
from lodbench.synthesis.survey.charts import Layout

Floats = NDArray[np.float64]


def baked(layout: Layout, corners: Floats, shading: tuple[Any, ...]) -> NDArray[np.float32]:
    """Returns the (H, W, 3) linear RGB of a layout's picture; 0 where no triangle lies.

    Later triangles lie on earlier ones. Each is painted a texel further than it reaches, below all others.

    Args:
        layout: Triangles on the picture.
        corners: (T, 3, 3) of all triangles, metres.
        shading: (skin, look, cover, sun map, palettes).
    """
    width, height = layout.size
    light = np.zeros((height, width, 3), dtype=np.float32)
    for margin in (1.5, 0.0):
        _bake(layout.triangle, layout.texels, corners, layout.texel_m, margin, shading, light)
    return light


def corner_light(
    triangle: NDArray[np.int64], corners: Floats, shading: tuple[Any, ...]
) -> NDArray[np.float32]:
    """Returns the (N, 3, 3) linear RGB of the corners of some triangles; arguments as for ``baked``."""
    light = np.zeros((len(triangle), 3, 3), dtype=np.float32)
    _light_corners(triangle, corners, shading, light)
    return light


@per_pixel
def _surface_light(triangle, x, y, z, pixel_m, shading):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns the linear RGB of a triangle at a point, looked at straight."""
    skin, look, cover, sun_map, tables = shading
    nx, ny, nz = (
        np.float64(skin.normal[triangle, 0]),
        np.float64(skin.normal[triangle, 1]),
        np.float64(skin.normal[triangle, 2]),
    )
    if skin.place[triangle, 6] > 0.0:
        # Leaves: light as round a crown, from outside of it.
        cx, cy, cz = x - skin.place[triangle, 0], y - skin.place[triangle, 1], z - skin.place[triangle, 2]
        length = np.sqrt(cx * cx + cy * cy + cz * cz) + 1e-6
        nx, ny, nz = cx / length, cy / length, cz / length
    normal = (nx, ny, nz)
    albedo, _ = surface_colour(skin, triangle, x, y, z, normal, pixel_m, look, cover, tables)
    # What mirrors the sky looks different from everywhere: a map shows it dull.
    return surface_light(albedo, 0.0, x, y, z, normal, (-nx, -ny, -nz), look, sun_map)


@pixel_loop
def _bake(triangles, texels, corners, texel_m, margin, shading, out):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
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
        for row in range(top, bottom):  # type: ignore[call-overload]
            for column in range(left, right):  # type: ignore[call-overload]
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
                red, green, blue = _surface_light(t, x, y, z, texel_m, shading)
                out[row, column, 0], out[row, column, 1], out[row, column, 2] = red, green, blue


@pixel_loop
def _light_corners(triangles, corners, shading, out):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Writes the light of triangles' corners."""
    for k in range(len(triangles)):
        t = triangles[k]
        for corner in range(3):
            x, y, z = corners[t, corner, 0], corners[t, corner, 1], corners[t, corner, 2]
            red, green, blue = _surface_light(t, x, y, z, 0.5, shading)
            out[k, corner, 0], out[k, corner, 1], out[k, corner, 2] = red, green, blue
