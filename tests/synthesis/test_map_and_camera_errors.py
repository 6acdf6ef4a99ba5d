"""Worlds that differ from their map: what is seen of buildings, by which lens, and how they are told."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from lodbench.citymodel import open_scene
from lodbench.errors import ConfigError
from lodbench.geometry import Camera
from lodbench.geometry.camera import MAKER
from lodbench.geometry.lens import distort
from lodbench.segmentation.masks import read_mask
from lodbench.synthesis.views import RGB_CAMERA, draw_through_lens
from lodbench.synthesis.views_dataset import Perturbation, ViewsParams, open_views
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
    after = heights(Perturbation(shared_roofs_m=1.5, hidden_feet_m=2.0).perturbed(scene))
    np.testing.assert_allclose(after - before, np.broadcast_to([2.0, 1.5], before.shape), atol=1e-4)
    assert Perturbation().perturbed(scene) is scene


def test_lenses_are_longer_and_shorter_in_turn():
    world = Perturbation(focal=0.03)
    stretches = [world.lens(RGB_CAMERA, view).fx / RGB_CAMERA.fx for view in range(4)]
    assert stretches == pytest.approx([1.03, 0.97, 1.03, 0.97])


def test_a_world_is_told_in_short():
    world = Perturbation.parse("shared_roofs=1.5,hidden_feet_m=2,focal=0.01,tilt=5")
    assert world == Perturbation(1.5, 2.0, 0.01, 5.0)
    assert world.describe() == "shared_roofs_m=1.5, hidden_feet_m=2, focal=0.01, tilt=5"
    assert Perturbation.parse("") == Perturbation()


@pytest.mark.parametrize(
    ("text", "words"),
    [("roofs=1", "roofs"), ("focal=long", "world.focal"), ("focal=2", "within"), ("tilt=nan", "within")],
)
def test_what_is_no_world(text, words):
    with pytest.raises(ConfigError, match=words):
        Perturbation.parse(text)


def test_views_of_a_world_stand_where_those_of_the_map_do(city):
    plain = open_views(ViewsParams(str(city), num_views=2, mask_iou=1.0))
    wrong = open_views(
        ViewsParams(
            str(city), num_views=2, mask_iou=1.0, world=Perturbation(hidden_feet_m=1.0, focal=0.02, tilt=5.0)
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


def test_principal_points_are_aside_in_turn():
    world = Perturbation(center=0.01)
    aside = [
        (lens.cx - RGB_CAMERA.cx, lens.cy - RGB_CAMERA.cy)
        for lens in (world.lens(RGB_CAMERA, i) for i in range(4))
    ]
    px = 0.01 * RGB_CAMERA.width
    assert aside == [pytest.approx(at) for at in ((px, 0), (0, px), (-px, 0), (0, -px))]


@pytest.mark.parametrize("k1", [-0.15, -0.05, 0.05])
def test_a_lens_shows_points_where_its_formula_puts_them(k1):
    lens = replace(Camera(600, 400, 500, 500, 300, 200), distortion=(k1, 0, 0, 0))

    def draw(pinhole):
        columns, rows = np.meshgrid(np.arange(600) + 0.5, np.arange(400) + 0.5)
        rays = ((columns - pinhole.cx) / pinhole.fx, (rows - pinhole.cy) / pinhole.fy)
        return np.stack([*rays, np.zeros_like(columns)], axis=-1).astype(np.float32)

    shown = draw_through_lens(draw, lens)[2:-2, 2:-2]
    x, y = distort(lens.lens, lens.distortion, *np.moveaxis(shown[..., :2].astype(float), -1, 0))
    columns, rows = np.meshgrid(np.arange(2, 598) + 0.5, np.arange(2, 398) + 0.5)
    np.testing.assert_allclose(500 * x + 300, columns, atol=0.05)
    np.testing.assert_allclose(500 * y + 200, rows, atol=0.05)


def test_masks_through_a_lens_keep_their_values():
    lens = replace(Camera(60, 40, 50, 50, 30, 20), distortion=(-0.1, 0, 0, 0))
    labels = np.random.default_rng(0).integers(-1, 5, (40, 60), dtype=np.int32)
    shown = draw_through_lens(lambda _: labels, lens)
    assert shown.dtype == labels.dtype
    assert shown.shape == (40, 60)
    assert np.isin(shown, labels).all()


def test_a_stated_camera_is_known_as_well_as_its_source_says(city):
    entries = open_views(ViewsParams(str(city), num_views=2, camera_source="maker")).entries
    assert {entry.camera_sigmas for entry in entries} == {MAKER}
    with pytest.raises(ConfigError, match="camera_source is one of calibration, maker, nominal"):
        ViewsParams(str(city), camera_source="guess")
