"""What kernels count with: triples, and noise from integer hashes: at a place the same in whichever order."""

from __future__ import annotations

import numpy as np

from lodbench.rendering.compiled import per_pixel

_MASK = 0xFFFFFFFF


@per_pixel
def unit_hash(a, b, c):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns a number in [0, 1) that three integers, each within 31 bits, decide."""
    h = (a * 0x27D4EB2D + b * 0x165667B1 + c * 0x1E3779B1) & _MASK
    h ^= h >> 15
    h = (h * 0x5EBCA6B7) & _MASK
    h ^= h >> 13
    h = (h * 0x42B2AE35) & _MASK
    h ^= h >> 16
    return h * (1.0 / 4294967296.0)


@per_pixel
def value_noise(x, y, seed):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns smooth noise in [-1, 1] of a point of the plane; its grain has size 1."""
    fx, fy = np.floor(x), np.floor(y)
    i, j = np.int64(fx), np.int64(fy)
    u, v = x - fx, y - fy
    u, v = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v)
    low = unit_hash(i, j, seed) * (1.0 - u) + unit_hash(i + 1, j, seed) * u
    high = unit_hash(i, j + 1, seed) * (1.0 - u) + unit_hash(i + 1, j + 1, seed) * u
    return 2.0 * (low * (1.0 - v) + high * v) - 1.0


@per_pixel
def detail(grain_m, pixel_m):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns how much of a pattern of a grain size a pixel of a size still shows, 0 to 1.

    A pattern finer than two pixels is left out, so that it cannot alias.
    """
    return min(1.0, max(0.0, grain_m / (2.0 * pixel_m) - 0.5))


@per_pixel
def grain(x, y, size_m, pixel_m, seed):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns noise in [-1, 1] of a grain size, faded where a pixel no longer shows it."""
    shown = detail(size_m, pixel_m)
    if shown <= 0.0:
        return 0.0
    return shown * value_noise(x / size_m, y / size_m, seed)


@per_pixel
def stripe(x, low, high, width):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns how much of a pixel of a width, centred on x, lies between low and high, about."""
    wide = max(width, 1e-6)
    rising = min(1.0, max(0.0, (x - low) / wide + 0.5))
    falling = min(1.0, max(0.0, (high - x) / wide + 0.5))
    return rising * falling


@per_pixel
def mix(a, b, share):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns the colour a with a share of b."""
    keep = 1.0 - share
    return a[0] * keep + b[0] * share, a[1] * keep + b[1] * share, a[2] * keep + b[2] * share


@per_pixel
def scaled(a, factor):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns a triple times a number."""
    return a[0] * factor, a[1] * factor, a[2] * factor


@per_pixel
def plus(a, b, factor):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns the triple a and so many times b."""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


@per_pixel
def dot(a, b):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns the scalar product of two triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
