"""The trial that `lodbench check-method` puts a method to: a few blocks, and queries that look at them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.blocks import scene_of_blocks
from lodbench.citymodel.scene import Scene
from lodbench.datasets.query import Query
from lodbench.errors import QueryFault
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.methods.protocol import Estimate, Method
from lodbench.rendering import LayerRenderer, Scorer, make_renderer, open_renderer
from lodbench.rendering.fit import Fit
from lodbench.rendering.protocol import Floats, IouCounts
from lodbench.storage import random_stream

# West, south, east, north, base, top, metres: nothing repeats, so that every pose is unique.
_BLOCKS = (
    (-72.0, -48.0, -40.0, -12.0, 0.0, 16.0),
    (-14.0, -60.0, 10.0, -44.0, 1.0, 33.0),
    (34.0, -38.0, 66.0, -2.0, 0.0, 11.0),
    (-50.0, 8.0, -31.0, 56.0, 0.0, 22.0),
    (-4.0, 2.0, 20.0, 27.0, 2.0, 38.0),
    (38.0, 24.0, 60.0, 70.0, 0.0, 14.0),
    (-76.0, 66.0, -12.0, 82.0, 1.0, 8.0),
)
# Far from zero, as map coordinates are: an answer in another frame than the query's shows at once.
_ORIGIN = np.array([281_000.0, 5_657_000.0, 60.0])
_CAMERA = Camera(320, 240, 231.0, 229.0, 161.5, 118.0)
# Pitch, roll, yaw (degrees) and x, y, z (metres) of the cameras; the priors are off by a fixed step.
_TRUTHS = (
    (22.0, 0.4, -70.0, 4.0, 9.0, 121.0),
    (31.0, -0.3, 25.0, -11.0, 3.0, 128.0),
    (26.0, 0.2, 140.0, 8.0, -10.0, 133.0),
)
_PRIOR_OFF = (5.0, -4.0, 6.0)
_PRIOR_OFF_YAW_DEG = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """A scene, and queries with exact masks.

    Attributes:
        scorer: Renders the scene, on one thread.
        queries: Each with a photo.
        truths: Their true poses, scene frame; no method sees them.
    """

    scorer: Scorer
    queries: tuple[Query, ...]
    truths: tuple[Pose, ...]


class CountingScorer:
    """A scorer that counts the poses it is asked to draw; all else goes to the one behind it."""

    def __init__(self, scorer: Scorer) -> None:
        self._scorer = scorer
        self.name: str = scorer.name
        self.scene: Scene = scorer.scene
        self.count = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._scorer, name)

    def render(self, camera: Camera, pose: Pose) -> NDArray[np.bool_]:
        """Returns the scorer's silhouette."""
        self.count += 1
        return self._scorer.render(camera, pose)

    def counts(
        self, camera: Camera, rotations: Floats, centers: Floats, mask: NDArray[np.bool_]
    ) -> IouCounts:
        """Returns the scorer's counts."""
        self.count += len(centers)
        return self._scorer.counts(camera, rotations, centers, mask)

    def fit(self, camera: Camera, rotations: Floats, centers: Floats, fit: Fit) -> Floats:
        """Returns the scorer's similarities."""
        self.count += len(centers)
        return self._scorer.fit(camera, rotations, centers, fit)


def make_trial(folder: Path) -> Trial:
    """Returns the trial; its photos are written to a folder."""
    scene = scene_of_blocks(_BLOCKS, _ORIGIN)
    scorer = make_renderer("silhouette", scene, 1)
    painter = cast(LayerRenderer, open_renderer("raster", scene, 1))
    queries, truths = [], []
    for k, (pitch, roll, yaw, *center) in enumerate(_TRUTHS):
        truth = Pose.from_euler(EulerAngles(pitch, roll, yaw), center)
        angles = EulerAngles(pitch, roll, yaw + _PRIOR_OFF_YAW_DEG)
        prior = Pose.from_euler(angles, truth.center + np.array(_PRIOR_OFF))
        photo = folder / f"view_{k}.png"
        cv2.imwrite(str(photo), painter.draw(_CAMERA, truth).colour[:, :, ::-1])
        mask = scorer.render(_CAMERA, truth).astype(np.float32)
        queries.append(Query(photo.name, "trial", _CAMERA, prior, mask, photo, (prior,)))
        truths.append(truth)
    return Trial(scorer, tuple(queries), tuple(truths))


def ask(method: Method, scorer: Scorer, query: Query, seed: int = 0) -> Estimate | QueryFault:
    """Returns a method's answer to a query, from streams made anew.

    Raises:
        Exception: Whatever the method raises that is no ``QueryFault``.
    """
    try:
        return method.localize(query, scorer, partial(random_stream, seed, "trial", query.name))
    except QueryFault as fault:
        return fault
