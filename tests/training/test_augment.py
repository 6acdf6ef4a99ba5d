"""Other paints, light and sensors: pictures change, places do not."""

import numpy as np
import pytest

from lodbench.training import augment as appearance
from lodbench.training.augment import covered, other_appearance


@pytest.fixture
def view():
    """A textured ground with two buildings, and its mask."""
    generator = np.random.default_rng(0)
    photo = generator.integers(60, 120, (64, 80, 3), dtype=np.uint8)
    mask = np.zeros((64, 80), np.float32)
    mask[10:40, 8:30] = mask[20:60, 50:75] = 1
    photo[mask > 0] //= 2
    return photo, mask


def test_the_same_seed_gives_the_same_picture_and_another_seed_another(view):
    pictures = [other_appearance(*view, np.random.default_rng(seed)) for seed in (1, 1, 2)]
    assert pictures[0].dtype == np.float32
    assert pictures[0].shape == (64, 80, 3)
    np.testing.assert_array_equal(pictures[0], pictures[1])
    assert np.abs(pictures[0] - pictures[2]).mean() > 0.01


def test_every_picture_is_within_range_and_shows_something(view):
    for seed in range(60):
        picture = other_appearance(*view, np.random.default_rng(seed))
        assert 0 <= picture.min() <= picture.max() <= 1
        assert picture.std() > 1e-3


def test_paint_changes_buildings_alone_and_each_its_own_way(view):
    photo, mask = view
    picture = photo.astype(np.float32) / 255
    shifts = []
    for seed in range(12):
        painted = appearance._repainted(picture, mask, np.random.default_rng(seed))
        np.testing.assert_array_equal(painted[mask == 0], picture[mask == 0])
        shifts.append(
            [(painted - picture)[part].mean() for part in (np.s_[10:40, 8:30], np.s_[20:60, 50:75])]
        )
    assert np.abs(np.diff(shifts, axis=1)).max() > 0.1


def test_hue_turns_about_the_greys_and_saturation_stays_within_its_range():
    grey = np.full((4, 4, 3), 0.4, np.float32)
    chroma = np.array([0.3, -0.1, -0.2], np.float32)
    chroma -= chroma @ appearance._LUMA
    for seed in range(8):
        unchanged = appearance._other_colours(grey, np.random.default_rng(seed))
        np.testing.assert_allclose(unchanged, grey, atol=1e-6)
        turned = appearance._other_colours(grey + chroma, np.random.default_rng(seed)) - grey
        lengths = np.linalg.norm(turned, axis=-1) / np.linalg.norm(chroma)
        assert lengths.max() - lengths.min() < 1e-4
        assert 0 <= lengths[0, 0] <= 1.6 + 1e-4


def test_plants_are_bright_in_near_infrared():
    leaves, roof = np.zeros((2, 2, 3), np.float32), np.full((2, 2, 3), 0.3, np.float32)
    leaves[..., 1], leaves[..., 0] = 0.3, 0.1
    generator = np.random.default_rng(0)
    infrared = [appearance._near_infrared(part, generator)[0, 0, 0] for part in (leaves, roof)]
    assert infrared[0] > infrared[1]


def test_ground_of_photos_covers_the_ground_and_now_and_then_a_roof(view):
    photo, mask = view
    grounds = (np.full_like(photo, 255), np.full_like(photo, 255))
    roofs = []
    for seed in range(20):
        changed = covered(photo, mask, grounds, np.random.default_rng(seed)).astype(int) - photo
        assert changed[mask == 0].mean() > 10
        roofs.append(changed[mask == 1].mean())
    assert min(roofs) == 0
    assert max(roofs) > 10
