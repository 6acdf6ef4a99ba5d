"""The two by two samples of a pixel, taken together where they show the same triangle."""

from __future__ import annotations

from lodbench.rendering.compiled import per_pixel


@per_pixel
def same_samples(buffer, left, top, to_do):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
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
