"""The demo's queries: flight lines over the old town, and free views of another district; with photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lodbench.citymodel.scene import Scene
from lodbench.datasets.priors import UniformPrior
from lodbench.errors import DatasetError
from lodbench.execution.progress import Progress
from lodbench.geometry import EulerAngles, Pose
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.storage import random_stream
from lodbench.synthesis.mask_degradation import degrade_mask
from lodbench.synthesis.objects.scene_props import SceneProps
from lodbench.synthesis.photo import LookRanges, PhotoRenderer, draw_look
from lodbench.synthesis.queries import SyntheticQuery
from lodbench.synthesis.town.shapes import Points
from lodbench.synthesis.town.town import OLD_TOWN_RADIUS_M, ORIGIN_M, Town
from lodbench.synthesis.view_sampling import (
    FINE_SIZE,
    RGB_CAMERA,
    ViewCheck,
    ViewSampling,
    first_accepted,
    sample_views,
    view_of,
)

# Twice the size at which methods compare silhouettes: masks are finer than what is scored, as a
# network's are, and still small files.
QUERY_CAMERA = RGB_CAMERA.scaled(2 * FINE_SIZE[0], 2 * FINE_SIZE[1])
# IoU of the masks with the true silhouettes: its mean, as the paper's network does in and out of place,
# and how far single masks lie above or below it: a network is not equally good everywhere.
TARGET_IOU = {"in_place": (0.88, 0.09), "out_of_place": (0.80, 0.15)}
# The published priors in place; out of place errors beyond a local search, as in the paper's Table 3 (30 m).
PRIORS = {"in_place": UniformPrior(), "out_of_place": UniformPrior(x_m=30.0, y_m=30.0, yaw_deg=15.0)}

_BUILDING_SHARE = {"in_place": (0.10, 0.80), "out_of_place": (0.05, 0.80)}
# The flight over the old town: height of each line, tilt of its camera, and jitter around both.
_LINE_HEIGHTS_M = (112.0, 130.0, 148.0)
_LINE_PITCHES_DEG = (28.0, 50.0, 38.0)
_LINE_SPACING_M = 105.0
# Where the out-of-place views look: this far from the middle, away from the river.
_SUBURB_AT_M = 345.0
_SUBURB_HALF_M = 135.0
_SUBURB_HEIGHTS_M = (70.0, 150.0)
_ATTEMPTS = 50
# What the photos of one split share: the sun and the air of the day of their flight.
_OF_THE_DAY = ["sun_elevation_deg", "sun_azimuth_deg", "sun_share", "sun_warmth"]
_OF_THE_DAY += ["haze_range_m", "sky_white", "dryness"]


class DemoSplit(NamedTuple):
    """The queries of one split, and how many draws of views were rejected for it."""

    name: str
    queries: tuple[SyntheticQuery, ...]
    rejections: int


def make_splits(town: Town, scene: Scene, props: SceneProps, count: int) -> list[DemoSplit]:
    """Returns both splits of a town in its LoD3 scene, half of the queries each, the odd one in place.

    Raises:
        DatasetError: No acceptable view is found somewhere.
    """
    camera = _QueryCamera(town, scene, props)
    offset_m = ORIGIN_M - scene.origin
    check = ViewCheck(scene, camera.renderer, QUERY_CAMERA, _BUILDING_SHARE["in_place"])
    flight, rejections = _fly_over(town, check, offset_m, count - count // 2)
    x, y = -town.streets.to_river * _SUBURB_AT_M + offset_m[:2]
    area_m = (x - _SUBURB_HALF_M, y - _SUBURB_HALF_M, x + _SUBURB_HALF_M, y + _SUBURB_HALF_M)
    share = _BUILDING_SHARE["out_of_place"]
    sampling = ViewSampling(_SUBURB_HEIGHTS_M, building_share=share, area_m=area_m, seed=town.seed)
    views = sample_views(scene, camera.renderer, QUERY_CAMERA, sampling, count // 2, "demo", "out_of_place")
    return [
        DemoSplit("in_place", camera.take("in_place", flight), rejections),
        DemoSplit("out_of_place", camera.take("out_of_place", views.poses), views.rejections),
    ]


class _QueryCamera:
    """Takes the queries of a town: masks and photos of its scene and props."""

    def __init__(self, town: Town, scene: Scene, props: SceneProps) -> None:
        self._town = town
        self.renderer = SilhouetteRenderer(scene, threads=1)
        self._photos = PhotoRenderer(scene, props)

    def take(self, split: str, truths: Sequence[Pose]) -> tuple[SyntheticQuery, ...]:
        """Returns a prior, a photo and a mask for each true pose of a split, from streams of their own."""
        targets, day = _target_ious(split, self._town.seed, len(truths)), self._day(split)
        queries, lowest_m = [], float(self.renderer.scene.vertices[:, 2].min())
        with Progress(f"demo town, made once: photos {split}", len(truths)) as progress:
            for k, truth in enumerate(truths):
                name = f"{split}_{k:04d}.jpg"
                # Where the view's centre meets the lowest ground.
                drop_m = float(truth.center[2]) - lowest_m
                clean = self.renderer.render(QUERY_CAMERA, truth)
                rough, iou = degrade_mask(
                    # A network cannot see through trees; their shapes are those of the photo.
                    clean & ~self._photos.occluders(QUERY_CAMERA, truth),
                    targets[k],
                    random_stream(self._town.seed, "demo", name, "mask"),
                    trees=False,
                    pixels_per_m=QUERY_CAMERA.fx * -float(truth.rotation[2, 2]) / drop_m,
                    truth=clean,
                )
                prior = PRIORS[split].draw(truth, random_stream(self._town.seed, "demo", name, "prior"))
                look, response = draw_look(day, random_stream(self._town.seed, "demo", name, "photo"))
                # The town's own patterns stay as they are from photo to photo.
                photo = self._photos.jpeg(QUERY_CAMERA, truth, look._replace(seed=self._town.seed), response)
                queries.append(SyntheticQuery(name, truth, prior, rough, iou, photo))
                progress.advance()
        return tuple(queries)

    def _day(self, split: str) -> LookRanges:
        """Returns from what the looks of a split's photos are drawn: sun and air are drawn already."""
        day, ranges = random_stream(self._town.seed, "demo", split, "day"), self._town.look.days
        drawn = {name: float(day.uniform(*getattr(ranges, name))) for name in _OF_THE_DAY}
        return replace(ranges, **{name: (value, value) for name, value in drawn.items()})


def _target_ious(name: str, seed: int, count: int) -> list[float]:
    """Returns the IoU each mask of a split is to have: evenly spread around the mean, in random order."""
    mean, spread = TARGET_IOU[name]
    even = mean + spread * ((2 * np.arange(count) + 1) / count - 1)
    return [float(iou) for iou in random_stream(seed, "demo", name, "iou").permutation(even)]


def _fly_over(town: Town, check: ViewCheck, offset_m: Points, count: int) -> tuple[list[Pose], int]:
    """Returns views along three parallel flight lines over the old town, to and fro, and the rejections.

    The camera looks ahead along the line; a station that shows too few or too many buildings is
    tried again with more jitter.
    """
    turn = float(random_stream(town.seed, "demo", "flight").uniform(-180.0, 180.0))
    poses, rejections = [], 0
    for index in range(count):
        line, place = index * 3 // count, (index * 3 % count) / count
        streams = (random_stream(town.seed, "demo", "in_place", index, k) for k in range(_ATTEMPTS))
        drawn = (_station(town, line, place, turn, 1.0 + k, stream) for k, stream in enumerate(streams))
        stations = (pose.shifted(offset_m) for pose in drawn)
        pose, rejected = first_accepted(stations, check)
        rejections += rejected
        if pose is None:
            raise DatasetError(
                f"The demo town of seed {town.seed} shows too few buildings from its flight line {line}.",
                "Take another seed.",
            )
        poses.append(pose)
    return poses, rejections


def _station(
    town: Town, line: int, place: float, turn: float, jitter: float, generator: np.random.Generator
) -> Pose:
    """Returns the view from one place, in [0, 1), of a flight line, town metres."""
    along = np.array([-np.sin(np.radians(turn)), np.cos(np.radians(turn))])
    across = np.array([along[1], -along[0]])
    forward = line % 2 == 0
    way = 2.0 * place - 1.0 if forward else 1.0 - 2.0 * place
    middle = along * way * OLD_TOWN_RADIUS_M + across * (line - 1) * _LINE_SPACING_M
    middle = middle + generator.normal(0.0, 4.0 * jitter, size=2)
    target = np.append(middle, town.terrain.height(middle[None])[0])
    height = np.clip(_LINE_HEIGHTS_M[line] + generator.normal(0.0, 3.0 * jitter), 100.0, 160.0)
    pitch = np.clip(_LINE_PITCHES_DEG[line] + generator.normal(0.0, 2.0 * jitter), 20.0, 60.0)
    yaw = turn + (0.0 if forward else 180.0) + generator.normal(0.0, 3.0)
    return view_of(
        target, float(height), EulerAngles(float(pitch), float(generator.normal(0, 0.3)), float(yaw))
    )
