"""`dataset=views`: the views of `bench accuracy`, as a dataset in the cache."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lodbench.bench.accuracy import draw_views, open_scenes
from lodbench.bench.accuracy_options import AccuracyOptions
from lodbench.citymodel import open_scene
from lodbench.errors import ConfigError, DatasetError
from lodbench.segmentation.masks import read_mask
from lodbench.synthesis.views_dataset import ViewsParams, open_views
from tests.town import box_obj


@pytest.fixture(scope="module")
def city(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("town") / "city.obj"
    path.write_text(box_obj())
    return path


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch) -> Path:
    folder = tmp_path_factory.getbasetemp() / "views-cache"
    monkeypatch.setenv("LODBENCH_CACHE", str(folder))
    return folder


def test_views_are_those_of_bench_accuracy(city):
    dataset = open_views(ViewsParams(str(city), num_views=2))
    scene = open_scene(city)
    options = AccuracyOptions(num_views=2, threads=1)
    views = draw_views(*open_scenes(city, options), options, 0)
    for entry, drawn in zip(dataset.entries, views.dataset.entries, strict=True):
        truth = dataset.truth[entry.key].shifted(-scene.origin)
        np.testing.assert_allclose(
            truth.cam_from_world, views.dataset.truth[drawn.key].cam_from_world, atol=1e-9
        )
        prior = entry.prior.shifted(-scene.origin)
        np.testing.assert_allclose(prior.cam_from_world, drawn.prior.cam_from_world, atol=1e-9)
        np.testing.assert_array_equal(read_mask(entry.mask), views.segmenter.segment(drawn))


def test_asking_for_more_keeps_the_first(city):
    few, more = (open_views(ViewsParams(str(city), num_views=n)) for n in (1, 2))
    assert few.root != more.root
    first = next(iter(few.truth))
    assert few.truth[first].cam_from_world.tolist() == more.truth[first].cam_from_world.tolist()


def test_the_same_settings_draw_nothing_again(city):
    root = open_views(ViewsParams(str(city), num_views=1)).root
    stamp = (root / "views" / "GT_pose.txt").stat().st_mtime_ns
    assert open_views(ViewsParams(str(city), num_views=1)).root == root
    assert (root / "views" / "GT_pose.txt").stat().st_mtime_ns == stamp


@pytest.mark.parametrize("bad", [{"num_views": 0}, {"mask_iou": 0.0}, {"mask_iou": 1.5}, {"tilt_deg": -1.0}])
def test_settings_out_of_range_are_refused(city, bad):
    with pytest.raises(ConfigError):
        ViewsParams(str(city), **bad)


def test_a_missing_city_is_one_line(tmp_path):
    with pytest.raises(DatasetError, match="does not exist"):
        open_views(ViewsParams(str(tmp_path / "no.obj")))
