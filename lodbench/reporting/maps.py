"""A city and the cameras of photos: from above as an SVG for pages, and in three dimensions as a page."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.geometry import Camera, Pose
from lodbench.reporting.aligned_text import plain_text
from lodbench.reporting.figures import SERIES
from lodbench.reporting.page import Picture, rendered

Floats = NDArray[np.float64]
# Triangles beyond this are left out, those furthest from the cameras first: a browser must draw them all.
_MAX_TRIANGLES = 40_000
# Triangles steeper than this are walls, which from above are lines.
_LEAST_FLAT = 0.2
_MARGIN_M = 40.0
# From so many spots on they are drawn smaller and lighter: all over each other they are one blot.
_MANY, _CROWD = 200, 1000
# Of imagery under the map: its colours are to be recognised, not measured.
_QUALITY = 75
# Triangles beyond this are left out, those furthest from the cameras first: 100,000 take about a megabyte.
MAX_TRIANGLES = 100_000
# Of more photos than this the first have their picture in the view; each takes some 15 kB.
MAX_PHOTOS = 120
# The longer side of such a picture, pixels, and its JPEG quality.
_PHOTO_PX, _PHOTO_QUALITY = 400, 75
# What the city's corners are rounded to, metres.
_STEP_M = 0.01
_KINDS = ("prior", "estimate", "truth")


class Spot(NamedTuple):
    """A query on the map: (2,) east and north in metres of each camera, None where there is none.

    ``covariance`` is (2, 2) of the estimate's error, square metres, where the method knows it; ``second`` is
    the answer that the estimate is compared with.
    """

    key: str
    prior: Floats | None
    estimate: Floats | None
    truth: Floats | None
    trust: str = ""
    covariance: Floats | None = None
    second: Floats | None = None


class Underlay(Protocol):
    """Imagery that lies under a map."""

    @property
    def name(self) -> str:
        """Returns what it is called."""

    def within(self, low: Floats, high: Floats) -> NDArray[np.uint8]:
        """Returns (H, W, 4) blue, green, red, alpha between two corners (2,) east and north, north up."""


class Marked(NamedTuple):
    """A part of the city that is pointed at: what is said of it; its rings, (N, 2) east and north each."""

    title: str
    rings: Sequence[Floats]


def draw_map(
    spots: Sequence[Spot],
    vertices: Floats | None,
    triangles: NDArray[np.int32] | None,
    *,
    marked: Sequence[Marked] = (),
    is_flight: bool = False,
    view: str = "",
    names: Mapping[str, str] | None = None,
    imagery: Underlay | None = None,
) -> str:
    """Returns the map as HTML; "" where no camera is known.

    Args:
        spots: The queries.
        vertices: (V, 3) the city's, in the coordinates of the spots; None to leave the city out.
        triangles: (T, 3) their indices.
        marked: Parts of the city to point at.
        is_flight: Whether the spots were taken one after the other: their paths are drawn.
        view: File beside the page that shows the same in three dimensions; "" for none.
        names: What its legend calls ``prior``, ``estimate``, ``second`` and ``truth``, where not so.
        imagery: What lies under the city, in the coordinates of the spots.
    """
    known = [place for spot in spots for place in (*spot[1:4], spot.second) if place is not None]
    if not known:
        return ""
    places = np.array(known)
    low, high = places.min(axis=0), places.max(axis=0)
    margin = _MARGIN_M + 0.15 * float((high - low).max())
    low, high = low - margin, high + margin
    city = outline = ""
    if vertices is not None and triangles is not None:
        rows = _flat_near(vertices, triangles, (low + high) / 2, float((high - low).max()))
        city = _flat_path(vertices, triangles[rows], low)
        # On imagery a fill alone is hardly seen.
        outline = "" if imagery is None else _outline_path(vertices, triangles[rows], low)
    width, height = high - low
    enlarged = _enlarged(spots, float(max(width, height)))
    return rendered(
        "map.html.jinja",
        box=(0.0, -round(float(height), 1), round(float(width), 1), round(float(height), 1)),
        city=city,
        outline=outline,
        imagery=None if imagery is None else _imagery(imagery, low, high),
        marked=[("marked", *_marked(part, low)) for part in marked],
        tracks=_tracks(spots, low) if is_flight else [],
        spots=[
            (spot.key, spot.trust, _ellipse(spot, low, enlarged), _lines(spot, low), _dots(spot, low))
            for spot in spots
        ],
        view=view,
        classes="map"
        + " pictured" * (imagery is not None)
        + " many" * (len(spots) >= _MANY)
        + " crowd" * (len(spots) >= _CROWD),
        many=_MANY,
        crowd=_CROWD,
        legend=[
            (kind, (names or {}).get(kind, kind))
            for kind in ("prior", "estimate", "second", "truth")
            if any(getattr(spot, kind) is not None for spot in spots)
        ],
        enlarged=enlarged if any(spot.covariance is not None for spot in spots) else 0,
        kinds=[("marked", "in doubt")] if marked else [],
    )


def draw_plan(groups: Mapping[str, Sequence[Marked]]) -> str:
    """Returns parts of a city from above, a colour for each group, as HTML; "" where there is none."""
    rings = [ring for parts in groups.values() for part in parts for ring in part.rings]
    if not rings:
        return ""
    ends = np.array([(ring.min(axis=0), ring.max(axis=0)) for ring in rings])
    low, high = ends[:, 0].min(axis=0) - _MARGIN_M, ends[:, 1].max(axis=0) + _MARGIN_M
    width, height = (round(float(side), 1) for side in high - low)
    kinds = {name: f"kind{number % len(SERIES)}" for number, name in enumerate(groups)}
    return rendered(
        "map.html.jinja", box=(0.0, -height, width, height), city="", outline="", imagery=None,
        marked=[(kinds[name], *_marked(part, low)) for name, parts in groups.items() for part in parts],
        tracks=[], spots=[], view="", classes="map", many=_MANY, crowd=_CROWD, legend=[], enlarged=0,
        kinds=[(kind, name) for name, kind in kinds.items()],
    )  # fmt: skip


def _marked(part: Marked, low: Floats) -> tuple[str, str]:
    return part.title, "".join(_ring(ring, low) for ring in part.rings)


def _imagery(imagery: Underlay, low: Floats, high: Floats) -> tuple[str, str, list[float]]:
    """Returns what lies under a map: its name, an address that holds it, and x, y, width and height."""
    import cv2

    # As wide as high, as what a window shows beside a long map is not cut off.
    middle, side = (low + high) / 2, float((high - low).max())
    pixels = imagery.within(middle - side / 2, middle + side / 2)
    x, y = _at(middle + np.array([-side, side]) / 2, low)
    encoded = cv2.imencode(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])[1]
    return imagery.name, Picture(encoded.tobytes(), "webp", "").url, [x, y, round(side, 2), round(side, 2)]


def _enlarged(spots: Sequence[Spot], width_m: float) -> int:
    """Returns how many times ellipses are enlarged, so that most can be seen beside the dots."""
    widths = [2.0 * float(np.sqrt(np.trace(s.covariance) / 2.0)) for s in spots if s.covariance is not None]
    wanted = 0.03 * width_m / max(float(np.median(widths)), 1e-9) if widths else 1.0
    return max(factor for factor in (1, 2, 5, 10, 20, 50, 100) if factor == 1 or factor <= wanted)


def _ellipse(spot: Spot, low: Floats, enlarged: int) -> str:
    """Returns the path of two standard deviations round an estimate; "" where they are not known."""
    if spot.covariance is None or spot.estimate is None:
        return ""
    mirrored = spot.covariance * np.array([[1.0, -1.0], [-1.0, 1.0]])
    squares, axes = np.linalg.eigh(mirrored)
    one, other = (2.0 * enlarged * float(np.sqrt(max(square, 0.0))) for square in squares[::-1])
    turn = float(np.degrees(np.arctan2(axes[1, 1], axes[0, 1])))
    middle = np.array(_at(spot.estimate, low))
    (x, y), (u, v) = middle + one * axes[:, 1], middle - one * axes[:, 1]
    arc = f"A{one:.4g} {other:.4g} {turn:.1f} 1 0"
    return f"M{x:.2f} {y:.2f}{arc} {u:.2f} {v:.2f}{arc} {x:.2f} {y:.2f}Z"


def _tracks(spots: Sequence[Spot], low: Floats) -> list[tuple[str, str]]:
    named = (("prior", [s.prior for s in spots]), ("estimate", [s.estimate for s in spots]))
    tracks = [(kind, [_at(place, low) for place in places if place is not None]) for kind, places in named]
    return [(kind, "M" + "L".join(f"{x:g} {y:g}" for x, y in places)) for kind, places in tracks if places]


def _ring(ring: Floats, low: Floats) -> str:
    places = [_at(place, low) for place in ring]
    return "M" + "L".join(f"{x:g} {y:g}" for x, y in places) + "Z"


def _flat_near(
    vertices: Floats, triangles: NDArray[np.int32], middle: Floats, reach_m: float
) -> NDArray[np.int64]:
    """Returns the rows of the flat triangles near the cameras, in their order."""
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sizes = np.linalg.norm(normals, axis=1)
    away = np.abs(corners[:, :, :2].mean(axis=1) - middle).max(axis=1)
    is_shown = (np.abs(normals[:, 2]) > _LEAST_FLAT * sizes) & (away < reach_m + _MARGIN_M)
    chosen = np.flatnonzero(is_shown)
    return np.sort(chosen[np.argsort(away[chosen], kind="stable")[:_MAX_TRIANGLES]])


def _flat_path(vertices: Floats, triangles: NDArray[np.int32], low: Floats) -> str:
    """Returns the path of flat triangles; north is up, so y is turned round."""
    flat = np.round((vertices[triangles][:, :, :2] - low) * (1.0, -1.0), 1)
    # All one way round: a roof and the floor below it would cancel each other out.
    one, other = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    turned = one[:, 0] * other[:, 1] > one[:, 1] * other[:, 0]
    flat[turned] = flat[turned, ::-1]
    return "".join(
        f"M{ax:g} {ay:g}L{bx:g} {by:g} {cx:g} {cy:g}Z" for (ax, ay), (bx, by), (cx, cy) in flat.tolist()
    )


def _outline_path(vertices: Floats, triangles: NDArray[np.int32], low: Floats) -> str:
    """Returns the path of the edges that flat triangles do not share: the outlines of roofs and floors."""
    edges = np.sort(
        np.concatenate([triangles[:, (0, 1)], triangles[:, (1, 2)], triangles[:, (2, 0)]]), axis=1
    )
    edges, counts = np.unique(edges, axis=0, return_counts=True)
    ends = np.round((vertices[edges[counts == 1]][:, :, :2] - low) * (1.0, -1.0), 1)
    # A roof's outline and that of the floor below it are one line from above.
    order = np.lexsort((ends[:, :, 1], ends[:, :, 0]), axis=1)
    ends = np.unique(np.take_along_axis(ends, order[:, :, None], axis=1), axis=0)
    return "".join(f"M{ax:g} {ay:g}L{bx:g} {by:g}" for (ax, ay), (bx, by) in ends.tolist())


def _lines(spot: Spot, low: Floats) -> list[tuple[str, str]]:
    kinds = ("prior", "estimate", "second")
    end = spot.truth
    if end is None:
        end, kinds = spot.estimate, ("prior", "second")  # type: ignore[assignment]
    if end is None:
        return []
    x, y = _at(end, low)
    named = ((kind, getattr(spot, kind)) for kind in kinds)
    starts = [(kind, _at(start, low)) for kind, start in named if start is not None]
    return [(kind, f"M{a:g} {b:g}L{x:g} {y:g}") for kind, (a, b) in starts]


def _dots(spot: Spot, low: Floats) -> list[tuple[str, str]]:
    kinds = ("truth", "prior", "estimate", "second")
    named = ((kind, getattr(spot, kind)) for kind in kinds)
    dots = [(kind, _at(place, low)) for kind, place in named if place is not None]
    # A line of no length with a round end is a dot as wide as its pen, at every scale.
    return [(kind, f"M{x:g} {y:g}h0") for kind, (x, y) in dots]


def _at(place: Floats, low: Floats) -> tuple[float, float]:
    x, y = np.round((place - low) * (1.0, -1.0), 2)
    return float(x), float(y)


class ViewedCamera(NamedTuple):
    """A photo and where its camera is said to be; poses in the scene's local frame, None where none is."""

    key: str  # of the query, or the photo's name
    facts: Mapping[str, str]  # what is stated of it, by name
    camera: Camera | None  # its intrinsics; the lens is taken for a pinhole
    prior: Pose | None  # the rough pose
    estimate: Pose | None  # the pose found
    truth: Pose | None  # the true pose
    photo: bytes | None  # a JPEG of it as the camera sees it (``photo_jpeg``), or None


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
    return bytes(cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _PHOTO_QUALITY])[1].tobytes())


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
    return {"center": np.round(pose.center - middle, 3).tolist(), "rays": np.round(rays, 6).ravel().tolist()}


def _packed(content: bytes) -> str:
    """Returns bytes as base64 of gzip, the same bytes each time."""
    return base64.b64encode(gzip.compress(content, 9, mtime=0)).decode("ascii")
