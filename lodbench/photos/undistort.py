"""Photos and masks of a real lens, as a pinhole would have taken them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import DatasetError
from lodbench.geometry import Camera
from lodbench.geometry.lens import distort

# Focal lengths tried, as multiples of the lens's own: wider would stretch the rim, narrower leave little.
_LEAST_ZOOM, _MOST_ZOOM = 0.6, 4.0
# Points along each side at which it is looked whether the photo reaches there.
_GRID = 65


def pinhole_of(camera: Camera) -> Camera:
    """Returns the widest pinhole of the same size whose every pixel the photo shows.

    Principal point and the ratio of the focal lengths stay. A pinhole comes back as it is. With every
    pixel shown there are no black corners, which a mask would count as "no building".

    Raises:
        DatasetError: There is no such pinhole: the parameters are those of no lens.
    """
    if not camera.distortion:
        return camera
    low, high = _LEAST_ZOOM, _MOST_ZOOM
    if not _is_shown(camera, high):
        raise DatasetError(
            f"The lens distortion of {camera.lens} {camera.distortion} cannot be undone: the picture folds.",
            "Check the order of the parameters.",
        )
    if _is_shown(camera, low):
        return _zoomed(camera, low)
    while high - low > 1e-4:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if _is_shown(camera, middle) else (middle, high)
    return _zoomed(camera, high)


def undistorted(picture: NDArray[Any], camera: Camera, pinhole: Camera) -> NDArray[Any]:
    """Returns a picture as the pinhole shows it, of the same shape and type, linearly interpolated.

    Args:
        picture: (H, W) or (H, W, 3), of any size: the cameras are scaled to it.
        camera: The lens the picture was taken with.
        pinhole: From ``pinhole_of``.
    """
    import cv2

    if not camera.distortion:
        return picture
    height, width = picture.shape[:2]
    source = _source_pixels(camera.scaled(width, height), pinhole.scaled(width, height))
    # OpenCV counts from pixel centres, COLMAP from corners. A mask may be half a pixel short: repeat it.
    x, y = ((axis - 0.5).astype(np.float32) for axis in source)
    result = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(result)


def _zoomed(camera: Camera, zoom: float) -> Camera:
    return replace(camera.without_distortion(), fx=camera.fx * zoom, fy=camera.fy * zoom)


def _source_pixels(
    camera: Camera, pinhole: Camera, x: NDArray[Any] | None = None, y: NDArray[Any] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns where the lens's picture shows the pinhole's pixels, COLMAP's coordinates.

    Args:
        camera: The lens.
        pinhole: The pinhole, of the same size.
        x: Columns to look at, COLMAP's coordinates; the centres of all by default.
        y: Rows, likewise.
    """
    x = np.arange(pinhole.width) + 0.5 if x is None else x
    y = np.arange(pinhole.height) + 0.5 if y is None else y
    ray_x, ray_y = np.meshgrid((x - pinhole.cx) / pinhole.fx, (y - pinhole.cy) / pinhole.fy)
    seen_x, seen_y = distort(camera.lens, camera.distortion, ray_x, ray_y)
    return camera.fx * seen_x + camera.cx, camera.fy * seen_y + camera.cy


def _is_shown(camera: Camera, zoom: float) -> bool:
    """Tells whether the photo shows a whole pinhole, once each way round: polynomials fold back far out."""
    width, height = camera.width, camera.height
    columns, rows = np.linspace(0, width, _GRID), np.linspace(0, height, _GRID)
    x, y = _source_pixels(camera, _zoomed(camera, zoom), columns, rows)
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        return False
    inside = (x.min() >= 0) and (x.max() <= width) and (y.min() >= 0) and (y.max() <= height)
    (dx_down, dx_right), (dy_down, dy_right) = np.gradient(x), np.gradient(y)
    return bool(inside and (dx_right * dy_down - dx_down * dy_right > 0).all())
