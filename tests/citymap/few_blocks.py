"""A few blocks, and poses that look at them."""

import numpy as np

from lodbench.citymodel.scene import Scene, build_scene
from lodbench.geometry import Camera, EulerAngles, rotation_from_euler

CAMERA = Camera(121, 90, 95.0, 97.0, 60.2, 44.1)
# West, south, east, north, base, top, metres.
_BLOCKS = (
    (-40, -30, -12, -8, 0, 14),
    (-6, -22, 16, 2, 0, 31),
    (22, -15, 45, 30, 2, 9),
    (-35, 6, -8, 34, 0, 20),
)
# A block's corners count x, y, z in binary; no floor, walls and roof run outwards.
_FACES = ((0, 4, 5, 1), (2, 3, 7, 6), (0, 1, 3, 2), (4, 6, 7, 5), (1, 5, 7, 3))


def blocks_scene(blocks=_BLOCKS) -> Scene:
    """Returns upright blocks, one building each."""
    corners = [(x, y, z) for w, s, e, n, b, t in blocks for x in (w, e) for y in (s, n) for z in (b, t)]
    faces = np.concatenate([8 * k + np.array(_FACES) for k in range(len(blocks))])
    building = np.repeat(np.arange(len(blocks), dtype=np.int32), 2 * len(_FACES))
    names = tuple(f"block {k}" for k in range(len(blocks)))
    points = np.array(corners, dtype=np.float64)
    return build_scene(points, faces[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3), building, names)


def poses_around(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Returns (N, 3, 3) rotations and (N, 3) centres of views that see some of the blocks."""
    rng = np.random.default_rng(seed)
    angles = [EulerAngles(*rng.uniform((0, -5, -180), (45, 5, 180))) for _ in range(count)]
    rotations = np.array([rotation_from_euler(angle) for angle in angles])
    ahead = rotations[:, 2]
    targets = rng.uniform((-25, -20, 0), (25, 20, 10), (count, 3))
    return rotations, targets - ahead * rng.uniform(60, 120, (count, 1))
