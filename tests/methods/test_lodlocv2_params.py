from __future__ import annotations

import pytest

from lodbench.datasets.priors import UniformPrior
from lodbench.errors import ConfigError
from lodbench.methods.lodlocv2 import LodLocV2Params


def test_defaults_are_the_papers():
    params = LodLocV2Params()
    assert (params.coarse_size, params.fine_size) == ((301, 224), (602, 448))
    assert (params.beams, params.steps, params.candidates, params.kept) == (2, 40, 52, 2)
    assert (params.sigma_m, params.spread_yaw_deg, params.gamma) == (1.5, 2.0, 0.3)
    assert params.children_per_parent == 12
    assert len(params.grid()) == 504


@pytest.mark.parametrize(("step", "scale"), [(0, 1.0), (1, 0.975), (20, 0.5), (28, 0.3), (39, 0.3)])
def test_the_spread_decays_linearly_to_a_floor(step, scale):
    assert LodLocV2Params().scale(step) == pytest.approx(scale)


def test_lists_from_a_configuration_become_tuples():
    assert LodLocV2Params(coarse_size=[160, 120]).coarse_size == (160, 120)


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"coarse_size": (301,)}, "coarse_size"),
        ({"fine_size": (602, 448, 3)}, "fine_size"),
        ({"fine_size": (602, 0)}, "fine_size"),
        ({"variant": "ful"}, "variant=ful"),
        ({"beams": 0}, "beams"),
        ({"steps": 0}, "steps"),
        ({"kept": 0}, "kept"),
        ({"candidates": 50}, "candidates=50"),
        ({"candidates": 4}, "candidates=4"),
        ({"candidates": 0}, "candidates=0"),
        ({"sigma_m": -1.0}, "sigma_m"),
        ({"spread_yaw_deg": -0.1}, "spread_yaw_deg"),
        ({"gamma": 1.5}, "gamma"),
        ({"gamma": float("nan")}, "gamma"),
    ],
)
def test_what_makes_no_sense_is_named(values, named):
    with pytest.raises(ConfigError, match=named):
        LodLocV2Params(**values)


def test_a_misspelt_variant_names_the_nearest():
    with pytest.raises(ConfigError) as caught:
        LodLocV2Params(variant="no_refin")
    assert "no_refine" in caught.value.hint


@pytest.mark.parametrize("values", [{"count_x": 0}, {"range_z_m": -60.0}])
def test_a_grid_that_makes_no_sense_is_refused_by_the_setting_that_is_typed(values):
    with pytest.raises(ConfigError, match=f"method.{next(iter(values))}="):
        LodLocV2Params(**values)


def test_values_are_frozen():
    with pytest.raises(AttributeError):
        LodLocV2Params().steps = 3


@pytest.mark.parametrize(("delta", "count"), [(30, 7), (50, 11), (100, 21), (200, 41), (27, 7)])
def test_a_wider_prior_widens_the_grid_at_the_same_stride(delta, count):
    params = LodLocV2Params().for_prior(UniformPrior(delta, delta, delta))
    assert (params.range_x_m, params.count_x, params.count_z) == (2 * delta, count, count)
    assert (params.range_yaw_deg, params.count_yaw) == (15.0, 8)
    assert params.range_x_m / (params.count_x - 1) <= 10.0


def test_an_axis_of_one_sample_has_no_stride_and_stays():
    params = LodLocV2Params(range_z_m=0.0, count_z=1).for_prior(UniformPrior(30, 30, 30))
    assert (params.range_z_m, params.count_z) == (0.0, 1)
