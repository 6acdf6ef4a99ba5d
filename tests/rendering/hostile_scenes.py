"""Scenes made to break a rasteriser, cameras put where they hurt, masks of boxes, and hits by brute force."""

from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st

from lodbench.citymodel.scene import Scene, build_scene
from lodbench.geometry import Camera, EulerAngles, Pose, rotation_from_euler
from lodbench.kernels.arguments import NEAR_M
from lodbench.rendering.masks import pack_mask

# Corners of a unit box (x, y, z in bits 2, 1, 0); its faces, outward, the floor first.
_CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
_QUADS = [(0, 2, 6, 4), (1, 5, 7, 3), (0, 4, 5, 1), (2, 3, 7, 6), (0, 1, 3, 2), (4, 6, 7, 5)]
_BOX = np.array([t for a, b, c, d in _QUADS for t in ((a, b, c), (a, c, d))])


def box(low, size, *, floor: bool = True):
    """Returns (12 or 10, 3, 3) outward triangles of an upright box."""
    corners = np.asarray(low, dtype=np.float64) + np.asarray(size, dtype=np.float64) * _CORNERS
    return corners[_BOX if floor else _BOX[2:]]


def scene_of(*buildings) -> Scene:
    """Returns a scene of buildings given as (T, 3, 3) triangles."""
    soup = np.concatenate(buildings).reshape(-1, 3)
    owner = np.repeat(np.arange(len(buildings)), [len(b) for b in buildings])
    names = tuple(f"b{i}" for i in range(len(buildings)))
    return build_scene(soup, np.arange(len(soup)).reshape(-1, 3), owner.astype(np.int32), names)


def _soup(rng):
    return rng.uniform(-40, 40, (rng.integers(1, 20), 3, 3))


def _slivers(rng):
    start, direction = rng.uniform(-60, 60, (8, 1, 3)), rng.uniform(-1, 1, (8, 1, 3))
    along = rng.uniform(-80, 80, (8, 3, 1))
    return start + along * direction + rng.normal(0, 10.0 ** rng.integers(-7, -1), (8, 3, 3))


def _huge(rng):
    return rng.uniform(-1, 1, (6, 3, 3)) * 10.0 ** rng.integers(2, 10, (6, 1, 1))


def _collinear(rng):
    start, step = rng.uniform(-30, 30, (5, 1, 3)), rng.integers(-4, 5, (5, 1, 3))
    return start + np.array([0.0, 1.0, 2.0])[:, None] * step


def _doubled(rng):
    triangles = _soup(rng)
    return np.concatenate([triangles, triangles, triangles[:, ::-1]])


def _book(rng):
    """Pages that share a spine: an edge of many triangles, turned either way."""
    spine = rng.uniform(-30, 30, (1, 2, 3))
    pages = np.concatenate([np.repeat(spine, 7, axis=0), rng.uniform(-30, 30, (7, 1, 3))], axis=1)
    return np.array([page[rng.permutation(3)] for page in pages])


def _closed_box(rng):
    return box(rng.uniform(-40, 20, 3), rng.uniform(1, 40, 3))


def _open_box(rng):
    return box(rng.uniform(-40, 20, 3), rng.uniform(1, 40, 3), floor=False)


def _muddled_box(rng):
    triangles = _closed_box(rng)[rng.permutation(12)[: rng.integers(1, 13)]]
    return np.array([t[rng.permutation(3)] for t in triangles])


def _whole_metres(rng):
    """Corners whose projections meet pixel centres and edges exactly, seen from straight above."""
    return rng.integers(-20, 21, (12, 3, 3)) * np.array([0.5, 0.5, 0.0]) + [0, 0, rng.integers(0, 3)]


KINDS = (
    _soup,
    _slivers,
    _huge,
    _collinear,
    _doubled,
    _book,
    _closed_box,
    _open_box,
    _muddled_box,
    _whole_metres,
)

SIZES = [(1, 1), (1, 40), (63, 9), (64, 31), (65, 1), (127, 40), (128, 3), (129, 20), (301, 24), (602, 11)]


@st.composite
def hostile_scenes(draw) -> Scene:
    """Draws one to four buildings of any kind."""
    seed = draw(st.integers(0, 2**32 - 1))
    kinds = draw(st.lists(st.sampled_from(KINDS), min_size=1, max_size=4))
    rng = np.random.default_rng(seed)
    while True:
        buildings = [kind(rng) for kind in kinds]
        # A soup of collinear points may lose every triangle by the merge of equal points.
        if any((np.diff(b.astype(np.float32), axis=1) != 0).any(axis=2).all() for b in buildings):
            return scene_of(*buildings)


@st.composite
def hostile_views(draw) -> tuple[Camera, Pose]:
    """Draws a camera of an awkward size, and a pose above, among, inside or below the buildings."""
    width, height = draw(st.sampled_from(SIZES))
    focal = draw(st.sampled_from([0.5, 40.0, 97.3, 430.8]))
    off_axis = draw(st.sampled_from([0.0, 0.013, -0.4]))
    camera = Camera(width, height, focal, focal * 0.99, width * (0.5 + off_axis), height * (0.5 - off_axis))
    if draw(st.booleans()):
        return Camera(width, height, 40.0, 40.0, width / 2, height / 2), straight_down(40.0)
    angles = EulerAngles(draw(st.floats(-10, 190)), draw(st.floats(-89, 89)), draw(st.floats(-180, 180)))
    target = np.array(draw(st.tuples(*[st.floats(-30, 30, width=32)] * 3)))
    distance = draw(st.sampled_from([-5.0, 0.0, 0.1, 8.0, 60.0, 60.0, 150.0, 150.0]))
    rotation = rotation_from_euler(angles)
    return camera, Pose.from_center(rotation, target - distance * rotation[2])


def straight_down(height_m: float) -> Pose:
    """Returns a camera over the origin with north up: x right is east, y down is south, no rounding."""
    return Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, height_m]))


def part_of(scene: Scene, buildings) -> Scene:
    """Returns the scene of some of the buildings, ascending."""
    points, triangles, v_starts, t_starts = [], [], [0], [0]
    for b in buildings:
        v0, v1 = scene.vertex_starts[b : b + 2]
        t0, t1 = scene.triangle_starts[b : b + 2]
        points.append(scene.vertices[v0:v1])
        triangles.append(scene.triangles[t0:t1] - v0 + v_starts[-1])
        v_starts.append(v_starts[-1] + v1 - v0)
        t_starts.append(t_starts[-1] + t1 - t0)
    return Scene(
        np.concatenate(points),
        np.concatenate(triangles).astype(np.int32),
        np.array(v_starts, dtype=np.int64),
        np.array(t_starts, dtype=np.int64),
        tuple(scene.building_ids[b] for b in buildings),
        scene.lod,
        scene.crs,
        scene.origin,
    )


def blobs(rng, width, height, count):
    """Returns masks of a few boxes each, some empty, some full."""
    masks = np.zeros((count, height, width), dtype=bool)
    for n in range(count):
        for _ in range(n % 4):
            left, right = np.sort(rng.integers(0, width + 1, 2))
            top, bottom = np.sort(rng.integers(0, height + 1, 2))
            masks[n, top:bottom, left:right] ^= True
    masks[-1] = True
    return masks


def packed(masks):
    """Returns masks as the engine has them."""
    return np.stack([pack_mask(mask) for mask in masks])


# Hits nearer to an edge than this share of the triangle, or to the next hit than this share of the
# depth, are not decided here.
_MARGIN = 1e-2


@dataclass
class Hits:
    """Depth (H, W) metres, triangle (H, W), and where both are beyond doubt."""

    depth: np.ndarray
    triangle: np.ndarray
    is_sure: np.ndarray


def cast_rays(scene: Scene, camera: Camera, pose: Pose) -> Hits:
    """Returns the nearest hit of the ray through each pixel's centre."""
    corners = (scene.vertices.astype(np.float64) - pose.center)[scene.triangles] @ pose.rotation.T
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    rays = np.stack([*np.broadcast_arrays(x[None, :], y[:, None]), np.ones((len(y), len(x)))], axis=2)
    depth = np.full((len(corners), len(y), len(x)), np.inf)
    doubt = np.zeros((len(y), len(x)), dtype=bool)
    for t, (a, b, c) in enumerate(corners):
        # weights @ corners = depth * ray, so the weights of (ray / depth) sum to 1 / depth.
        matrix = np.array([a, b, c]).T
        if abs(np.linalg.det(matrix)) < 1e-9:
            doubt[:] = True
            continue
        weights = rays @ np.linalg.inv(matrix).T
        total = weights.sum(axis=2)
        share = (weights / np.where(total == 0, 1, total)[..., None]).min(axis=2)
        z = 1 / np.where(total == 0, 1e-12, total)
        depth[t] = np.where((share > 0) & (z > NEAR_M), z, np.inf)
        doubt |= (np.abs(share) < _MARGIN) & (z > 0)
    ordered = np.sort(depth, axis=0)
    hit = np.isfinite(ordered[0])
    gap = ordered[1] - np.where(hit, ordered[0], 0)
    is_sure = ~doubt & hit & (gap > _MARGIN * np.where(hit, ordered[0], 0)) & (ordered[0] > 1.01 * NEAR_M)
    return Hits(ordered[0], depth.argmin(axis=0), is_sure)
