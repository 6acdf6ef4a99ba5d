"""Worlds that differ from their map: what is seen of buildings, by which lens, and how they are told."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from lodbench.citymodel import open_scene
from lodbench.errors import ConfigError
from lodbench.segmentation.masks import read_mask
from lodbench.synthesis.view_sampling import RGB_CAMERA
from lodbench.synthesis.views_dataset import ViewsParams, World, open_views
from tests.town import box_obj


@pytest.fixture(scope="module")
def city(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("town") / "city.obj"
    path.write_text(box_obj())
    return path


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch) -> None:
    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path_factory.getbasetemp() / "world-cache"))


def heights(scene):
    """Returns the floor and the top of each building, metres."""
    parts = [scene.vertices[first:last, 2] for first, last in pairwise(scene.vertex_starts)]
    return np.array([[part.min(), part.max()] for part in parts])


def test_roofs_rise_together_and_feet_are_cut(city):
    scene = open_scene(city)
    before = heights(scene)
    after = heights(World(shared_roofs_m=1.5, hidden_feet_m=2.0).seen(scene))
    np.testing.assert_allclose(after - before, np.broadcast_to([2.0, 1.5], before.shape), atol=1e-4)
    assert World().seen(scene) is scene


def test_lenses_are_longer_and_shorter_in_turn():
    world = World(focal=0.03)
    stretches = [world.lens(RGB_CAMERA, view).fx / RGB_CAMERA.fx for view in range(4)]
    assert stretches == pytest.approx([1.03, 0.97, 1.03, 0.97])


def test_a_world_is_told_in_short():
    world = World.parse("shared_roofs=1.5,hidden_feet_m=2,focal=0.01,tilt=5")
    assert world == World(1.5, 2.0, 0.01, 5.0)
    assert world.describe() == "shared_roofs_m=1.5, hidden_feet_m=2, focal=0.01, tilt=5"
    assert World.parse("") == World()


@pytest.mark.parametrize(
    ("text", "words"),
    [("roofs=1", "roofs"), ("focal=long", "world.focal"), ("focal=2", "within"), ("tilt=nan", "within")],
)
def test_what_is_no_world(text, words):
    with pytest.raises(ConfigError, match=words):
        World.parse(text)


def test_views_of_a_world_stand_where_those_of_the_map_do(city):
    plain = open_views(ViewsParams(str(city), num_views=2, mask_iou=1.0))
    wrong = open_views(
        ViewsParams(
            str(city), num_views=2, mask_iou=1.0, world=World(hidden_feet_m=1.0, focal=0.02, tilt=5.0)
        )
    )
    for before, after in zip(plain.entries, wrong.entries, strict=True):
        truth = plain.truth[before.key]
        np.testing.assert_array_equal(truth.cam_from_world, wrong.truth[after.key].cam_from_world)
        # The lens that is told is the same; what is seen is not.
        assert before.camera == after.camera
        assert (read_mask(before.mask) != read_mask(after.mask)).any()
        errors = [np.subtract(entry.prior.euler, truth.euler)[:2] for entry in (before, after)]
        np.testing.assert_allclose(errors[1], 5.0 * errors[0], atol=1e-6)
