"""Priors and ends on real photos: recall, common and own errors, stated probability, photo edges, basins.

How far a photo's edges lie from the map's roof edges at a pose knows no method and no truth: it ranks answers
and true poses alike.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.bench import Figure, Report
from lodbench.citymap import CityMap
from lodbench.citymodel.scene import Scene, building_boxes
from lodbench.datasets.inputs import Input
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Query
from lodbench.errors import QueryFault
from lodbench.estimation.edge_alignment import EdgeLikelihood
from lodbench.evaluation.metrics import ERROR, share_rejected
from lodbench.evaluation.pose_errors import Threshold, bootstrap_ratio, hits_of
from lodbench.geometry import Camera, Pose
from lodbench.geometry.pose import pose_from_vector, vector_from_pose
from lodbench.methods.fits import photo_edges
from lodbench.methods.protocol import Estimate, Streams
from lodbench.reporting.aligned_text import format_columns
from lodbench.reporting.figures import SERIES, draw_figure

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

Floats = NDArray[np.float64]

# Photos are looked at no wider than this; distances are pixels of that size.
WIDTH = 1600
# How far an image edge may be from a place of a roof edge, and the angle between the two.
REACH_PX, PARALLEL_DEG = 6.0, 15.0
# Shorter image edges are texture; between places of a roof edge; how far a segment is continued at its ends.
_LEAST_PX, _STEP_PX, _BEYOND_PX = 10.0, 4.0, 2.0
# Steeper edges are those of walls; lower than this share of a building's height its walls end.
_STEEPEST, _FEET = 0.7, 0.2
LIMITS = (Threshold(2, 1), Threshold(2, 2), Threshold(3, 3), Threshold(5, 5))
# A right answer.
_RIGHT = Threshold(2, 2)
# The squared length, in standard deviations, that 95 % of Gaussian errors in three directions stay below;
# half of them stay below the other.
_HELD, _SURPRISE, _MEDIAN_SURPRISE = 0.95, 7.8147, 2.366
# An answer that a user would trust.
TRUSTED = 0.9
# What photos have in common needs some photos.
_FEWEST_PHOTOS = 3
_PLACE = ["east_m", "north_m", "up_m"]
_HEAD = (
    "set", "method", "answers", "2/3/5 m, deg", "95 % at 2 m, 2 deg", "median", "common height",
    "common plan", "own", "stated/found", f"wrong at {TRUSTED:g}", "surprise, in 95 %", "edges",
    "ground", "s", "CPU s",
)  # fmt: skip
_NOTES = f"""\
common: median error of a flight's photos (from the prior in the middle, by size), and percent of the height
  above ground; own: median of what is left of each error without it
stated/found: mean probability, and share within 2 m and 2 deg; wrong at {TRUSTED:g}: of answers so probable
surprise: median squared error of the place in stated standard deviations (honest: {_MEDIAN_SURPRISE:.1f});
  share of places in the stated 95 %
edges: median distance of roof edges from the nearest image edge within {PARALLEL_DEG:g} deg,
  in pixels of the photo at {WIDTH} px width or less; share that has one within {REACH_PX:g} px
ground: median distance of pixels' places on map or ground from the true ones;
  share within the pose's stated 95 % ellipse"""


class PhotoEdges:
    """The straight edges of one photo, to be compared with a map from any number of poses.

    Args:
        photo: (H, W) or (H, W, 3) uint8.
        camera: The photo's, of any size; scaled so that the photo is at most ``WIDTH`` wide.
    """

    def __init__(self, photo: NDArray[np.uint8], camera: Camera) -> None:
        width = min(camera.width, WIDTH)
        self.camera = camera.scaled(width, max(1, round(camera.height * width / camera.width)))
        size = self.camera.width, self.camera.height
        grey = photo if photo.ndim == 2 else cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY)
        small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        lines = cv2.createLineSegmentDetector().detect(small)[0]
        # OpenCV counts from the middle of the first pixel, cameras from its corner.
        ends = np.empty((0, 2, 2)) if lines is None else lines.reshape(-1, 2, 2).astype(np.float64) + 0.5
        lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        self._ends, self._lengths = ends[lengths >= _LEAST_PX], lengths[lengths >= _LEAST_PX]
        self._along = (self._ends[:, 1] - self._ends[:, 0]) / self._lengths[:, None]

    def distances(self, pose: Pose, city_map: CityMap) -> Floats:
        """Returns (N,) pixels from places on visible roof edges to the nearest parallel image edge.

        Places are every 4 px; infinite where no image edge within 15 degrees lies within 6 px. Empty where no
        roof is in view of the pose, scene frame.
        """
        pieces = roof_edges(self.camera, pose, city_map)
        return np.concatenate([np.empty(0), *(self._from(first, last) for first, last in pieces)])

    def _from(self, first: Floats, last: Floats) -> Floats:
        """Returns the distances from places on one edge, between two pixels, (2,) each."""
        length = float(np.linalg.norm(last - first))
        along = (last - first) / max(length, 1e-9)
        off = (self._ends - first) @ np.array([-along[1], along[0]])
        near = (np.abs(off).min(axis=1) < REACH_PX + _BEYOND_PX) | (off[:, 0] * off[:, 1] < 0.0)
        kept = near & (np.abs(self._along @ along) > np.cos(np.radians(PARALLEL_DEG)))
        count = max(1, round(length / _STEP_PX))
        places = first + (np.arange(count) + 0.5)[:, None] / count * (last - first)
        offsets = places[:, None] - self._ends[kept, 0]
        beside = (offsets * self._along[kept]).sum(axis=2)
        across = np.abs(offsets[..., 0] * self._along[kept, 1] - offsets[..., 1] * self._along[kept, 0])
        ends_before = (beside < -_BEYOND_PX) | (beside > self._lengths[kept] + _BEYOND_PX)
        nearest = np.where(ends_before, np.inf, across).min(axis=1, initial=np.inf)
        return np.where(nearest <= REACH_PX, nearest, np.inf)


def roof_edges(camera: Camera, pose: Pose, city_map: CityMap) -> Floats:
    """Returns (S, 2, 2) pixels between which visible edges of roofs run; edges of walls are left out."""
    (edges,) = city_map.edges(camera, pose.rotation[None], pose.center[None])
    rise = np.abs(edges.points[:, 1, 2] - edges.points[:, 0, 2])
    length = np.linalg.norm(edges.points[:, 1] - edges.points[:, 0], axis=1)
    is_high = edges.points[:, :, 2].min(axis=1) > _feet(city_map.scene)[edges.building]
    return np.asarray(edges.pixels[edges.is_visible & is_high & (rise < _STEEPEST * length)])


def _feet(scene: Scene) -> Floats:
    """Returns (B,) heights, scene metres, up to which edges are taken for the feet of a building's walls."""
    boxes, heights = building_boxes(scene), np.zeros(scene.num_buildings)
    heights[boxes.building] = boxes.low[:, 2] + _FEET * (boxes.high[:, 2] - boxes.low[:, 2])
    return heights


def median_and_share(distances: Floats) -> tuple[float, float]:
    """Returns the median of the finite distances, pixels, and their share; NaN where there are none."""
    finite = distances[np.isfinite(distances)]
    median = float(np.median(finite)) if len(finite) else float("nan")
    return median, len(finite) / len(distances) if len(distances) else float("nan")


def report_real(trials: pd.DataFrame, title: str, truths: pd.DataFrame | None = None) -> Report:
    """Returns the report of trials: a table of sets and methods, one of trials, and a picture of basins.

    Args:
        trials: A row per set, method, photo and prior: ``set``, ``method``, ``photo``, ``flight``, ``prior``
            (the number of a drawn one, or ``published``), ``prior_translation_error_m``,
            ``prior_rotation_error_deg``, ``translation_error_m``, ``rotation_error_deg`` (infinite without
            an answer), ``prior_east_m``, ``prior_north_m``, ``east_m``, ``north_m``, ``up_m`` (less the
            truth's), ``height_m`` (of the true camera above ground), ``score``, ``probability`` (of being
            within 2 m and 2 degrees; NaN where the method states none), ``surprise`` (squared error of the
            place in standard deviations, by the covariance that was stated; NaN where none was),
            ``edges_px``, ``edges_found`` (as of ``lodbench.bench.real_report``), ``ground_m`` (median
            over pixels of how far they are placed on map or ground from where they are), ``ground_held``
            (share in the stated 95 % ellipse; NaN where none was), ``seconds``, ``cpu_seconds``, ``failure``.
        title: Data and protocol in words.
        truths: A row per set and photo: ``set``, ``photo``, ``edges_px``, ``edges_found`` at the true pose.
    """
    groups = {
        (str(of_set), str(method)): rows
        for (of_set, method), rows in trials.groupby(["set", "method"], sort=False)
    }
    at_truth = {} if truths is None or truths.empty else {str(s): rows for s, rows in truths.groupby("set")}
    is_one = trials["set"].nunique() == 1
    named = {method if is_one else f"{of_set}, {method}": rows for (of_set, method), rows in groups.items()}
    figures = [figure for name, rows in named.items() for figure in _figures(name, rows)]
    for of_set, rows in at_truth.items():
        name = "truth" if is_one else f"{of_set}, truth"
        figures += _edge_figures(name, rows)
    text = "\n".join([title, _summary(groups, at_truth), _NOTES, "", _table(trials)])
    return Report(text, figures, trials, partial(_pictures, named))


def is_within(trials: pd.DataFrame, limit: Threshold) -> NDArray[np.bool_]:
    """Returns (N,) which answers are nearer than metres and degrees."""
    return hits_of(trials[list(ERROR)].to_numpy(), limit)


def held(trials: pd.DataFrame) -> NDArray[np.bool_] | None:
    """Returns (N,) which places lie in the ellipsoid said to hold 95 % of them; None where none is said.

    Answers without a covariance are left out.
    """
    surprise = trials["surprise"].to_numpy(np.float64)
    stated = surprise[~np.isnan(surprise)]
    return np.asarray(stated < _SURPRISE) if len(stated) else None


class FlightErrors(NamedTuple):
    """What the answers to a flight's photos err by in common, and besides."""

    up_m: float  # common error along height, of the prior whose is in the middle by size; metres
    up_percent: float  # the same of the cameras' heights above ground
    plan_m: float  # common error in plan; metres
    plan_percent: float  # the same of the heights
    own_m: float  # median distance of answers from where the common error alone would put them; metres


def flight_errors(trials: pd.DataFrame) -> FlightErrors | None:
    """Returns common and own errors of one method; None of flights of fewer than three answered photos."""
    answered = trials[trials["up_m"].notna()].assign(up_percent=lambda t: 100.0 * t["up_m"] / t["height_m"])
    by_flight = answered.groupby(["flight", "prior"], sort=False)
    answered = answered[by_flight["photo"].transform("count") >= _FEWEST_PHOTOS]
    if answered.empty:
        return None
    by_flight = answered.groupby(["flight", "prior"], sort=False)
    own = np.linalg.norm(answered[_PLACE] - by_flight[_PLACE].transform("median"), axis=1)
    common = by_flight[[*_PLACE, "up_percent", "height_m"]].median()
    heights, up, up_percent = (common[name].to_numpy() for name in ("height_m", "up_m", "up_percent"))
    plan = np.hypot(common["east_m"].to_numpy(), common["north_m"].to_numpy())
    k, j = (int(np.argsort(size, kind="stable")[len(common) // 2]) for size in (np.abs(up), plan))
    plan_percent = 100.0 * plan[j] / heights[j]
    return FlightErrors(*map(float, (up[k], up_percent[k], plan[j], plan_percent, np.median(own))))


def trusted(trials: pd.DataFrame) -> tuple[int, int]:
    """Returns how many answers of a probability of 0.9 and more are wrong, and how many there are."""
    sure = trials["probability"].to_numpy(np.float64) >= TRUSTED
    return int((sure & ~is_within(trials, _RIGHT)).sum()), int(sure.sum())


def _figures(name: str, rows: pd.DataFrame) -> Iterator[Figure]:
    for limit in LIMITS:
        yield Figure(f"{name}: recall {limit.label}", 100.0 * float(is_within(rows, limit).mean()), "%")
    middle = rows[[*ERROR, "seconds", "cpu_seconds"]].median()
    yield Figure(f"{name}: median translation", float(middle[ERROR[0]]), "m")
    yield Figure(f"{name}: median rotation", float(middle[ERROR[1]]), "deg")
    yield Figure(f"{name}: priors", float(len(rows)), "")
    if (errors := flight_errors(rows)) is not None:
        yield Figure(f"{name}: common height", errors.up_m, "m")
        yield Figure(f"{name}: common height of height above ground", errors.up_percent, "%")
        yield Figure(f"{name}: common plan", errors.plan_m, "m")
        yield Figure(f"{name}: common plan of height above ground", errors.plan_percent, "%")
        yield Figure(f"{name}: own error, median", errors.own_m, "m")
    if rows["probability"].notna().all():
        wrong, sure = trusted(rows)
        yield Figure(f"{name}: mean probability stated", 100.0 * float(rows["probability"].mean()), "%")
        yield Figure(f"{name}: answers at probability {TRUSTED:g}", float(sure), "")
        yield Figure(f"{name}: wrong answers at probability {TRUSTED:g}", float(wrong), "")
    inside, share = (
        held(rows),
        share_rejected(rows["probability"].to_numpy(np.float64), is_within(rows, _RIGHT)),
    )
    if inside is not None:
        yield Figure(f"{name}: median squared error in stated sigmas", float(rows["surprise"].median()), "")
        yield Figure(f"{name}: places within the said {100 * _HELD:g} %", 100.0 * float(inside.mean()), "%")
    if not math.isnan(share):
        yield Figure(f"{name}: wrong answers flagged, 90 % of right kept", 100.0 * share, "%")
    yield from _edge_figures(name, rows)
    if rows["ground_m"].notna().any():
        yield Figure(f"{name}: ground points, median", float(rows["ground_m"].median()), "m")
    if rows["ground_held"].notna().any():
        share = 100.0 * float(rows["ground_held"].mean())
        yield Figure(f"{name}: ground points within the said {100 * _HELD:g} %", share, "%")
    yield Figure(f"{name}: seconds", float(middle["seconds"]), "s")
    yield Figure(f"{name}: CPU seconds", float(middle["cpu_seconds"]), "s")


def _edge_figures(name: str, rows: pd.DataFrame) -> Iterator[Figure]:
    if rows["edges_found"].notna().any():
        yield Figure(f"{name}: roof edges to image edges, median", float(rows["edges_px"].median()), "px")
        yield Figure(f"{name}: roof edges with an image edge", 100.0 * float(rows["edges_found"].mean()), "%")


def _summary(groups: Mapping[tuple[str, str], pd.DataFrame], at_truth: Mapping[str, pd.DataFrame]) -> str:
    cells = [list(_HEAD)]
    for of_set in dict.fromkeys(name for name, _ in groups):
        if of_set in at_truth:
            edges = _edges(at_truth[of_set])
            row = {"set": of_set, "method": "truth", "answers": str(len(at_truth[of_set])), "edges": edges}
            cells.append([row.get(head, "") for head in _HEAD])
        cells += [[name, method, *_cells(rows)] for (name, method), rows in groups.items() if name == of_set]
    return format_columns(cells)


def _cells(rows: pd.DataFrame) -> list[str]:
    middle = rows[[*ERROR, "seconds", "cpu_seconds", "surprise"]].median()
    recalls = [100.0 * float(is_within(rows, limit).mean()) for limit in LIMITS[1:]]
    inside, errors, (wrong, sure) = held(rows), flight_errors(rows), trusted(rows)
    stated = "-" if rows["probability"].isna().any() else f"{100.0 * rows['probability'].mean():.0f}"
    return [
        str(len(rows)),
        "/".join(f"{recall:.0f}" for recall in recalls) + " %",
        _interval(rows),
        f"{middle[ERROR[0]]:.2f} m, {middle[ERROR[1]]:.2f} deg",
        "-" if errors is None else f"{errors.up_m:+.2f} m, {errors.up_percent:+.2f} %",
        "-" if errors is None else f"{errors.plan_m:.2f} m, {errors.plan_percent:.2f} %",
        "-" if errors is None else f"{errors.own_m:.2f} m",
        f"{stated}/{recalls[0]:.0f} %",
        "-" if stated == "-" else f"{wrong} of {sure}",
        "-" if inside is None else f"{middle['surprise']:.1f}, {100 * inside.mean():.0f} %",
        _edges(rows),
        _ground(rows),
        f"{middle['seconds']:.2f}",
        f"{middle['cpu_seconds']:.2f}",
    ]


def _edges(rows: pd.DataFrame) -> str:
    """Returns the median over photos of their medians, and the mean share found."""
    if rows["edges_found"].isna().all():
        return "-"
    return f"{rows['edges_px'].median():.2f} px, {100.0 * rows['edges_found'].mean():.0f} %"


def _ground(rows: pd.DataFrame) -> str:
    """Returns the median over photos of their medians, and the mean share in the stated ellipses."""
    if rows["ground_m"].isna().all():
        return "-"
    held_share = rows["ground_held"].mean()
    share = "-" if np.isnan(held_share) else f"{100.0 * held_share:.0f} %"
    return f"{rows['ground_m'].median():.2f} m, {share}"


def _interval(trials: pd.DataFrame) -> str:
    """Returns the 95 % interval of right answers over photos: answers to one share what is wrong with it."""
    right = trials.assign(right=is_within(trials, _RIGHT)).groupby("photo")["right"].agg(["sum", "count"])
    if len(right) < 2:
        return "-"
    low, high = bootstrap_ratio(*right.to_numpy(np.float64).T)
    return f"{100.0 * low:.0f} to {100.0 * high:.0f} %"


def _table(trials: pd.DataFrame) -> str:
    cells = [["method", "photo", "prior", "off by", "error", "up", "score", "probability", "edges", ""]]
    for _, t in trials.iterrows():
        has_edges = not np.isnan(t["edges_found"])
        cells.append(
            [
                t["method"],
                t["photo"],
                t["prior"],
                f"{t['prior_translation_error_m']:.1f} m, {t['prior_rotation_error_deg']:.1f} deg",
                f"{t['translation_error_m']:.2f} m, {t['rotation_error_deg']:.2f} deg",
                f"{t['up_m']:+.2f} m",
                f"{t['score']:.3f}",
                "-" if np.isnan(t["probability"]) else f"{t['probability']:.2f}",
                f"{t['edges_px']:.2f} px, {100.0 * t['edges_found']:.0f} %" if has_edges else "-",
                t["failure"],
            ]
        )
    return format_columns(cells)


def _pictures(by_method: dict[str, pd.DataFrame]) -> dict[str, bytes]:
    """Returns, for each method, from each prior to where it ended, viewed from above."""

    def draw(canvas: Canvas) -> None:
        axes = canvas.subplots(1, len(by_method), squeeze=False)[0]
        for axis, (name, rows) in zip(axes, by_method.items(), strict=True):
            _draw_basins(axis, name, rows)

    return {f"basins.{kind}": png for kind, png in draw_figure(5.0 * len(by_method), 5.0, draw).items()}


def _draw_basins(axis: Axes, name: str, rows: pd.DataFrame) -> None:
    right = is_within(rows, _RIGHT)
    places = rows[["prior_east_m", "prior_north_m", "east_m", "north_m"]].to_numpy().reshape(-1, 2, 2)
    for (start, end), is_right in zip(places, right, strict=True):
        colour = SERIES[0] if is_right else SERIES[1]
        axis.plot(*np.column_stack([start, end]), color=colour, alpha=0.4, linewidth=1.0)
        axis.plot(*start, "o", color=colour, markersize=3, fillstyle="none")
        axis.plot(*end, "o", color=colour, markersize=4)
    axis.plot(0.0, 0.0, "+", color="black", markersize=12)
    axis.set(
        title=f"{name}: {int(right.sum())} of {len(rows)} within 2 m and 2 deg",
        xlabel="east of the truth, m",
        ylabel="north of the truth, m",
        aspect="equal",
    )


class EdgeBound:
    """The least squares that ``region`` ends with, given map, camera and where to begin: the true pose.

    Args:
        truths: By the query's name, scene frame.
        prior: Half widths of the priors' errors.
    """

    name = "edges from truth"
    requires = frozenset({Input.IMAGE})

    def __init__(self, truths: Mapping[str, Pose], prior: UniformPrior) -> None:
        half = np.array([prior.x_m, prior.y_m, prior.z_m, prior.pitch_deg, prior.roll_deg, prior.yaw_deg])
        self._truths = truths
        self._sigmas = np.append(np.maximum(half, 1e-3) / np.sqrt(3.0), np.zeros(4))

    def localize(self, query: Query, city_map: CityMap, streams: Streams) -> Estimate:
        """Returns the pose that edges and prior make most probable near the true one.

        Raises:
            QueryFault: There is no photo, or too few roof lines are in view.
        """
        prior = vector_from_pose(query.prior)
        edges = photo_edges(query)
        if edges is None:
            raise QueryFault("there is no photo that can be decoded")
        likelihood = EdgeLikelihood(edges, query.camera, city_map, prior, self._sigmas)
        refined = likelihood.refined(vector_from_pose(self._truths[query.name]))
        if refined is None:
            raise QueryFault("too few roof lines are in view")
        return Estimate(pose_from_vector(refined.vector), 1.0, covariance=refined.covariance)
