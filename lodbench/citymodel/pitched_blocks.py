"""Buildings that are drawn as blocks, and have pitched roofs, as their source tells.

A block ends above the eaves that it stands for, and its edge is nearer to the camera than a ridge: what is
seen of the roof ends lower (docs/adr/0067).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene

# What is no wall rises by a share of its length, and what is level by nearly all of it; less is rounding.
_LEAST_RISE, _LEVEL = 0.15, 0.999
# The share of a block's roof and floor that may slant: chimneys.
_SLANTED_SHARE = 0.05


def pitched_blocks(scene: Scene) -> NDArray[np.bool_]:
    """Returns (B,) which buildings of a scene are blocks, where the source tells of pitched roofs."""
    count = scene.num_buildings
    if scene.pitched is None:
        return np.zeros(count, np.bool_)
    corners = scene.vertices[scene.triangles].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas, rises = np.linalg.norm(normals, axis=1), np.abs(normals[:, 2])
    areas[rises <= _LEAST_RISE * areas] = 0.0
    owner = np.repeat(np.arange(count), np.diff(scene.triangle_starts))
    covered = np.bincount(owner, weights=areas, minlength=count)
    slanted = np.bincount(owner, weights=areas * (rises < _LEVEL * areas), minlength=count)
    return np.asarray(scene.pitched & (slanted <= _SLANTED_SHARE * covered))
