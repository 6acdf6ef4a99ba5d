"""Edges of roofs: which there are, and at which height photos have them."""

import cv2
import numpy as np
import pytest

from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.methods.flight.roof_edges import SweepPicture, edge_evidence
from lodbench.methods.flight.roof_sweep import edge_points

HEIGHTS_M = np.arange(-4.0, 4.01, 0.25)
CAMERA = Camera(320, 240, 230.0, 228.0, 161.0, 118.5)


def quads(*corners):
    """Returns two triangles of each quadrangle."""
    return np.array([t for a, b, c, d in corners for t in ((a, b, c), (a, c, d))], dtype=np.float64)


def box(width, depth, top):
    floor, roof = ([(0, 0, z), (width, 0, z), (width, depth, z), (0, depth, z)] for z in (0, top))
    walls = [(floor[i], floor[i - 3], roof[i - 3], roof[i]) for i in range(4)]
    return quads(floor[::-1], roof, *walls)


def test_a_flat_roof_has_its_outline_and_no_diagonal():
    points = edge_points(box(8.0, 6.0, 5.0))
    x, y = points[:, 0], points[:, 1]
    assert len(points) == 2 * (16 + 12)
    assert (np.isclose(x, 0) | np.isclose(x, 8) | np.isclose(y, 0) | np.isclose(y, 6)).all()
    assert np.allclose(points[:, 2:4], (5.0, 1.0))
    # Along the edge.
    assert np.allclose(np.abs(points[:, 4:]).sum(axis=1), 1.0)
    assert np.allclose(np.abs(points[np.isclose(x, 0), 4:6]), (0, 1))


def test_a_gable_has_a_ridge_and_eaves_that_rise_less():
    a, b, c, d, e, f = (0, 0, 3), (4, 0, 3), (4, 6, 3), (0, 6, 3), (2, 0, 5), (2, 6, 5)
    floor = [(0, 0, 0), (0, 6, 0), (4, 6, 0), (4, 0, 0)]
    points = edge_points(quads(floor, (a, e, f, d), (b, c, f, e)))
    ridge, eaves = np.isclose(points[:, 2], 5.0), np.isclose(points[:, 2], 3.0)
    assert ridge.sum() == 12
    assert eaves.sum() == 24
    assert np.allclose(points[ridge, 3], 1.0)
    assert np.allclose(points[eaves, 3], 0.6)


@pytest.mark.parametrize("triangles", [np.zeros((0, 3, 3)), np.array([[[0, 0, 0], [4, 0, 0], [4, 0, 3.0]]])])
def test_walls_alone_have_no_edges_of_a_roof(triangles):
    assert edge_points(triangles).shape == (0, 7)


@pytest.mark.parametrize("higher_m", [0.0, 2.0, -1.5])
def test_a_roof_of_one_colour_is_found_where_photos_have_its_edges(higher_m):
    edges = {7: edge_points(box(20.0, 14.0, 10.0)), 9: np.zeros((0, 7))}
    pictures = [picture(yaw_deg, 10.0 + higher_m) for yaw_deg in (0.0, 120.0, 240.0)]
    near = [np.array([7, 9])] * 3
    is_seen = [np.ones(len(edges[7]), bool)] * 2 + [np.zeros(len(edges[7]), bool)]
    found = edge_evidence(pictures, near, edges, is_seen, HEIGHTS_M)
    assert list(found) == [7]
    assert (found[7].photos, found[7].seen) == (2, 2 * len(edges[7]))
    nats = found[7].nats()
    assert HEIGHTS_M[np.argmax(nats)] == pytest.approx(higher_m, abs=0.3)
    assert nats.max() - np.median(nats) > 2.0


def picture(yaw_deg: float, top_m: float) -> SweepPicture:
    """A photo of a plain roof on plain ground, a little noise on both, from 60 m away."""
    turn = Pose.from_euler(EulerAngles(40.0, 0.0, yaw_deg), (0.0, 0.0, 0.0)).rotation
    pose = Pose.from_center(turn, np.array([10.0, 7.0, top_m]) - 60.0 * turn[2])
    roof = np.array([(0, 0), (20, 0), (20, 14), (0, 14)], dtype=np.float64)
    shown = SweepPicture(CAMERA, 0.0, pose, np.full((240, 320, 4), 90, np.uint8))
    pixels, _ = shown.project(np.column_stack([roof, np.full(4, top_m)]))
    drawn = shown.pixels.copy()
    cv2.fillPoly(drawn, [np.rint(16 * (pixels - 0.5)).astype(np.int32)], (130, 100, 95, 255), shift=4)
    noise = np.random.default_rng(int(yaw_deg)).normal(0.0, 3.0, drawn.shape)
    drawn = cv2.GaussianBlur(np.clip(drawn + noise, 0, 255).astype(np.uint8), (0, 0), 0.8)
    return SweepPicture(CAMERA, 0.0, pose, drawn)
