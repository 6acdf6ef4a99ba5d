"""Cameras that no photo has: numbers in millimetres, or exchanged."""

from __future__ import annotations

import math

from lodbench.geometry import Camera

# A horizontal field of view beyond these, degrees, is a wrong number: fisheyes have no such focal length.
FIELD_DEG = (3.0, 150.0)
# Pixels are square, to this factor.
_SQUARE = 1.5
# Principal points lie this near the middle, as a share of the side, and in no whole photo beyond the second.
_NEAR, _FAR = 0.05, 0.1
_CROPPED = 0.25


def field_fault(camera: Camera) -> str:
    """Returns why a camera's focal length is none of a photo; "" if it may be."""
    field = math.degrees(2 * math.atan(camera.width / (2 * camera.fx)))
    if not FIELD_DEG[0] <= field <= FIELD_DEG[1]:
        in_mm = " (is it in millimetres?)" if field > FIELD_DEG[1] else ""
        return f"a focal length of {camera.fx:.4g} px sees {field:.0f} degrees; no photo does{in_mm}"
    if not 1 / _SQUARE < camera.fx / camera.fy < _SQUARE:
        return f"fx is {camera.fx:.4g} and fy {camera.fy:.4g} px; pixels are square"
    return ""


def exchange_fault(camera: Camera) -> str:
    """Returns why cx and cy of a camera are exchanged; "" if they are not."""
    exchanged = Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cy, camera.cx)
    if _off_middle(camera) > _FAR and _off_middle(exchanged) < _NEAR:
        return f"cx {camera.cx:.4g} and cy {camera.cy:.4g} of {camera.width} x {camera.height} are exchanged"
    return ""


def camera_fault(camera: Camera) -> str:
    """Returns why no photo was taken by a camera; "" if one may have been."""
    return field_fault(camera) or exchange_fault(camera)


def crop_doubt(camera: Camera) -> str:
    """Returns why a camera can only be of a crop; "" if it need not."""
    if _off_middle(camera) <= _CROPPED:
        return ""
    return f"cx {camera.cx:.4g}, cy {camera.cy:.4g} of {camera.width} x {camera.height}"


def _off_middle(camera: Camera) -> float:
    """Returns how far a principal point is from the middle, as a share of the side: the larger of both."""
    return max(abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5))
