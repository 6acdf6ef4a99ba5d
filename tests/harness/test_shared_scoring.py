"""Scores of a grid shared out over workers: those of one process, whatever comes back first."""

import numpy as np

from lodbench.geometry import Camera, Pose, rotations_at_yaws
from lodbench.harness.runs.predict import SharedScorer, score
from lodbench.rendering import BoundaryFit, IouFit
from lodbench.rendering.silhouette import SilhouetteRenderer
from tests.rendering.hostile_scenes import box, scene_of
from tests.town import BOXES

CAMERA = Camera(96, 72, 90.0, 90.0, 48.0, 36.0)


class Backwards:
    """Workers in this process, the last of whom is done first."""

    count = 3

    def __init__(self) -> None:
        self.items = 0

    def map(self, work, items):
        items = list(items)
        self.items += len(items)
        return map(work, reversed(items))


def test_large_calls_are_shared_and_small_ones_are_not() -> None:
    blocks = [box((w, s, b), (e - w, n - s, t - b)) for w, s, e, n, b, t in BOXES]
    own, workers = SilhouetteRenderer(scene_of(*blocks), 1), Backwards()
    shared = SharedScorer(own, workers, lambda part: score(own, part), part=16)
    rng = np.random.default_rng(0)
    centers = rng.uniform((-30, -30, 40), (30, 30, 90), (101, 3))
    rotations = rotations_at_yaws(30.0, 0.0, rng.uniform(-180, 180, 101))
    mask = own.render(CAMERA, Pose.from_center(rotations[3], centers[3]))
    assert mask.any()
    found, expected = (each.counts(CAMERA, rotations, centers, mask) for each in (shared, own))
    assert np.array_equal(found.intersection, expected.intersection)
    assert np.array_equal(found.union, expected.union)
    assert len(set(expected.intersection)) > 10
    assert workers.items == 7
    for fit in (IouFit(mask), BoundaryFit(mask)):
        assert np.array_equal(
            shared.fit(CAMERA, rotations, centers, fit), own.fit(CAMERA, rotations, centers, fit)
        )
    assert workers.items == 21
    shared.fit(CAMERA, rotations[:31], centers[:31], fit)
    shared.counts(CAMERA, rotations[:31], centers[:31], mask)
    assert workers.items == 21
    assert shared.threads == own.threads
