"""Buildings that the map lacks: what masks of several photos hold and no building explains.

It is looked up in space: a place that nearly all photos that see it past the map's buildings call a building
is one (a visual hull over a grid of voxels). Patches that one photo makes up agree with no other.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.estimation.edge_alignment import project
from lodbench.kernels import add_votes
from lodbench.methods.flight.demolished_buildings import APART_DEG, View, apart_deg
from lodbench.methods.flight.roof_edges import SweepPicture
from lodbench.methods.flight.roof_sweep import density_of, sweep_place

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Cells = NDArray[np.int64]

# Voxels: their width, their heights above ground, metres; and what makes a place of them a building.
_CELL_M, _HEIGHTS_M = 2.0, (1.0, 3.0, 5.0, 8.0, 12.0, 17.0, 23.0, 30.0)
_SHARE, _FEWEST_PHOTOS, _LEAST_M2 = 0.8, 3, 16.0
# The ground is as high as where the walls of so many buildings nearby end, the median of them.
_NEIGHBOURS = 3
# The ground is looked at in squares of this many cells a side.
_SQUARE = 256
# What lies this near to a building's silhouette is its own, badly drawn; what lies further is seen too small.
_MARGIN_PX, _FURTHEST_M = 3, 400.0
# Heights that pixels are compared at; what they say is known no better than this, and not stated if known
# worse than that, metres. What is most probably lower than this lies on the ground.
_TRIED_M, _BEST_M, _OPEN_M, _FLAT_M = np.arange(0.0, 30.01, 0.5), 1.0, 2.0, 1.0
# Looked for 2 m higher, a place moves by 1 m in a photo 27 deg off the nadir, a tenth of what is as large as
# this: of smaller ones masks do not show whether they rise, square metres.
_WIDE_M2 = 100.0
# Points of a cell whose colours are compared, metres from its corner.
_WITHIN_M = np.array([(0.5, 0.5), (0.5, 1.5), (1.5, 0.5), (1.5, 1.5)])


def unmapped_buildings(
    views: Sequence[View], city_map: CityMap, pictures: Sequence[SweepPicture] = ()
) -> list[dict[str, Any]]:
    """Returns places where something stands that masks hold and the map has not, the largest first.

    Each with its ``outline``: rings of (east, north) in the city's coordinates, ``area_m2``, ``height_m``
    above the ground and its ``sigma_m``, both None where pixels do not determine it, ``at_most_m``, which
    masks allow (None: more than is looked for), the ``share`` of photos that show it of those that could, the
    ``photos``, and ``apart_deg`` between the directions that they look from.

    Args:
        views: Where masks are looked at.
        city_map: The map.
        pictures: The photos as ``sweep_roofs`` leaves them: at its height something looks alike in all.
    """
    if len(views) < _FEWEST_PHOTOS:
        return []
    known = [_known(view, city_map) for view in views]
    ground = _Ground(city_map)
    corner, counts = _grid(views, ground.usual)
    cells, shares = _built_cells(views, known, corner, counts, ground)
    return _components(cells, shares, corner, ground, views, known, city_map, pictures)


class _Ground:
    """The height of the ground: where the walls of the nearest buildings end.

    Attributes:
        usual: A low height of it in the whole city, scene metres.
    """

    def __init__(self, city_map: CityMap) -> None:
        scene = city_map.scene
        filled = np.flatnonzero(np.diff(scene.vertex_starts) > 0)
        starts, counts = scene.vertex_starts[filled], np.diff(scene.vertex_starts)[filled]
        vertices = scene.vertices.astype(np.float64)
        self._floors = np.minimum.reduceat(vertices[:, 2], starts)
        self._tree = scipy.spatial.cKDTree(np.add.reduceat(vertices[:, :2], starts) / counts[:, None])
        self.usual = float(np.percentile(self._floors, 30))

    def at(self, places: Floats) -> Floats:
        """Returns (N,) heights at (N, 2) places, scene metres."""
        nearest = min(_NEIGHBOURS, len(self._floors))
        _, rows = self._tree.query(places, k=nearest)
        return np.asarray(np.median(self._floors[rows.reshape(len(places), nearest)], axis=1))


def _built_cells(
    views: Sequence[View], known: Sequence[Mask], corner: Floats, counts: tuple[int, int], ground: _Ground
) -> tuple[Cells, Floats]:
    """Returns the cells of the ground that photos call a building, (N, 2), and by how many of them, (H, N).

    Square by square, so that a long flight needs no more room than a short one, and those only that a photo
    may see, so that one taken elsewhere costs no more than any other.
    """
    cells, shares = [np.zeros((0, 2), dtype=np.int64)], [np.zeros((len(_HEIGHTS_M), 0))]
    for first in _squares(views, corner, counts):
        sides = [np.arange(k, min(k + _SQUARE, count)) for k, count in zip(first, counts, strict=True)]
        square = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)
        of_square = _shares(corner + _CELL_M * (square + 0.5), ground, views, known)
        is_built = of_square[:2].max(axis=0) >= _SHARE
        cells.append(square[is_built])
        shares.append(of_square[:, is_built])
    return np.concatenate(cells), np.concatenate(shares, axis=1)


def _squares(views: Sequence[View], corner: Floats, counts: tuple[int, int]) -> list[tuple[int, int]]:
    """Returns the first cells of the squares near enough to some view, ascending."""
    last = (np.array(counts) - 1) // _SQUARE
    near: set[tuple[int, int]] = set()
    for view in views:
        middle = (view.pose.center[:2] - corner) / (_SQUARE * _CELL_M)
        reach = _FURTHEST_M / (_SQUARE * _CELL_M)
        low = np.maximum(np.floor(middle - reach), 0).astype(int)
        high = np.minimum(np.floor(middle + reach), last).astype(int)
        near.update(product(range(low[0], high[0] + 1), range(low[1], high[1] + 1)))
    return [(_SQUARE * east, _SQUARE * north) for east, north in sorted(near)]


def _shares(places: Floats, ground: _Ground, views: Sequence[View], known: Sequence[Mask]) -> Floats:
    """Returns which share of the photos that see (N, 2) places past buildings call them one, (H, N).

    Eq. (F24) of docs/methods/flight.md.
    """
    hits = np.zeros((len(_HEIGHTS_M), len(places)))
    looks = np.zeros_like(hits)
    floors, heights = ground.at(places), np.array(_HEIGHTS_M)
    middle, reach = places.mean(axis=0), _FURTHEST_M + _SQUARE * _CELL_M
    for view, covered in zip(views, known, strict=True):
        if np.linalg.norm(middle - view.pose.center[:2]) > reach:
            continue
        lens = view.camera.fx, view.camera.fy, view.camera.cx, view.camera.cy
        rotation, center = np.ascontiguousarray(view.pose.rotation), np.ascontiguousarray(view.pose.center)
        add_votes(
            places, floors, heights, rotation, center, lens, covered, view.mask, _FURTHEST_M, looks, hits
        )
    return np.where(looks >= _FEWEST_PHOTOS, hits / np.maximum(looks, 1), 0.0)


def _known(view: View, city_map: CityMap) -> Mask:
    """Returns the pixels that the map explains, with a margin."""
    shown = city_map.render(view.camera, view.pose).view(np.uint8)
    size = 2 * _MARGIN_PX + 1
    return np.asarray(cv2.dilate(shown, np.ones((size, size), np.uint8)) > 0)


def _grid(views: Sequence[View], ground: float) -> tuple[Floats, tuple[int, int]]:
    """Returns the corner of the ground that photos show, (2,) metres, and cells each way."""
    hits = []
    for view in views:
        rays = np.array([[u, v] for u in (0.0, 1.0) for v in (0.3, 1.0)]) * [
            view.camera.width,
            view.camera.height,
        ]
        away = (rays - [view.camera.cx, view.camera.cy]) / [view.camera.fx, view.camera.fy]
        down = np.column_stack([away, np.ones(4)]) @ view.pose.rotation
        depth = np.where(
            down[:, 2] < -1e-3, (ground - view.pose.center[2]) / np.minimum(down[:, 2], -1e-3), np.inf
        )
        reach = _FURTHEST_M / np.maximum(np.linalg.norm(down[:, :2], axis=1), 1e-6)
        # In a valley a camera may be below the city's usual ground, which is then behind it.
        hits.append(view.pose.center[:2] + down[:, :2] * np.clip(depth, 0.0, reach)[:, None])
    spots = np.concatenate(hits)
    low, high = spots.min(axis=0), spots.max(axis=0)
    count = np.maximum(np.ceil((high - low) / _CELL_M), 1).astype(int)
    return low, (int(count[0]), int(count[1]))


def _pixels(view: View, points: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns which of (N, 3) points a photo shows, and their pixels, (M, 2)."""
    local = (points - view.pose.center) @ view.pose.rotation.T
    ahead = np.flatnonzero(local[:, 2] > 1.0)
    projected = project(local[ahead], view.camera)
    inside = ((projected >= 0) & (projected < [view.camera.width, view.camera.height])).all(axis=1)
    return ahead[inside], np.floor(projected[inside]).astype(np.int64)


def _components(
    built: Cells,
    shares: Floats,
    corner: Floats,
    ground: _Ground,
    views: Sequence[View],
    known: Sequence[Mask],
    city_map: CityMap,
    pictures: Sequence[SweepPicture],
) -> list[dict[str, Any]]:
    """Returns the connected places of (N, 2) cells that are large enough."""
    changes = []
    for rows in _connected(built):
        cells = built[rows]
        area = len(cells) * _CELL_M**2
        if area < _LEAST_M2:
            continue
        middle = corner + _CELL_M * (cells.mean(axis=0) + 0.5)
        place = np.array([[*middle, float(ground.at(middle[None])[0]) + _HEIGHTS_M[0]]])
        photos, centers = [], []
        for view, covered in zip(views, known, strict=True):
            _, pixels = _pixels(view, place)
            if (
                len(pixels)
                and view.mask[pixels[0, 1], pixels[0, 0]]
                and not covered[pixels[0, 1], pixels[0, 0]]
            ):
                photos.append(view.name)
                centers.append(view.pose.center)
        apart = apart_deg(place[0], np.array(centers))
        if apart < APART_DEG:
            continue
        if not _rises(cells, shares[:2, rows], (place[0, 2] - _HEIGHTS_M[0], corner), np.array(centers)):
            continue
        height = _height(cells, shares[:, rows], corner, ground, pictures, city_map)
        if height is None:
            continue
        share = float(shares[:2, rows].mean())
        lowest = cells.min(axis=0)
        shape = np.zeros(np.ptp(cells, axis=0) + 1, dtype=bool)
        shape[tuple((cells - lowest).T)] = True
        west_south = corner + _CELL_M * lowest + city_map.scene.origin[:2]
        outline = [(ring + west_south).tolist() for ring in _outline(shape)]
        changes.append(
            {
                "kind": "unmapped",
                "outline": outline,
                "area_m2": area,
                **height,
                "share": share,
                "photos": photos,
                "apart_deg": apart,
            }
        )
    return sorted(changes, key=lambda change: -change["area_m2"])


def _height(
    cells: Cells,
    shares: Floats,
    corner: Floats,
    ground: _Ground,
    pictures: Sequence[SweepPicture],
    city_map: CityMap,
) -> dict[str, float | None] | None:
    """Returns how high cells are, as ``unmapped_buildings`` has it; None where pixels show the ground there.

    Masks bound a height alone: near the nadir what they leave free is a cone over the place. None too where
    pixels do not determine it, and the place is so small that masks do not show whether it rises.
    """
    held = np.flatnonzero(shares.max(axis=1) >= _SHARE)[-1]
    at_most_m = _HEIGHTS_M[held + 1] if held + 1 < len(_HEIGHTS_M) else None
    places = (corner + _CELL_M * _inner(cells)[:, None] + _WITHIN_M).reshape(-1, 2)
    tried_m = _TRIED_M if at_most_m is None else _TRIED_M[_TRIED_M <= at_most_m]
    curve = sweep_place(np.column_stack([places, ground.at(places)]), tried_m, pictures, city_map)
    said: dict[str, float | None] = {"height_m": None, "sigma_m": None, "at_most_m": at_most_m}
    if curve is None:
        return said
    density = density_of(curve.nats)
    if density[tried_m < _FLAT_M].sum() > 0.5:
        return None
    height_m = float(density @ tried_m)
    sigma_m = max(float(np.sqrt(density @ (tried_m - height_m) ** 2)), _BEST_M)
    if sigma_m > _OPEN_M:
        return said if len(cells) * _CELL_M**2 >= _WIDE_M2 else None
    return {**said, "height_m": height_m, "sigma_m": sigma_m}


def _inner(cells: Cells) -> Cells:
    """Returns the cells of a place with neighbours on all sides, or all if these are less than a quarter."""
    first = cells.min(axis=0) - 1
    held = np.zeros(np.ptp(cells, axis=0) + 3, dtype=np.uint8)
    held[tuple((cells - first).T)] = 1
    inner = cv2.erode(held, np.ones((3, 3), np.uint8))[tuple((cells - first).T)] > 0
    return cells[inner] if 4 * np.count_nonzero(inner) >= len(cells) else cells


def _rises(cells: Cells, shares: Floats, ground: tuple[float, Floats], centers: Floats) -> bool:
    """Returns whether cells are those of something that rises: yards and courts lie flat.

    What lies flat is called a building by fewer photos the higher it is looked for: there each camera looks
    past its far side. Of what rises the same photos say the same at both heights, shares (2, N). The ground
    is its height, and the corner of the grid; centres, (P, 3), are of the cameras that show the cells.
    """
    higher_m, (height_m, corner) = _HEIGHTS_M[1] - _HEIGHTS_M[0], ground
    lowest = cells[shares[0] >= _SHARE]
    if len(lowest) == 0:
        return False
    first = lowest.min(axis=0) - 1
    held = np.zeros(np.ptp(lowest, axis=0) + 3, dtype=bool)
    held[tuple((lowest - first).T)] = True
    places = corner + _CELL_M * (lowest + 0.5)
    stays = []
    for center in centers:
        away = higher_m * (places - center[:2]) / max(center[2] - height_m, 1.0)
        beyond = np.floor((places + away - corner) / _CELL_M).astype(np.int64) - first
        beyond = np.clip(beyond, 0, np.array(held.shape) - 1)
        stays.append(held[tuple(beyond.T)].mean())
    here = shares[:, shares[0] >= _SHARE].mean(axis=1)
    return bool(here[1] / here[0] > 0.5 * (1.0 + float(np.mean(stays))))


def _connected(cells: Cells) -> list[NDArray[np.int64]]:
    """Returns the rows of (N, 2) cells that hang together by their sides, group by group."""
    if len(cells) == 0:
        return []
    width = int(cells[:, 1].max()) + 2
    keys = cells[:, 0] * width + cells[:, 1]
    order = np.argsort(keys)
    pairs = []
    for step in (1, width):
        place = np.minimum(np.searchsorted(keys[order], keys + step), len(keys) - 1)
        is_there = keys[order[place]] == keys + step
        pairs.append(np.stack([np.flatnonzero(is_there), order[place[is_there]]]))
    first, second = np.concatenate(pairs, axis=1)
    graph = scipy.sparse.coo_matrix((np.ones(len(first)), (first, second)), (len(keys), len(keys)))
    count, labels = scipy.sparse.csgraph.connected_components(graph, directed=False)
    return [np.flatnonzero(labels == label) for label in range(count)]


def _outline(cells: Mask) -> list[Floats]:
    """Returns the rings around cells, (N, 2) metres from the grid's corner, closed."""
    # Twice as fine and one cell wider, so that outlines run along cells' edges and not through their middles.
    fine = np.kron(np.pad(cells, 1), np.ones((4, 4), np.uint8)).astype(np.uint8)
    rings, _ = cv2.findContours(fine, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    closed = []
    for ring in rings:
        # OpenCV's x runs along the second axis: north here.
        points = (ring[:, 0, ::-1].astype(np.float64) + 0.5) / 4.0 - 1.0
        closed.append(np.vstack([points, points[:1]]) * _CELL_M)
    return closed
