"""Networks that match pictures, built from configurations with random weights: shapes, ways back, faults."""

import numpy as np
import pytest

from lodbench.errors import ConfigError
from lodbench.matching import open_matcher, open_matching
from lodbench.matching.protocol import make_pair

pytest.importorskip("transformers")
pytest.importorskip("kornia")

NAMES = ["superpoint_superglue", "superpoint_lightglue", "disk_lightglue", "eloftr", "matchanything"]


def pictures():
    stream = np.random.default_rng(0)
    return stream.integers(0, 255, (90, 120, 3), np.uint8), stream.integers(0, 255, (100, 150, 3), np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*NAMES, "loftr"])
def test_random_weights_give_matches_in_both_pictures_the_same_each_time(name):
    first, second = pictures()
    found, again = (
        open_matcher(name, weights="random", size=96, threshold=0.0).match(first, second) for _ in range(2)
    )
    assert np.array_equal(found.first, again.first)
    assert ((found.first >= 0) & (found.first <= (120, 90))).all()
    assert ((found.second >= 0) & (found.second <= (150, 100))).all()


@pytest.mark.parametrize("name", NAMES)
def test_weights_that_were_not_fetched_are_told_in_a_line(name, monkeypatch, tmp_path):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(ConfigError, match=r"are not at .*models--.* MB\)") as raised:
        open_matching(name)
    assert "hf download" in raised.value.hint


def test_loftr_wants_a_file():
    with pytest.raises(ConfigError, match="46 MB"):
        open_matching("loftr")


def test_a_saved_network_is_read_back(tmp_path):
    matcher = open_matcher("eloftr", weights="random", size=64, threshold=0.0)
    matcher._net.save_pretrained(tmp_path)
    stored = open_matcher("eloftr", weights=str(tmp_path), size=64, threshold=0.0)
    assert [file.name for file in stored.weight_files()] == ["model.safetensors"]
    first, second = pictures()
    assert np.array_equal(stored.match(first, second).first, matcher.match(first, second).first)


@pytest.mark.parametrize("longest", [64, 1000])
def test_places_of_a_pair_go_back_to_the_originals(longest):
    first, second = pictures()
    pair = make_pair(first, second, longest, 32)
    assert pair.pictures.shape[1] % 32 == pair.pictures.shape[2] % 32 == 0
    scale = min(1.0, longest / 150)
    # The middle of the second picture, where the first pixel's centre is 0.
    place = np.array([[150 * scale / 2 - 0.5, 100 * scale / 2 - 0.5]])
    found, inside = pair.original(place, 1)
    assert found[0] == pytest.approx([75, 50], abs=1.0)
    assert inside.all()
    beyond = np.array([[pair.pictures.shape[2] - 1, 0]])
    assert not pair.original(beyond, 0)[1].any()


def test_settings_out_of_range_are_refused():
    with pytest.raises(ConfigError):
        open_matcher("eloftr", size=8)
