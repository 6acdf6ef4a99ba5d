"""Masks kept in the cache: damage of any kind is told, and the mask made anew."""

import numpy as np
import pytest

from lodbench.segmentation import photo_segmenter as mask_cache
from lodbench.segmentation.photo_segmenter import cached_probability
from lodbench.storage.paths import cache_root

pytestmark = pytest.mark.attack


@pytest.fixture
def photo(tmp_path, monkeypatch):
    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path / "cache"))
    path = tmp_path / "photo.jpg"
    path.write_bytes(b"a photo")
    return path


def test_flipped_bits_never_change_a_mask(photo, caplog):
    probability = np.linspace(0, 1, 48 * 64, dtype=np.float32).reshape(48, 64)
    asked: list[bytes] = []

    def compute(content):
        asked.append(content)
        return probability

    whole = cached_probability(photo, "network", compute)
    assert np.abs(whole - probability).max() < 1e-5
    (file,) = (cache_root() / "segmentations").iterdir()
    content, told = file.read_bytes(), 0
    # The archive's and the array's headers, the values and the archive's directory.
    for place in [
        *range(0, 240, 3),
        *range(240, len(content), 97),
        *range(len(content) - 130, len(content), 3),
    ]:
        damaged = bytearray(content)
        damaged[place] ^= 1 << place % 8
        file.write_bytes(damaged)
        asked.clear()
        assert (cached_probability(photo, "network", compute) == whole).all(), place
        told += bool(asked)
        assert bool(asked) == ("is damaged" in caplog.text), place
        caplog.clear()
    assert told > 100


@pytest.mark.parametrize("change", ["_LIBRARIES", "__file__"])
def test_other_code_makes_its_own_mask(photo, monkeypatch, tmp_path, change):
    mask_cache._code_digest.cache_clear()
    cached_probability(photo, "network", lambda content: np.zeros((4, 4), np.float32))
    (tmp_path / "photos.py").write_text("# changed\n")
    monkeypatch.setattr(mask_cache, change, ("scipy",) if change == "_LIBRARIES" else str(tmp_path / "x.py"))
    mask_cache._code_digest.cache_clear()
    try:
        found = cached_probability(photo, "network", lambda content: np.ones((4, 4), np.float32))
    finally:
        mask_cache._code_digest.cache_clear()
    assert (found == 1).all()
