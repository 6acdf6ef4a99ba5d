"""Heights of roofs from pixels: at its true height a roof looks the same in all photos that show it.

A sweep through space (Collins, "A space-sweep approach to true multi-image matching", CVPR 1996) with the
map's own roofs for planes: each is moved up and down, and photos are compared where it would be seen. A roof
among others, which draws no outline in any mask, has a height this way too. Where it ends says more
(``roof_edges``). Footprints without heights are swept from the ground up, then finely: the first sweep hides
nothing behind other buildings, the later ones draw each as high as the sweep before found it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymap.city_map import corrected_map
from lodbench.citymodel.scene import Scene, building_boxes, floors_and_rises
from lodbench.datasets.query import Query
from lodbench.methods.flight.roof_edges import EdgeEvidence, SweepPicture, edge_evidence, open_pictures

Floats = NDArray[np.float64]

# Faces steeper than this are walls: the upward part of their unit normal.
_FLAT = 0.3
# A roof has so many points at most, no closer than this, metres; so many triangles are looked at at once.
_MOST_POINTS, _SPACING_M, _TRIANGLES = 144, 0.4, 2048
# The same along its edges; shorter ones are left out.
_MOST_OF_EDGES, _APART_M, _SHORTEST_M = 160, 0.5, 0.3
# Corners are the same within this, metres. Two faces are one whose normals' mean is longer than that.
_CORNER_M, _ONE_FACE = 0.01, 0.992
# What lies lower than this share of a building's height is its floor.
_FLOOR = 0.1


def roof_points(triangles: Floats) -> Floats:
    """Returns points of the upper side of a building on a grid, and their share of its height, (N, 4).

    A building that is higher is so as a whole: its eaves rise less than its ridge. Triangles are (T, 3, 3).
    """
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    flat = triangles[np.abs(normals[:, 2]) > _FLAT * np.linalg.norm(normals, axis=1)]
    if len(flat) == 0:
        return np.zeros((0, 4))
    low, high = flat[..., :2].min(axis=(0, 1)), flat[..., :2].max(axis=(0, 1))
    step = max(_SPACING_M, math.sqrt(float(np.prod(high - low)) / _MOST_POINTS))
    sides = [np.arange(a + 0.5 * step, b, step) for a, b in zip(low, high, strict=True)]
    places = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 1, 2)
    heights = np.full(len(places), -np.inf)
    for first in range(0, len(flat), _TRIANGLES):
        heights = np.maximum(heights, _heights_over(flat[first : first + _TRIANGLES], places))
    floor, top = triangles[..., 2].min(), triangles[..., 2].max()
    points = np.column_stack([places[:, 0], heights, (heights - floor) / max(top - floor, 1e-6)])
    return np.asarray(points[np.isfinite(heights)])


def _heights_over(triangles: Floats, places: Floats) -> Floats:
    """Returns (N,) the greatest height of (T, 3, 3) triangles over (N, 1, 2) places, -inf over none."""
    a, b, c = (triangles[:, k] for k in range(3))
    ab, ac, ap = (b - a)[:, :2], (c - a)[:, :2], places - a[:, :2]
    whole = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    along_b = (ap[..., 0] * ac[:, 1] - ap[..., 1] * ac[:, 0]) / whole
    along_c = (ab[:, 0] * ap[..., 1] - ab[:, 1] * ap[..., 0]) / whole
    inside = (along_b >= 0) & (along_c >= 0) & (along_b + along_c <= 1)
    heights = a[:, 2] + along_b * (b - a)[:, 2] + along_c * (c - a)[:, 2]
    return np.asarray(np.where(inside, heights, -np.inf).max(axis=1))


def edge_points(triangles: Floats) -> Floats:
    """Returns points of the edges of a building's upper side, their share of its height, and directions.

    Triangles are (T, 3, 3) metres; returned are (N, 7): places, shares, unit vectors along the edge.
    """
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    is_flat = np.abs(normals[:, 2]) > _FLAT * lengths
    flat, upward = triangles[is_flat], normals[is_flat] / np.maximum(lengths[is_flat], 1e-12)[:, None]
    if len(flat) == 0:
        return np.zeros((0, 7))
    upward *= np.sign(upward[:, 2:])
    floor, top = triangles[..., 2].min(), triangles[..., 2].max()
    edges = flat[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2, 3)
    keys = np.rint(edges / _CORNER_M).astype(np.int64)
    # The same edge of two faces runs either way.
    swapped = (keys[:, 0] > keys[:, 1])[np.arange(len(keys)), (keys[:, 0] != keys[:, 1]).argmax(axis=1)]
    keys[swapped] = keys[swapped, ::-1]
    _, first, group, counts = np.unique(
        keys.reshape(-1, 6), axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    means = np.zeros((len(first), 3))
    np.add.at(means, group.ravel(), np.repeat(upward, 3, axis=0))
    is_edge = (counts == 1) | (np.linalg.norm(means, axis=1) < _ONE_FACE * counts)
    start, end = edges[first[is_edge]].swapaxes(0, 1)
    run_m = np.linalg.norm(end - start, axis=1)
    shares = (0.5 * (start + end)[:, 2] - floor) / max(top - floor, 1e-6)
    kept = (run_m > _SHORTEST_M) & (shares > _FLOOR)
    return _sampled(start[kept], end[kept], run_m[kept], floor, top)


def _sampled(start: Floats, end: Floats, run_m: Floats, floor: float, top: float) -> Floats:
    step_m = max(_APART_M, float(run_m.sum()) / _MOST_OF_EDGES)
    counts = np.maximum(1, run_m / step_m).astype(np.int64)
    edge = np.repeat(np.arange(len(counts)), counts)
    along = (np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts) + 0.5) / counts[edge]
    places = start[edge] + along[:, None] * (end - start)[edge]
    shares = (places[:, 2] - floor) / max(top - floor, 1e-6)
    return np.column_stack([places, shares, ((end - start) / np.maximum(run_m, 1e-9)[:, None])[edge]])


# By how much higher than in the map a roof may be, metres.
HEIGHTS_M: Floats = np.arange(-8.0, 8.01, 0.25)
# A roof that has fewer points than this is not looked at.
_FEWEST_POINTS = 6
# Photos of one roof, fewest and most, which is a share of its points, and how large a pixel is there, metres.
_FEWEST_PHOTOS, _MOST_PHOTOS, _SHARE, _COARSEST_M = 3, 16, 0.15, 1.5
# Edges are seen in one photo by itself, but by chance as well.
_FEWEST_OF_EDGES = 2
# Where a building is looked for in a photo: the middle of its box's top, and the corners.
_TOP = np.array([[0.5, 0.5, 1.0], [0, 0, 1], [0, 1, 1], [1, 0, 1], [1, 1, 1]])
# What stands before a point by more than this hides it, metres.
_BEFORE_M = 1.0
# Colours are compared as L, a, b of 8 bits with these weights, differences no larger than this count; a point
# outside the mask counts as a difference of so much.
_WEIGHTS, _MOST_APART, _OFF_MASK = np.array([1.0, 2.0, 2.0], np.float32), 60.0, 30.0
# Pixels of one roof err together: N say as much as _ALONE * sqrt(N) of them, and no more than so many do.
# What photos are compared with, their median, takes so many of them away.
_ALONE, _MOST_PIXELS, _OF_MEDIAN = 0.7, 2000, 2.0
# A photo's exposure is estimated from no fewer points.
_FEWEST_OF_PHOTO = 100


class RoofCurve(NamedTuple):
    """What photos say of one roof's height."""

    nats: Floats  # (H,) how well each height of ``HEIGHTS_M`` explains them
    photos: int  # how many were compared


# A photo, and which points of a roof it shows, (N,).
_Shown: TypeAlias = tuple[SweepPicture, NDArray[np.bool_]]


def sweep_roofs(
    pictures: Sequence[SweepPicture], city_map: CityMap, heights_m: Floats = HEIGHTS_M
) -> dict[int, RoofCurve]:
    """Returns how well heights explain the photos, by row of the building.

    Heights are against the map, as poses have it: what all are wrong about alike is in all of them. Buildings
    that fewer than three photos show are left out, and all where there are no photos.

    Args:
        pictures: The photos, where they were found to be taken; their exposures are made alike, in place.
        city_map: The map.
        heights_m: (H,) ascending, by how much higher than in the map a roof may be.
    """
    if len(pictures) < _FEWEST_PHOTOS:
        return {}
    near = _near(city_map.scene, pictures)
    rows, counts = np.unique(np.concatenate(near), return_counts=True)
    roofs = _roofs(city_map.scene, rows[counts >= _FEWEST_PHOTOS])
    roof_photos = _roof_photos(pictures, near, roofs, city_map, heights_m)
    edges = _edge_evidence(pictures, near, city_map, heights_m)
    _take_exposures_away(roofs, roof_photos)
    curves = {row: _curve(roofs[row], photos, heights_m) for row, photos in roof_photos.items()}
    return {
        row: curve for row in {**edges, **curves} if (curve := _together(curves.get(row), edges.get(row)))
    }


def sweep_place(
    points: Floats, heights_m: Floats, pictures: Sequence[SweepPicture], city_map: CityMap
) -> RoofCurve | None:
    """Returns how well heights of something flat explain the photos; None where too few show it.

    Points, (N, 3), are of the ground below it, heights, (H,), above that; pictures as ``sweep_roofs`` leaves
    them.
    """
    rising = np.column_stack([points, np.ones(len(points))])
    candidates = [(picture, _sees(picture, points, city_map, heights_m)) for picture in pictures]
    photos = [shown for shown in candidates if shown[1].mean() >= _SHARE]
    if len(photos) < _FEWEST_PHOTOS:
        return None
    return _curve(rising, photos if len(photos) <= _MOST_PHOTOS else _best(rising, photos), heights_m)


def _together(curve: RoofCurve | None, edges: EdgeEvidence | None) -> RoofCurve | None:
    """Returns what a roof's colours and edges say; None where neither says anything."""
    if edges is None:
        return curve
    colours = RoofCurve(np.zeros(len(edges.logs)), 0) if curve is None else curve
    return RoofCurve(colours.nats + edges.log_likelihoods(), max(colours.photos, edges.photos))


def _edge_evidence(
    pictures: Sequence[SweepPicture], near: Sequence[NDArray[np.int64]], city_map: CityMap, heights_m: Floats
) -> dict[int, EdgeEvidence]:
    """Returns what edges of roofs say, by row of the building."""
    rows, counts = np.unique(np.concatenate(near), return_counts=True)
    edges = {
        row: points
        for row in rows[counts >= _FEWEST_OF_EDGES].tolist()
        if len(points := edge_points(_triangles(city_map.scene, row))) >= _FEWEST_POINTS
    }
    shown, visible_of = [], []
    for picture, of_photo in zip(pictures, near, strict=True):
        rows = np.array([row for row in of_photo.tolist() if row in edges], dtype=np.int64)
        points = np.concatenate([edges[row][:, :3] for row in rows.tolist()] or [np.zeros((0, 3))])
        is_visible = _sees(picture, points, city_map, heights_m)
        owner = np.repeat(np.arange(len(rows)), [len(edges[row]) for row in rows.tolist()])
        shares = np.bincount(owner, is_visible, len(rows)) / np.maximum(
            np.bincount(owner, minlength=len(rows)), 1
        )
        shown.append(rows)
        visible_of.append(is_visible & (shares >= _SHARE)[owner])
    by_row = edge_evidence(pictures, shown, edges, visible_of, heights_m)
    return {row: evidence for row, evidence in by_row.items() if evidence.photos >= _FEWEST_OF_EDGES}


def _near(scene: Scene, pictures: Sequence[SweepPicture]) -> list[NDArray[np.int64]]:
    """Returns by photo the rows of the buildings whose roofs it may show, ascending."""
    low, high, building = building_boxes(scene)
    points = low[:, None] + _TOP * (high - low)[:, None]
    tree, near = scipy.spatial.cKDTree(points[:, 0]), []
    for picture in pictures:
        reach_m = _COARSEST_M * picture.camera.fx
        nearby = np.array(sorted(tree.query_ball_point(picture.pose.center, reach_m)), dtype=np.int64)
        is_held = picture.holds(*picture.project(points[nearby])).any(axis=1)
        near.append(building[nearby[is_held]])
    return near


def _roofs(scene: Scene, buildings: NDArray[np.int64]) -> dict[int, Floats]:
    """Returns points of roofs, see ``roof_points``, by row of the building; walls alone have none."""
    roofs = {}
    for row in buildings.tolist():
        points = roof_points(_triangles(scene, row))
        if len(points) >= _FEWEST_POINTS:
            roofs[row] = points
    return roofs


def _triangles(scene: Scene, row: int) -> Floats:
    faces = slice(scene.triangle_starts[row], scene.triangle_starts[row + 1])
    return np.asarray(scene.vertices[scene.triangles[faces]], dtype=np.float64)


def _roof_photos(
    pictures: Sequence[SweepPicture],
    near: Sequence[NDArray[np.int64]],
    roofs: Mapping[int, Floats],
    city_map: CityMap,
    heights_m: Floats,
) -> dict[int, list[_Shown]]:
    """Returns by building the photos that show its roof best, and which of its points."""
    roof_photos: dict[int, list[_Shown]] = {row: [] for row in roofs}
    for picture, of_photo in zip(pictures, near, strict=True):
        rows = [row for row in of_photo.tolist() if row in roofs]
        if not rows:
            continue
        points, ends = np.concatenate([roofs[row] for row in rows]), np.cumsum([len(roofs[r]) for r in rows])
        visible_of = np.split(_sees(picture, points[:, :3], city_map, heights_m), ends[:-1])
        for row, is_visible in zip(rows, visible_of, strict=True):
            if is_visible.mean() >= _SHARE:
                roof_photos[row].append((picture, is_visible.copy()))
    return {
        row: photos if len(photos) <= _MOST_PHOTOS else _best(roofs[row], photos)
        for row, photos in roof_photos.items()
        if len(photos) >= _FEWEST_PHOTOS
    }


def _best(points: Floats, photos: Sequence[_Shown]) -> list[_Shown]:
    return sorted(photos, key=lambda photo: -_pixels_of(points, [photo]))[:_MOST_PHOTOS]


def _sees(picture: SweepPicture, points: Floats, city_map: CityMap, heights_m: Floats) -> NDArray[np.bool_]:
    """Returns which of (N, 3) points of the map a photo shows, at every height they may have."""
    pixels, depths = picture.project(points)
    is_visible = picture.holds(pixels, depths) & (depths < _COARSEST_M * picture.camera.fx)
    for end_m in (heights_m[0], heights_m[-1]):
        is_visible &= picture.holds(*picture.project(points + np.array([0.0, 0.0, end_m])))
    turn, center = picture.pose.rotation[None], picture.pose.center[None]
    # The map is drawn through a pinhole.
    straight = picture.project(points[is_visible], 0.0)[0].astype(np.int64)
    column, line = np.clip(straight, 0, [picture.camera.width - 1, picture.camera.height - 1]).T
    before = city_map.depth(picture.camera, turn, center)[0][line, column]
    is_visible[is_visible] = (before == 0) | (before > depths[is_visible] - _BEFORE_M)
    return is_visible


def _take_exposures_away(roofs: Mapping[int, Floats], roof_photos: Mapping[int, Sequence[_Shown]]) -> None:
    """Shifts each photo's colours by what all roofs, as the map has them, differ by from other photos."""
    apart: dict[SweepPicture, list[NDArray[np.float32]]] = {}
    for row, photos in roof_photos.items():
        colours, counts = _colours(roofs[row], photos, np.zeros(1))
        away = (colours[..., :3] - _medians(colours[..., :3], counts))[:, 0]
        for (picture, _), of_photo in zip(photos, away, strict=True):
            apart.setdefault(picture, []).append(of_photo[np.isfinite(of_photo[:, 0])])
    for picture, differences in apart.items():
        together = np.concatenate(differences)
        if len(together) >= _FEWEST_OF_PHOTO:
            picture.shift_colours(-np.median(together, axis=0))


def _curve(points: Floats, photos: Sequence[_Shown], heights_m: Floats) -> RoofCurve | None:
    """Returns how well heights of a roof explain its photos; None where too little is visible often enough.

    Eq. (F21) of docs/methods/flight.md; (N, 4) points with their share of the building's height.
    """
    colours, counts = _colours(points, photos, heights_m)
    if len(counts) < _FEWEST_POINTS:
        return None
    apart = np.abs(colours[..., :3] - _medians(colours[..., :3], counts)) @ _WEIGHTS
    differences = np.minimum(apart, _MOST_APART) + _OFF_MASK * (1.0 - colours[..., 3] / 255.0)
    mean = np.nanmean(differences, axis=(0, 2), dtype=np.float64)
    independent = _ALONE * math.sqrt(min(_pixels_of(points, photos), _MOST_PIXELS))
    # Few photos are near their own median wherever a roof is.
    independent *= 1.0 - _OF_MEDIAN / len(photos)
    return RoofCurve(-independent * np.log(np.maximum(mean, 1.0)), len(photos))


def _pixels_of(points: Floats, photos: Sequence[_Shown]) -> float:
    """Returns how many pixels of all photos show a roof's points; two points in a pixel are one."""
    spacing_m = float(np.median(scipy.spatial.cKDTree(points[:, :2]).query(points[:, :2], k=2)[0][:, 1]))
    total = 0.0
    for picture, is_seen in photos:
        away = points[is_seen, :3].mean(axis=0) - picture.pose.center
        distance_m = float(np.linalg.norm(away))
        # A level square metre is as much smaller as it is seen at an angle.
        per_m2 = (picture.camera.fx / distance_m) ** 2 * abs(away[2]) / distance_m
        total += np.count_nonzero(is_seen) * min(1.0, per_m2 * spacing_m**2)
    return total


def _colours(
    points: Floats, photos: Sequence[_Shown], heights_m: Floats
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Returns colours and mask (P, H, M, 4) of the points that three photos show, nan where one does not.

    With them by how many photos each is shown, (M,).
    """
    colours = np.full((len(photos), len(heights_m), len(points), 4), np.nan, np.float32)
    counts = np.zeros(len(points), np.int64)
    for of_photo, (picture, is_seen) in zip(colours, photos, strict=True):
        raised = points[is_seen, :3] + heights_m[:, None, None] * points[is_seen, 3:] * [0.0, 0.0, 1.0]
        pixels = (picture.project(raised)[0] - 0.5).astype(np.float32)
        of_photo[:, is_seen] = cv2.remap(picture.pixels, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR)
        counts += is_seen
    often = counts >= _FEWEST_PHOTOS
    return colours[:, :, often], counts[often]


def _medians(colours: NDArray[np.float32], counts: NDArray[np.int64]) -> NDArray[np.float32]:
    """Returns the medians over photos, (H, N, C), of those that are finite: so many of each point."""
    in_order, points = np.sort(colours, axis=0), np.arange(len(counts))
    low, high = ((counts - step) // 2 for step in (1, 0))
    return 0.5 * (in_order[low, :, points] + in_order[high, :, points]).swapaxes(0, 1)


# Blocks are this high before anything is known: the least that a map is drawn with, metres.
_LOWEST_M = 2.0
# The first sweep ends here, or lower for roofs that would leave the photos; its step, metres.
_HIGHEST_M, _STEP_M = (60.0, 30.0, 15.0), 0.5
_FINE_SWEEPS = 2
# A first height counts whose neighbourhood, metres, holds so much of the probability.
_NEIGHBOURHOOD_M, _LEAST_SHARE = 4.0, 0.9
# A peak is so wide, metres; standard deviations are not below the first, heights known worse than the second
# are not known.
_PEAK_M, _BEST_SIGMA_M, _WORST_SIGMA_M = 1.0, 0.2, 1.5


class SweptHeight(NamedTuple):
    """The height of a building above its floor, metres, its standard deviation, and photos compared."""

    height_m: float
    sigma_m: float
    photos: int


def footprint_heights(queries: Sequence[Query], scene: Scene) -> dict[int, SweptHeight]:
    """Returns the heights of the blocks that photos measure, by row of the scene.

    Left out are buildings that fewer than three photos show, whose heights remain ambiguous, or whose
    standard deviation is above 1.5 m. Errors that all photos share (scale, common height) are not part of the
    deviations. Eq. (F21), (F22) of docs/methods/flight.md.

    Args:
        queries: The photos, with their poses as priors (scene frame).
        scene: Blocks of level 1 on the right ground; how high they are does not count.
    """
    rises = floors_and_rises(scene)[1]
    poses = [query.prior for query in queries]
    city_map = CityMap(scene)
    flat_map = corrected_map(city_map, _LOWEST_M - rises, 0.0)[0]
    heights: dict[int, SweptHeight] = {}
    for highest_m in _HIGHEST_M:
        rising = np.arange(0.0, highest_m - _LOWEST_M + 0.1, _STEP_M)
        curves = sweep_roofs(open_pictures(queries, poses, np.zeros(2)), flat_map, rising)
        for row, curve in curves.items():
            if row not in heights and _share_at_peak(curve, rising) >= _LEAST_SHARE:
                heights[row] = _swept(curve, _LOWEST_M + rising)
        if len(heights) == np.count_nonzero(rises > 0):
            break
    for _ in range(_FINE_SWEEPS):
        drawn_m = np.full(len(rises), _LOWEST_M)
        for row, height in heights.items():
            drawn_m[row] = max(height.height_m, _LOWEST_M)
        drawn = corrected_map(city_map, drawn_m - rises, 0.0)[0]
        curves = sweep_roofs(open_pictures(queries, poses, np.zeros(2)), drawn)
        heights = {
            row: _swept(curve, drawn_m[row] + HEIGHTS_M) for row, curve in curves.items() if row in heights
        }
    return {row: height for row, height in heights.items() if height.sigma_m <= _WORST_SIGMA_M}


def _density(curve: RoofCurve, heights_m: Floats) -> Floats:
    return density_of(np.where(heights_m >= _LOWEST_M, curve.nats, -np.inf))


def density_of(nats: Floats) -> Floats:
    """Returns the shares of heights that explain photos so well; their sum is 1."""
    shares = np.exp(nats - nats.max())
    return np.asarray(shares / shares.sum())


def peak_of(shares: Floats, heights_m: Floats) -> tuple[float, float]:
    """Returns the mean of a density's peak, and the deviation of the whole density from that, metres."""
    is_peak = np.abs(heights_m - heights_m[np.argmax(shares)]) <= _PEAK_M
    best = float(shares[is_peak] @ heights_m[is_peak] / shares[is_peak].sum())
    return best, max(float(np.sqrt(shares @ (heights_m - best) ** 2)), _BEST_SIGMA_M)


def _share_at_peak(curve: RoofCurve, rising_m: Floats) -> float:
    shares = _density(curve, rising_m + _LOWEST_M)
    return float(shares[np.abs(rising_m - rising_m[np.argmax(shares)]) <= _NEIGHBOURHOOD_M].sum())


def _swept(curve: RoofCurve, heights_m: Floats) -> SweptHeight:
    return SweptHeight(*peak_of(_density(curve, heights_m), heights_m), curve.photos)
