"""Buildings that are drawn as blocks, and have pitched roofs, as their source tells.

A block ends above the eaves that it stands for, and its edge is nearer to the camera than a ridge: what is
seen of the roof ends lower (docs/adr/0012, point 5).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.raw import take_segments
from lodbench.citymodel.scene import Scene

# What is no wall rises by a share of its length, and what is level by nearly all of it; less is rounding.
_LEAST_RISE, _LEVEL = 0.15, 0.999
# The share of a block's roof that may slant: chimneys.
_SLANTED_SHARE = 0.05


def pitched_blocks(scene: Scene) -> NDArray[np.bool_]:
    """Returns (B,) which buildings of a scene are blocks, where the source tells of pitched roofs.

    Roofs are the faces above half a building's height that are no walls: floors may follow the ground.
    """
    if scene.pitched is None:
        return np.zeros(scene.num_buildings, np.bool_)
    told = np.flatnonzero(scene.pitched & (np.diff(scene.triangle_starts) > 0))
    faces, _ = take_segments(scene.triangle_starts, told)
    owner = np.repeat(np.arange(len(told)), np.diff(scene.triangle_starts)[told])
    corners = scene.vertices[scene.triangles[faces]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas, rises = np.linalg.norm(normals, axis=1), np.abs(normals[:, 2])
    lowest, highest = corners[..., 2].min(axis=1), corners[..., 2].max(axis=1)
    low, high = np.full(len(told), np.inf), np.full(len(told), -np.inf)
    np.minimum.at(low, owner, lowest)
    np.maximum.at(high, owner, highest)
    is_roof = (rises > _LEAST_RISE * areas) & (lowest + highest > (low + high)[owner])
    covered, slanted = (
        np.bincount(owner, weights=areas * chosen, minlength=len(told))
        for chosen in (is_roof, is_roof & (rises < _LEVEL * areas))
    )
    blocks = np.zeros(scene.num_buildings, np.bool_)
    blocks[told] = slanted <= _SLANTED_SHARE * covered
    return blocks
