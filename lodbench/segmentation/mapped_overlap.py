"""How well a mask shows the buildings of a map that may be a part of all: judged around them only."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]

# Every so many pixels are looked at: shares of areas need no more.
_STRIDE = 3


def mapped_overlap(silhouette: Mask, mask: Mask) -> float:
    """Returns how much more of the mapped buildings than of their surroundings a mask holds.

    Eq. (C15) of docs/methods/contour_alignment.md.

    1 where both agree around the map's buildings, 0 where they do by chance; the surroundings are the pixels
    nearest to the silhouette, as many as it has. Buildings further off, which the map may lack, do not count.
    For masks that err little it is the IoU; an empty silhouette has 0.

    Args:
        silhouette: (H, W) of the map's buildings.
        mask: (H, W) of all buildings of the photo.
    """
    mapped = np.ascontiguousarray(silhouette[::_STRIDE, ::_STRIDE])
    shown = mask[::_STRIDE, ::_STRIDE]
    inside = int(np.count_nonzero(mapped))
    if inside == 0:
        return 0.0
    held = np.count_nonzero(shown & mapped) / inside
    away = cv2.distanceTransform((~mapped).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[~mapped]
    if len(away) == 0:
        return held
    near = away <= np.partition(away, min(inside, len(away)) - 1)[min(inside, len(away)) - 1]
    return held - float(np.mean(shown[~mapped][near]))
