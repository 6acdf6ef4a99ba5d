"""The model's lines on a photo's edges: they know the pose where the map is exact, and whether it is."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest

from lodbench.evaluation import pose_error
from lodbench.methods.contour_alignment.pose_vector import pose_from_vector, vector_from_pose
from lodbench.methods.region import Params, Region
from lodbench.methods.region.lines import LineFit
from lodbench.storage import random_stream
from tests.town import CAMERA

SHADES = np.array([[0, 0, 0], [60, -10, 20], [-30, 40, 10], [20, 50, -40]], dtype=np.float64)


@pytest.fixture(scope="module")
def shaded(city_map, truths):
    """Returns photos of the town whose faces are lit by where they look, by truth."""
    photos = []
    for number, truth in enumerate(truths):
        normals = city_map.normals(CAMERA, truth.rotation[None], truth.center[None])[0]
        shade = np.where(np.abs(normals) > 0.5, [1, 2, 3], 0).max(axis=2)
        noise = random_stream(0, "shaded", number).normal(0.0, 6.0, (CAMERA.height, CAMERA.width, 3))
        photos.append(np.clip(110.0 + SHADES[shade] + noise, 0, 255).astype(np.uint8))
    return photos


def fit_of(photo, query, city_map, truth):
    return LineFit(photo, query, city_map, vector_from_pose(truth), 1.0, Params())


def test_lines_fit_best_at_the_truth(city_map, queries, truths, shaded):
    moves = np.concatenate([d * np.eye(6) * [1.5, 1.5, 4.0, 1.0, 1.0, 1.0] for d in (-1.0, 1.0)])
    for photo, query, truth in zip(shaded, queries, truths, strict=True):
        fit, vector = fit_of(photo, query, city_map, truth), vector_from_pose(truth)
        assert len(fit) > 100
        assert (fit(vector[None]) > fit(vector + moves)).all()


def test_an_exact_map_is_sharp_and_a_smeared_photo_is_not(city_map, queries, truths, shaded):
    photo, query, truth = shaded[0], queries[0], truths[0]
    vector = vector_from_pose(truth)
    assert fit_of(photo, query, city_map, truth).sharpness(vector) > Params().least_sharpness
    # Two outlines 8 pixels apart, as of walls and eaves where the map has one: no line is where edges are.
    smeared = cv2.GaussianBlur(photo, (0, 0), 5.0)
    assert fit_of(smeared, query, city_map, truth).sharpness(vector) < Params().least_sharpness


def test_the_method_ends_nearer_with_lines(city_map, queries, truths, shaded, tmp_path):
    errors = {0.0: [], Params().lines_weight: []}
    for number, (query, truth) in enumerate(zip(queries, truths, strict=True)):
        path = tmp_path / f"{number}.png"
        cv2.imwrite(str(path), shaded[number])
        for weight, found in errors.items():
            method = Region(Params(fine_width=200, starts=4, modes=2, lines_weight=weight, mean_pixels=0))
            photographed = replace(query, building_probability=None, image=path)
            estimate = method.localize(photographed, city_map, partial(random_stream, 0, "test"))
            found.append(pose_error(estimate.pose, truth).translation_m)
    without, with_lines = (np.median(found) for found in errors.values())
    assert with_lines < min(0.3, without)


def test_a_pose_without_lines_in_view_counts_nothing(city_map, queries, truths, shaded):
    away = vector_from_pose(truths[0]) + np.array([5000.0, 0, 0, 0, 0, 0])
    fit = LineFit(shaded[0], queries[0], city_map, away, 1.0, Params())
    assert len(fit) == 0
    assert fit.sharpness(away) == 0.0
    assert pose_from_vector(away).center[0] > 4000.0
