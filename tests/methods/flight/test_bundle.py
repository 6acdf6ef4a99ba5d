"""Bundle adjustment: a block of what photos share, right up to a similarity; wrong matches left out."""

import numpy as np
import pytest

from lodbench.geometry.pose import pose_from_vector, vector_from_pose
from lodbench.methods.flight.bundle import (
    _DAMPING,
    Observations,
    PairMatches,
    _linearized,
    _step,
    adjusted,
    block_of,
    observations_of,
)

FOCAL_PX = 900.0
SIGMAS = np.array([8.0, 8.0, 20.0, 1.0, 1.0, 5.0])


def poses_of(count):
    """Returns (P, 6) of two strips over a town, looking ahead and down."""
    generator = np.random.default_rng(2)
    along = 25.0 * (np.arange(count) % 4)
    aside = 30.0 * (np.arange(count) // 4)
    vectors = np.column_stack([along, aside, np.full(count, 100.0), np.tile([25.0, 0.0, 15.0], (count, 1))])
    return vectors + generator.normal(size=vectors.shape) * [2.0, 2.0, 2.0, 3.0, 0.4, 8.0]


def rays_of(vectors, points, noise_px=0.0):
    """Returns (P, T, 2) where photos show points, at depth 1, and whether they are in view."""
    generator = np.random.default_rng(3)
    shown = []
    for vector in vectors:
        pose = pose_from_vector(vector)
        local = (points - pose.center) @ pose.rotation.T
        shown.append(local[:, :2] / local[:, 2:])
    rays = np.array(shown)
    in_view = (np.abs(rays) < [0.6, 0.45]).all(axis=2)
    return rays + generator.normal(0.0, noise_px / FOCAL_PX, rays.shape), in_view


def pairs_of(rays, in_view, wrong=0.0):
    """Returns matches of all pairs of photos, a share of which are of other points."""
    generator, pairs = np.random.default_rng(4), []
    for first in range(len(rays)):
        for second in range(first + 1, min(first + 6, len(rays))):
            points = np.flatnonzero(in_view[first] & in_view[second])
            others = np.where(generator.random(len(points)) < wrong, generator.permutation(points), points)
            both = np.stack([rays[first, points], rays[second, others]])
            pairs.append(PairMatches(first, second, both * FOCAL_PX + 500.0, both))
    return pairs


def town_points(count=250):
    generator = np.random.default_rng(1)
    plane = generator.uniform([-60.0, 0.0], [140.0, 190.0], (count, 2))
    return np.column_stack([plane, generator.choice([0.0, 6.0, 15.0, 25.0], count)])


def misfit(poses, vectors):
    """Returns centres (P, 3) and turns (P,) that are off after the similarity that fits best."""
    truths = [pose_from_vector(vector) for vector in vectors]
    here, there = (np.array([pose.center for pose in each]) for each in (poses, truths))
    middles = here.mean(axis=0), there.mean(axis=0)
    left, sizes, right = np.linalg.svd((there - middles[1]).T @ (here - middles[0]))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    turn = left @ flip @ right
    scale = (sizes * np.diag(flip)).sum() / ((here - middles[0]) ** 2).sum()
    off_m = middles[1] + scale * (here - middles[0]) @ turn.T - there
    cosines = [
        (np.trace(pose.rotation @ turn.T @ truth.rotation.T) - 1.0) / 2.0
        for pose, truth in zip(poses, truths, strict=True)
    ]
    return off_m, np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))


@pytest.mark.parametrize("wrong", [0.0, 0.05])
def test_a_block_is_recovered_from_poses_that_are_metres_off(wrong):
    vectors = poses_of(8)
    rays, in_view = rays_of(vectors, town_points(400), noise_px=0.3)
    off = np.random.default_rng(5).uniform(-1.0, 1.0, vectors.shape) * [5.0, 5.0, 8.0, 0.6, 0.6, 3.0]
    pairs = pairs_of(rays, in_view, wrong)
    found = block_of(pairs, vectors + off, SIGMAS, FOCAL_PX)
    assert list(found) == list(range(8))
    # What is left is what features err by: from the truth it ends there too.
    from_truth = block_of(pairs, vectors, SIGMAS, FOCAL_PX)
    ends = np.array([vector_from_pose(pose) for pose in from_truth.values()])
    apart_m, apart_deg = misfit(list(found.values()), ends)
    assert np.abs(apart_m).max() < 0.08
    assert apart_deg.max() < 0.05
    off_m, off_deg = misfit(list(found.values()), vectors)
    assert np.linalg.norm(off_m, axis=1).max() < 0.15
    assert off_deg.max() < 0.2
    # Before, it was none.
    before_m, _ = misfit([pose_from_vector(vector) for vector in vectors + off], vectors)
    assert np.linalg.norm(before_m, axis=1).max() > 3.0


def test_exact_points_leave_exact_poses_where_they_are():
    vectors = poses_of(6)
    rays, in_view = rays_of(vectors, town_points())
    found, members = adjusted(observations_of(pairs_of(rays, in_view)), vectors, SIGMAS, FOCAL_PX)
    np.testing.assert_allclose(found, vectors, atol=1e-4)
    np.testing.assert_array_equal(members, np.arange(6))


def test_a_photo_that_shares_little_is_no_part_of_the_block():
    vectors = poses_of(6)
    rays, in_view = rays_of(vectors, town_points())
    in_view[4, np.flatnonzero(in_view[4])[10:]] = False
    found = block_of(pairs_of(rays, in_view), vectors, SIGMAS, FOCAL_PX)
    assert list(found) == [0, 1, 2, 3, 5]
    assert block_of([], vectors, SIGMAS, FOCAL_PX) == {}


def test_photos_from_one_place_are_no_block():
    """No ray meets another at an angle: no point has a depth."""
    vectors = np.repeat(poses_of(1), 4, axis=0)
    vectors[:, 5] += [0.0, 4.0, 8.0, 12.0]
    rays, in_view = rays_of(vectors, town_points())
    assert block_of(pairs_of(rays, in_view), vectors, SIGMAS, FOCAL_PX) == {}


def matches(first, second, places):
    """Returns the matches of a pair, features named by a number in either photo."""
    pixels = np.array(places, dtype=np.float64).T[..., None] * [1.0, 2.0]
    return PairMatches(first, second, pixels, pixels / FOCAL_PX)


def test_features_that_match_through_others_are_one_point_and_two_in_a_photo_are_none():
    chain = [matches(0, 1, [(10, 20), (11, 21)]), matches(1, 2, [(20, 30)]), matches(0, 2, [(12, 32)])]
    seen = observations_of(chain)
    by_point = {}
    for photo, point, ray in zip(seen.photos, seen.points, seen.rays, strict=True):
        by_point.setdefault(int(point), []).append((int(photo), round(float(ray[0] * FOCAL_PX))))
    tracks = sorted(sorted(track) for track in by_point.values())
    assert tracks == [[(0, 10), (1, 20), (2, 30)], [(0, 11), (1, 21)], [(0, 12), (2, 32)]]
    assert sorted(by_point) == [0, 1, 2]
    # A match of 0's 11 with 2's 30 makes one track of two, which has both 10 and 11 in photo 0.
    seen = observations_of([*chain, matches(0, 2, [(11, 30)])])
    np.testing.assert_array_equal(seen.photos, [0, 2])
    np.testing.assert_allclose(seen.rays[:, 0] * FOCAL_PX, [12.0, 32.0])


def test_points_of_one_photo_alone_are_left_out():
    photos, points = np.array([0, 1, 2, 0, 1, 3]), np.array([0, 0, 1, 2, 2, 2])
    seen = Observations(photos, points, np.arange(12.0).reshape(6, 2))
    kept = seen.of(np.array([True, False, True, True, True, True]))
    np.testing.assert_array_equal(kept.photos, [0, 1, 3])
    np.testing.assert_array_equal(kept.points, [0, 0, 0])
    np.testing.assert_array_equal(kept.rays, seen.rays[3:])


def test_slopes_are_differences_and_eliminating_points_gives_the_dense_step():
    vectors, points = poses_of(3), town_points(25)
    rays, in_view = rays_of(vectors, points, noise_px=3.0)
    in_view[:] = True
    photos, numbers = (part.ravel() for part in np.indices(in_view.shape))
    seen = Observations(photos, numbers, rays.reshape(-1, 2))
    of_pose, of_point, residuals = _linearized(seen, vectors, points)
    size = 6 * len(vectors) + 3 * len(points)
    unknowns = np.concatenate([vectors.ravel(), points.ravel()])

    def residuals_at(values):
        return _linearized(seen, values[:18].reshape(-1, 6), values[18:].reshape(-1, 3))[2].ravel()

    slopes = np.zeros((residuals.size, size))
    rows = np.arange(residuals.size).reshape(-1, 2)
    for k in range(len(photos)):
        slopes[np.ix_(rows[k], 6 * photos[k] + np.arange(6))] = of_pose[k]
        slopes[np.ix_(rows[k], 18 + 3 * numbers[k] + np.arange(3))] = of_point[k]
    numeric = np.stack(
        [
            (residuals_at(unknowns + step) - residuals_at(unknowns - step)) / 2e-5
            for step in 1e-5 * np.eye(size)
        ],
        axis=1,
    )
    np.testing.assert_allclose(slopes, numeric, atol=1e-7)
    reach, start = 4.0 / FOCAL_PX, vectors + 0.1
    weights = np.repeat(1.0 / (1.0 + (residuals**2).sum(axis=1) / reach**2) / reach**2, 2)
    matrix, gradient = (slopes.T * weights) @ slopes, (slopes.T * weights) @ residuals.ravel()
    precisions = np.append(np.tile(SIGMAS**-2.0, 3), np.zeros(3 * len(points)))
    matrix += np.diag(precisions)
    # Points are damped, by a millionth of their curvature.
    for point in range(len(points)):
        own = 18 + 3 * point + np.arange(3)
        matrix[own, own] += _DAMPING * matrix[own, own].sum() + 1e-12
    gradient[:18] += precisions[:18] * (vectors - start).ravel()
    expected = -np.linalg.solve(matrix, gradient)
    poses, moved, _ = _step(seen, vectors, points, start, SIGMAS, reach)
    np.testing.assert_allclose(poses.ravel(), expected[:18], atol=1e-6)
    np.testing.assert_allclose(moved.ravel(), expected[18:], atol=1e-6)
