"""Some of the polygons of a city: those of a level, or a few at a time."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.model import Polygons
from lodbench.citymodel.raw import take_segments


def select_polygons(polygons: Polygons, chosen: NDArray[np.int64]) -> Polygons:
    """Returns some of the polygons, in the order given."""
    if len(chosen) == len(polygons) and np.all(chosen[1:] > chosen[:-1]):
        return polygons
    rings, polygon_starts = take_segments(polygons.polygon_starts, chosen)
    points, ring_starts = take_segments(polygons.ring_starts, rings)
    return Polygons(
        points=polygons.points[points],
        ring_starts=ring_starts,
        polygon_starts=polygon_starts,
        building=polygons.building[chosen],
        lod=polygons.lod[chosen],
        kind=polygons.kind[chosen],
        part=None if polygons.part is None else polygons.part[chosen],
        picture=None if polygons.picture is None else polygons.picture[chosen],
        uv=None if polygons.uv is None else polygons.uv[points],
    )


def slice_polygons(polygons: Polygons, first: int, last: int) -> Polygons:
    """Returns the polygons from ``first`` to before ``last``; their arrays are views."""
    if first == 0 and last >= len(polygons):
        return polygons
    rings = polygons.polygon_starts[first : last + 1]
    points = polygons.ring_starts[rings[0] : rings[-1] + 1]
    return Polygons(
        points=polygons.points[points[0] : points[-1]],
        ring_starts=points - points[0],
        polygon_starts=rings - rings[0],
        building=polygons.building[first:last],
        lod=polygons.lod[first:last],
        kind=polygons.kind[first:last],
        part=None if polygons.part is None else polygons.part[first:last],
        picture=None if polygons.picture is None else polygons.picture[first:last],
        uv=None if polygons.uv is None else polygons.uv[points[0] : points[-1]],
    )


def polygon_blocks(
    polygons: Polygons, chosen: NDArray[np.int64], block_polygons: int
) -> Iterator[tuple[int, Polygons]]:
    """Yields the chosen polygons by building, some thousand at a time, and how many came before.

    A building is never cut, and the buildings ascend.
    """
    building = polygons.building[chosen]
    if np.any(building[1:] < building[:-1]):
        order = np.argsort(building, kind="stable")
        chosen, building = chosen[order], building[order]
    for first, last in pairwise(group_cuts(building, block_polygons)):
        yield first, select_polygons(polygons, chosen[first:last])


def group_cuts(groups: NDArray[np.integer], size: int) -> list[int]:
    """Returns where to cut items in ascending groups into blocks of about ``size`` whole groups.

    Example:
        >>> group_cuts(np.array([0, 0, 0, 4, 4, 7]), 2)
        [0, 3, 5, 6]
    """
    is_last = np.append(groups[1:] != groups[:-1], True)
    ends = np.flatnonzero(is_last[: len(groups)]) + 1
    wanted = np.arange(size, len(groups) + size, size).clip(max=len(groups))
    cuts: list[int] = np.unique(ends[np.searchsorted(ends, wanted)]).tolist()
    return [0, *cuts]
