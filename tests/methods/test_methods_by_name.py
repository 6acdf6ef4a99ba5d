"""Methods by name, with parameters checked before anything is made of them."""

from __future__ import annotations

import pytest

from lodbench.datasets.priors import UniformPrior
from lodbench.errors import ConfigError
from lodbench.methods.registry import changed_settings, configure_method, make_method


def test_settings_go_before_defaults():
    configured = configure_method({"name": "lodlocv2", "steps": 3, "coarse_size": [64, 48]})
    assert (configured.params.steps, configured.params.coarse_size) == (3, (64, 48))
    assert configured.make().name == "lodlocv2"


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"name": "lodlok"}, "There is no method 'lodlok'"),
        ({}, "There is no method ''"),
        ({"name": "lodlocv2", "stepps": 3}, "method.stepps is not a setting"),
        ({"name": "lodlocv2", "steps": "many"}, "method.steps is many, not a whole number."),
        ({"name": "lodlocv2", "steps": 0}, "at least 1"),
    ],
)
def test_what_is_wrong_is_told(settings, word):
    with pytest.raises(ConfigError, match=word):
        configure_method(settings)


def test_one_that_can_is_told_how_far_off_priors_are():
    prior = UniformPrior(50.0, 50.0, 50.0)
    assert configure_method({"name": "lodlocv2"}).for_prior(prior).params.range_x_m == 100.0
    alone = configure_method({"name": "prior_only"})
    assert alone.for_prior(prior) is alone


def test_by_keywords():
    assert make_method("contour_alignment", starts=2).params.starts == 2


def test_the_true_tilt_is_told_to_who_asks():
    aligned = configure_method({"name": "contour_alignment"})
    assert aligned.for_tilt("truth").params.range_tilt_deg == 0.0
    assert aligned.for_tilt("prior") is aligned
    assert aligned.for_tilt("truth").params.range_x_m == aligned.params.range_x_m
    fixed = configure_method({"name": "lodlocv2"})
    assert fixed.for_tilt("truth") is fixed


def test_settings_that_are_not_the_defaults_are_known_without_what_the_variant_says():
    assert changed_settings({"name": "flight", "single": "region", "variant": "full"}) == {"single": "region"}
    defaults = {"name": "flight", "single": configure_method({"name": "flight"}).params.single}
    assert changed_settings(defaults) == {}
    assert changed_settings({"name": "mcloc", "features": "xfeat"}) == {}
    # Of a method that is not installed nobody knows.
    assert changed_settings({"name": "gone", "steps": 3}) == {}
