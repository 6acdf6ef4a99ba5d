"""A city and the cameras of photos in three dimensions: one HTML file that needs no network."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.geometry import Camera, Pose
from lodbench.reporting.aligned_text import plain_text
from lodbench.reporting.page import rendered

Floats = NDArray[np.float64]
# Triangles beyond this are left out, those furthest from the cameras first: 100,000 take about a megabyte.
MAX_TRIANGLES = 100_000
# Of more photos than this the first have their picture in the view; each takes some 15 kB.
MAX_PHOTOS = 120
# The longer side of such a picture, pixels, and its JPEG quality.
_PHOTO_PX, _QUALITY = 400, 75
# What the city's corners are rounded to, metres.
_STEP_M = 0.01
_KINDS = ("prior", "estimate", "truth")


class ViewedCamera(NamedTuple):
    """A photo and where its camera is said to be; poses in the scene's local frame, None where there is none.

    Attributes:
        key: Of the query, or the photo's name.
        facts: What is stated of it, by name.
        camera: Its intrinsics; the lens is taken for a pinhole.
        prior: The rough pose.
        estimate: The pose found.
        truth: The true pose.
        photo: A JPEG of it as the camera sees it (``photo_jpeg``), or None.
    """

    key: str
    facts: Mapping[str, str]
    camera: Camera | None
    prior: Pose | None
    estimate: Pose | None
    truth: Pose | None
    photo: bytes | None


def draw_view3d(
    title: str, scene: Scene, cameras: Sequence[ViewedCamera], pages: Mapping[str, str] | None = None
) -> str:
    """Returns the page; "" where no camera is known.

    Args:
        title: Of the page.
        scene: The city; of a large one the triangles nearest to the cameras are shown, and the page says so.
        cameras: The photos, in the order of the page's list.
        pages: Addresses, from this page, of those it leads to, by what they are called.
    """
    poses = [pose for each in cameras for pose in (each.prior, each.estimate, each.truth) if pose is not None]
    if not poses:
        return ""
    middle: Floats = np.round(np.array([pose.center for pose in poses]).mean(axis=0))
    city, shown = _city(scene, np.array([pose.center[:2] for pose in poses]), middle)
    document = {
        "city": city,
        "cameras": [_camera(each, middle) for each in cameras if each.camera is not None],
    }
    total = len(scene.triangles)
    part = "" if shown == total else f"The {shown:,} of {total:,} triangles nearest to the cameras are shown."
    return rendered(
        "view3d.html.jinja",
        title=title,
        part=part,
        pages=pages or {},
        kinds=[kind for kind in _KINDS if any(getattr(c, kind) for c in cameras)],
        three=_packed((files("lodbench.reporting") / "vendor" / "three.min.js").read_bytes()),
        document=_packed(json.dumps(document, separators=(",", ":")).encode()),
    )


def photo_jpeg(pixels: NDArray[np.uint8]) -> bytes:
    """Returns a photo, (H, W, 3) BGR, as a small JPEG for the view."""
    import cv2

    height, width = pixels.shape[:2]
    scale = min(1.0, _PHOTO_PX / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    return bytes(cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes())


def _city(scene: Scene, places: Floats, middle: Floats) -> tuple[dict[str, Any], int]:
    """Returns corners and triangles as differences of whole numbers, which pack well; how many triangles."""
    chosen = np.arange(len(scene.triangles))
    if len(chosen) > MAX_TRIANGLES:
        # Small cities do without its import.
        from scipy.spatial import KDTree

        away, _ = KDTree(places).query(scene.vertices[scene.triangles[:, 0], :2])
        chosen = np.sort(np.argpartition(away, MAX_TRIANGLES)[:MAX_TRIANGLES])
    used, triangles = np.unique(scene.triangles[chosen], return_inverse=True)
    corners = np.round((scene.vertices[used] - middle) / _STEP_M).astype(np.int32)
    city = {
        "step_m": _STEP_M,
        "corners": _differences(corners.T),
        "triangles": _differences(triangles.reshape(1, -1).astype(np.int32)),
    }
    return city, len(chosen)


def _differences(rows: NDArray[np.int32]) -> str:
    steps = np.diff(rows, axis=1, prepend=0).astype("<i4")
    return base64.b64encode(np.ascontiguousarray(steps).tobytes()).decode("ascii")


def _camera(each: ViewedCamera, middle: Floats) -> dict[str, Any]:
    photo = None if each.photo is None else base64.b64encode(each.photo).decode("ascii")
    return {
        "key": plain_text(each.key),
        "facts": [[name, plain_text(text)] for name, text in each.facts.items() if text],
        "photo": photo,
        **{kind: _frustum(each.camera, getattr(each, kind), middle) for kind in _KINDS},
    }


def _frustum(camera: Camera | None, pose: Pose | None, middle: Floats) -> dict[str, list[float]] | None:
    """Returns a camera's centre, and the rays of its corners one metre ahead: clockwise, upper left first."""
    if camera is None or pose is None:
        return None
    pixels = np.array([[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]])
    rays = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    rays = np.column_stack([rays, np.ones(4)]) @ pose.rotation
    return {
        "center": np.round(pose.center - middle, 3).tolist(),
        "rays": np.round(rays, 6).ravel().tolist(),
    }


def _packed(content: bytes) -> str:
    """Returns bytes as base64 of gzip, the same bytes each time."""
    return base64.b64encode(gzip.compress(content, 9, mtime=0)).decode("ascii")
