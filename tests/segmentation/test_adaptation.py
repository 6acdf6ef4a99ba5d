"""A photo's own colours add roofs like those the network is sure of, and nothing where they say nothing."""

import numpy as np
from scipy.special import expit

from lodbench.segmentation.efficient_unet import adapted

HEIGHT, WIDTH = 225, 300
GROUND, ROOF = (70, 120, 60), (150, 150, 165)


def photo_of(truth, generator, colours=(GROUND, ROOF), scale=1):
    """A photo of a mask in two colours, with noise, ``scale`` times as large."""
    picture = np.where(truth[..., None], colours[1], colours[0]) + generator.normal(0, 8, (*truth.shape, 3))
    return np.clip(picture, 0, 255).astype(np.uint8).repeat(scale, 0).repeat(scale, 1)


def town():
    """A mask of two halls of the same roof, and logits that are sure of one and doubt the other."""
    truth = np.zeros((HEIGHT, WIDTH), bool)
    truth[40:110, 30:130] = truth[120:200, 170:270] = True
    logits = np.where(truth, 3.0, -3.0).astype(np.float32)
    logits[120:200, 170:270] = -0.8
    return truth, logits


def iou(one, other):
    return (one & other).sum() / (one | other).sum()


def test_a_roof_that_the_network_doubts_is_found_by_the_colour_of_one_it_is_sure_of():
    truth, logits = town()
    photo = photo_of(truth, np.random.default_rng(0), scale=2)
    assert iou(logits > 0, truth) < 0.5
    found = adapted(logits, photo, 0.6)
    assert found.shape == logits.shape
    assert found.dtype == np.float32
    assert iou(found > 0, truth) > 0.97


def test_even_pictures_and_no_weight_change_no_decision():
    truth, logits = town()
    grey = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    np.testing.assert_array_equal(adapted(logits, photo_of(truth, np.random.default_rng(0)), 0.0), logits)
    # A classifier that sees no difference says the share of each class at most: here far from a doubt.
    np.testing.assert_array_equal(adapted(logits, grey, 0.6) > 0, logits > 0)


def test_no_building_is_taught_by_a_few_pixels():
    logits = np.full((HEIGHT, WIDTH), -4.0, np.float32)
    logits[100:105, 100:105] = 4.0
    photo = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    np.testing.assert_array_equal(adapted(logits, photo, 0.6), logits)


def test_a_mirrored_photo_has_the_mirrored_answer():
    truth, logits = town()
    photo = photo_of(truth, np.random.default_rng(2))
    mirrored = adapted(np.ascontiguousarray(logits[:, ::-1]), np.ascontiguousarray(photo[:, ::-1]), 0.6)
    np.testing.assert_allclose(expit(mirrored[:, ::-1]), expit(adapted(logits, photo, 0.6)), atol=1e-3)


def test_any_shape_of_photo():
    generator = np.random.default_rng(3)
    for shape in ((1, 1), (1, 400), (3, 700), (640, 5)):
        photo = generator.integers(0, 256, (*shape, 3), dtype=np.uint8)
        logits = generator.normal(0, 3, shape).astype(np.float32)
        found = adapted(logits, photo, 0.6)
        assert found.shape == shape
        assert np.isfinite(found).all()
