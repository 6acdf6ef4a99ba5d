"""Masks as polygons, which give the same masks again to the pixel."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]
Ring = NDArray[np.int32]
Corner = tuple[int, int]


class MaskPolygon(NamedTuple):
    """One connected part of a mask.

    Attributes:
        outer: (N, 2) its outermost pixels, column and row, in order.
        holes: The same of each hole in it.
    """

    outer: Ring
    holes: tuple[Ring, ...]


def polygons_of(mask: Mask) -> list[MaskPolygon]:
    """Returns a mask's connected parts, largest first; ``mask_of`` gives the same mask to the pixel."""
    parts = sorted(_parts(mask, 8), key=lambda found: -int(found[1].sum()))
    return [_polygon(part, corner) for corner, part in parts]


def mask_of(polygons: list[MaskPolygon], height: int, width: int) -> Mask:
    """Returns the (height, width) mask of polygons within it: all of them, each without its holes."""
    mask = np.zeros((height, width), bool)
    for polygon in polygons:
        (x, y), part = painted(polygon)
        mask[y : y + part.shape[0], x : x + part.shape[1]] |= part
    return mask


def painted(polygon: MaskPolygon) -> tuple[Corner, Mask]:
    """Returns left and top of a polygon's box, and its mask in it."""
    corner, end = polygon.outer.min(axis=0), polygon.outer.max(axis=0) + 1
    canvas = np.zeros((end - corner)[::-1], np.uint8)
    cv2.fillPoly(canvas, [polygon.outer - corner], 1)
    for hole in polygon.holes:
        cv2.fillPoly(canvas, [hole - corner], 0)
    return (int(corner[0]), int(corner[1])), np.asarray(canvas > 0)


def _parts(mask: Mask, connectivity: int) -> Iterator[tuple[Corner, Mask]]:
    """Yields left and top of the box of each connected part, and the part in it."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        mask.astype(np.uint8), connectivity=connectivity
    )
    for label in range(1, count):
        x, y, width, height = (int(value) for value in stats[label, :4])
        yield (x, y), np.asarray(labels[y : y + height, x : x + width] == label)


def _polygon(part: Mask, corner: Corner) -> MaskPolygon:
    outer = _outline(part)
    holes = [
        ring + place
        for place, hole in _parts(_filled(outer, part.shape) & ~part, 4)
        for ring in _hole_outlines(hole, part[place[1] :, place[0] :][: hole.shape[0], : hole.shape[1]])
    ]
    return MaskPolygon(outer + corner, tuple(np.asarray(hole + corner, np.int32) for hole in holes))


def _hole_outlines(hole: Mask, part: Mask) -> Iterator[Ring]:
    """Yields outlines that hold a hole and nothing of the (H, W) part around it.

    A hole may close round some of the part but for a corner, which an outline cuts: it is parted there.
    """
    ring = _outline(hole)
    rows = np.flatnonzero((_filled(ring, hole.shape) & part).any(axis=1))
    if not len(rows):
        yield ring
        return
    for first, last in ((0, rows[0]), (rows[0], len(hole))):
        for (x, y), piece in _parts(hole[first:last], 4):
            around = part[first + y :, x:][: piece.shape[0], : piece.shape[1]]
            for found in _hole_outlines(piece, around):
                yield np.add(found, (x, first + y), dtype=np.int32)


def _outline(part: Mask) -> Ring:
    contours, _ = cv2.findContours(part.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    return np.asarray(contours[0][:, 0], np.int32)


def _filled(ring: Ring, shape: tuple[int, ...]) -> Mask:
    return cv2.fillPoly(np.zeros(shape, np.uint8), [ring], 1) > 0
