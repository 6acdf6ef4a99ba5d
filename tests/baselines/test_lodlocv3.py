"""LoD-Loc v3: Dice by a slow independent count, its search on the tiny town, and what it is for."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from lodbench.baselines.lodlocv3 import LodLocV3, LodLocV3Params
from lodbench.baselines.lodlocv3.instance_fit import InstanceFit, label_image

from lodbench.datasets.inputs import masks_of_labels
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.errors import ConfigError, QueryFault
from lodbench.evaluation.pose_errors import pose_error
from lodbench.geometry import Camera
from lodbench.methods import Input
from lodbench.storage import random_stream
from tests.town import CAMERA

STREAMS = partial(random_stream, 0, "test")
QUICK = LodLocV3Params(coarse_size=(160, 120), fine_size=(160, 120), steps=10)
SMALL = Camera(23, 17, 20.0, 20.0, 11.5, 8.5)


@pytest.fixture(scope="module")
def asked(queries, city_map, truths):
    """The queries with the buildings seen at the truth."""
    seen = [city_map.buildings(CAMERA, t.rotation[None], t.center[None])[0] for t in truths]
    return [replace(q, instances=masks_of_labels(s + 1)) for q, s in zip(queries, seen, strict=True)]


def slow_fit(masks: np.ndarray, view: np.ndarray, weights: str) -> float:
    """The same sum of maxima, mask by mask."""
    sizes, best = [], []
    for mask in masks:
        rows, columns = np.nonzero(mask)
        box = (rows.max() - rows.min() + 1) * (columns.max() - columns.min() + 1)
        sizes.append({"box": box, "area": len(rows), "equal": 1}[weights])
        drawn = [view == b for b in np.unique(view[view >= 0])]
        best.append(max((2 * (mask & d).sum() / (mask.sum() + d.sum()) for d in drawn), default=0.0))
    return float(np.dot(sizes, best) / np.sum(sizes))


@pytest.mark.parametrize("weights", ["box", "area", "equal"])
@pytest.mark.parametrize("seed", range(4))
def test_the_fit_is_a_slow_count(weights, seed):
    generator = np.random.default_rng(seed)
    labels = generator.integers(0, 6, (17, 23))
    masks = masks_of_labels(labels)
    views = generator.choice([-1, 4, 90, 91, 1000], (5, 17, 23)).astype(np.int32)
    views[4] = -1
    found = InstanceFit(masks, SMALL, weights)(views)
    assert found == pytest.approx([slow_fit(masks, view, weights) for view in views], abs=1e-12)
    own = np.where(labels > 0, labels * 11, -1).astype(np.int32)
    assert InstanceFit(masks, SMALL, weights)(own[None]) == pytest.approx([1.0])


def test_a_label_image_takes_what_covers_most():
    masks = np.zeros((3, 8, 8), bool)
    masks[0, :, :3] = True
    masks[1, :, 3:] = True
    masks[2, 0, 0] = True  # a quarter of a pixel: nobody's
    assert label_image(masks, 4, 4).tolist() == [[0, 0, 1, 1]] * 4
    assert (label_image(masks[2:], 4, 4) == -1).all()


def test_it_finds_every_pose_with_true_tilt(asked, city_map, truths):
    for query, truth in zip(asked, truths, strict=True):
        error = pose_error(LodLocV3(QUICK).localize(query, city_map, STREAMS).pose, truth)
        assert error.translation_m < 2.0
        assert error.rotation_deg < 0.8


def test_it_tells_views_apart_that_have_one_silhouette():
    """Where buildings fill the picture every silhouette is alike; which building is where is not."""
    camera = Camera(40, 30, 400.0, 400.0, 20.0, 15.0)
    labels = np.zeros((30, 40), np.int32)
    labels[:, 22:] = 1
    views = np.stack([labels, np.roll(labels, -6, axis=1), np.zeros_like(labels)])
    fit = InstanceFit(masks_of_labels(labels + 1), camera)(views)
    assert fit[0] == 1.0
    assert fit[0] > fit[1] > fit[2]


def test_no_buildings_and_none_that_fit_are_faults(asked, city_map):
    for masks in (None, np.zeros((0, 240, 320), bool), np.zeros((2, 240, 320), bool)):
        with pytest.raises(QueryFault, match="building"):
            LodLocV3(QUICK).localize(replace(asked[0], instances=masks), city_map, STREAMS)
    away = asked[0].prior.shifted(np.array([9000.0, 0.0, 0.0]))
    with pytest.raises(QueryFault, match="no hypothesis overlaps a building"):
        LodLocV3(QUICK).localize(replace(asked[0], prior=away), city_map, STREAMS)


def test_the_grid_is_ranked_by_silhouettes_or_instances(asked, city_map):
    coarse = {"coarse_size": (80, 60), "variant": "no_refine"}
    city_map.usage.take()
    for select, kind in (("silhouette", "fit"), ("instances", "buildings")):
        found = LodLocV3(replace(QUICK, select=select, **coarse)).localize(asked[0], city_map, STREAMS)
        assert city_map.usage.take() == {kind: 504}
        assert 0 < found.score <= 1


def test_the_grid_compares_silhouettes_by_the_fit_that_is_asked_for(asked, city_map):
    coarse = {"coarse_size": (80, 60), "variant": "no_refine"}
    scores = [
        LodLocV3(replace(QUICK, fit=fit, **coarse)).localize(asked[0], city_map, STREAMS).score
        for fit in ("iou", "boundary")
    ]
    assert scores[0] != scores[1]


def test_a_fit_that_looks_at_the_photo_requires_it():
    assert LodLocV3().requires == {Input.INSTANCES}
    assert LodLocV3(LodLocV3Params(fit="region")).requires == {Input.INSTANCES, Input.IMAGE}


@pytest.mark.parametrize("unused", [{"select": "instances"}, {"fine_size": (301, 224)}])
def test_a_fit_that_nothing_would_use_is_refused(unused):
    with pytest.raises(ConfigError, match=r"method\.fit=boundary compares silhouettes"):
        LodLocV3Params(fit="boundary", **unused)


def test_settings():
    with pytest.raises(ConfigError, match=r"method\.weights=boxes") as caught:
        LodLocV3Params(weights="boxes")
    assert "box" in caught.value.hint
    wide = LodLocV3().params_for_prior(UniformPrior(x_m=30.0, y_m=30.0, z_m=30.0, yaw_deg=7.5))
    assert isinstance(wide, LodLocV3Params)
    assert wide.range_x_m == 60.0
