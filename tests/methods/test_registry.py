"""Methods by name: parameters, the public interface, the guide's own example."""

import importlib.util
import re
import sys
from pathlib import Path

import numpy as np
import pytest

import lodbench
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.errors import ConfigError, LodbenchError, QueryFault
from lodbench.evaluation import pose_error
from lodbench.harness.conformance.methods import check_answers, check_class
from lodbench.methods.lodlocv2 import LodLocV2, LodLocV2Params
from lodbench.methods.registry import changed_settings, configure_method, make_method
from lodbench.photos.pictures import encoded
from tests.town import CAMERA, prior_of


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


GUIDE = Path(__file__).resolve().parents[2] / "CONTRIBUTING.md"


def test_the_example_of_the_guide_is_whole(tmp_path, monkeypatch):
    (code,) = re.findall(r"## Add a method.*?```python\n(.*?)```", GUIDE.read_text(), re.DOTALL)
    (tmp_path / "shake.py").write_text("from __future__ import annotations\n" + code)
    spec = importlib.util.spec_from_file_location("shake", tmp_path / "shake.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "shake", module)
    spec.loader.exec_module(module)
    config = {"name": "shake", "tries": 64, "sigma_m": 3.0}
    read = lambda values: module.ShakeParams(**values)  # noqa: E731
    checks = [
        *check_class(module.Shake, "shake", lambda: config, read, "conf/method/shake.yaml"),
        *check_answers(lambda: module.Shake(module.ShakeParams())),
    ]
    assert [(check.name, check.detail) for check in checks if check.status != "ok"] == []
    assert {check.name: check.detail for check in checks}["hypotheses"].startswith("64 at most")


def test_a_method_that_exits_is_told():
    class Leaving:
        def __init__(self):
            raise SystemExit(0)

    (check,) = check_answers(Leaving)
    assert (check.status, check.detail) == ("fault", "SystemExit: 0")


QUICK = LodLocV2(LodLocV2Params(steps=12, coarse_size=(160, 120), fine_size=(320, 240)))


class TestLocalize:
    @pytest.mark.parametrize("kind", [bool, np.uint8, np.float64])
    def test_any_kind_of_mask_in_0_to_1(self, scene, queries, truths, kind):
        mask = queries[0].building_probability.astype(kind)
        prior = prior_of(truths[0]).shifted(scene.origin)
        found = lodbench.localize(scene, CAMERA, prior, mask, method=QUICK, threads=1)
        assert pose_error(found.pose, truths[0].shifted(scene.origin)).translation_m < 1

    @pytest.mark.parametrize(
        ("change", "reason"),
        [
            (lambda mask: mask[:, : len(mask)], "another aspect"),
            (lambda mask: (mask * 255).astype(np.uint8), "from 0 to 255 instead of probabilities"),
            (lambda mask: np.dstack([mask] * 3), "instead of \\(height, width\\)"),
            (lambda mask: mask[:0], "empty"),
            (lambda mask: mask * np.nan, "not finite"),
        ],
        ids=["square", "bytes", "channels", "empty", "nan"],
    )
    def test_other_masks_are_refused(self, scene, queries, truths, change, reason):
        with pytest.raises(QueryFault, match=reason):
            lodbench.localize(
                scene, CAMERA, prior_of(truths[0]), change(queries[0].building_probability), method=QUICK
            )

    def test_a_photo_by_its_path_as_text_and_a_method_by_its_name(self, scene, truths, tmp_path):
        photo = tmp_path / "a.png"
        photo.write_bytes(encoded(np.full((120, 160, 3), 200, np.uint8), ".png"))
        camera, prior = CAMERA.scaled(160, 120), prior_of(truths[0]).shifted(scene.origin)
        found = lodbench.localize(scene, camera, prior, image=str(photo), method="prior_only")
        assert pose_error(found.pose, prior).translation_m < 1e-6
        # It is opened: one shade all over is no city.
        with pytest.raises(QueryFault, match="one colour everywhere"):
            lodbench.localize(scene, camera, prior, image=str(photo), method="region")
        with pytest.raises(ConfigError, match="method"):
            lodbench.localize(scene, camera, prior, image=photo, method="regions")
        with pytest.raises(lodbench.LodbenchError, match=r"'city\.gml' is not a scene"):
            lodbench.localize("city.gml", camera, prior)  # type: ignore[arg-type]

    def test_a_prior_that_is_no_pose_is_refused(self, scene, queries):
        prior = lodbench.Pose(2.0 * np.eye(3), np.zeros(3))
        with pytest.raises(LodbenchError, match="no rotation"):
            lodbench.localize(scene, CAMERA, prior, queries[0].building_probability, method=QUICK)
