"""Roof edges against a photo's edges: known offsets, edges that run another way, and a real flight."""

from pathlib import Path

import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.citymodel import open_scene
from lodbench.datasets.real_flights import RealFlightParams, open_real_flight
from lodbench.evaluation.edge_distance import PhotoEdges, median_and_share, roof_edges
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.segmentation.masks import read_photo
from tests.town import box_obj

OCHOTA = Path(__file__).resolve().parents[3] / "shared" / "data" / "real_flights" / "ochota"
# From 110 m above a roof at 10 m one pixel is a metre there: the roof below fills columns and rows 60 to 100.
CAMERA = Camera(160, 160, 100.0, 100.0, 80.0, 80.0)
ABOVE = Pose.from_euler(EulerAngles(0.0, 0.0, 0.0), (0.0, 0.0, 110.0))


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    file = tmp_path_factory.mktemp("block") / "block.obj"
    file.write_text(box_obj([(-20, -20, 20, 20, 0, 10)]))
    scene = open_scene(file)
    return CityMap(scene), ABOVE.shifted(-scene.origin)


def picture(left, top, right, bottom):
    photo = np.full((160, 160), 40, np.uint8)
    photo[top:bottom, left:right] = 200
    return photo


def test_distances_are_those_of_the_picture(block):
    city_map, pose = block
    shown = np.unique(roof_edges(CAMERA, pose, city_map).round(6))
    assert shown.tolist() == [60.0, 100.0]
    exact = PhotoEdges(picture(60, 60, 100, 100), CAMERA).distances(pose, city_map)
    # Four edges of 40 px, a place every 4 px.
    assert len(exact) == 40
    assert median_and_share(exact)[1] > 0.9
    assert median_and_share(exact)[0] < 0.3
    moved = PhotoEdges(picture(63, 60, 103, 100), CAMERA).distances(pose, city_map)
    found = np.sort(moved[np.isfinite(moved)])
    # Two edges are 3 px off, two run on where they were.
    assert np.abs(found[-18:] - 3.0).max() < 0.3
    assert found[:16].max() < 0.3


def test_what_is_too_far_or_runs_another_way_is_not_found(block):
    city_map, pose = block
    far = PhotoEdges(picture(68, 68, 92, 92), CAMERA).distances(pose, city_map)
    assert np.isinf(far).all()
    # One edge, from left to right: the two that run up and down have none.
    one = PhotoEdges(picture(0, 61, 160, 160), CAMERA).distances(pose, city_map)
    assert np.isfinite(one).sum() == 10
    assert median_and_share(one)[0] == pytest.approx(1.0, abs=0.2)
    plain = PhotoEdges(np.zeros((160, 160, 3), np.uint8), CAMERA).distances(pose, city_map)
    assert np.isinf(plain).all()
    assert median_and_share(plain)[1] == 0.0


def test_without_a_roof_in_view_there_is_no_distance(block):
    city_map, pose = block
    away = PhotoEdges(picture(60, 60, 100, 100), CAMERA).distances(
        pose.shifted(np.array([500.0, 0.0, 0.0])), city_map
    )
    assert len(away) == 0
    assert np.isnan(median_and_share(away)).all()


def test_colour_and_size_do_not_matter(block):
    city_map, pose = block
    photo = np.kron(picture(62, 60, 102, 100), np.ones((20, 20), np.uint8))
    large = Camera(3200, 3200, 2000.0, 2000.0, 1600.0, 1600.0)
    median, share = median_and_share(
        PhotoEdges(np.repeat(photo[..., None], 3, 2), large).distances(pose, city_map)
    )
    # Of 1600 pixels 2 m are 20: the edges that did not move are found alone.
    assert (median < 0.5, share) == (True, pytest.approx(0.5, abs=0.06))


@pytest.mark.skipif(not OCHOTA.is_dir(), reason=f"no real flight in {OCHOTA}")
def test_a_real_photo_confirms_its_true_pose_and_contradicts_others():
    dataset = open_real_flight(RealFlightParams(str(OCHOTA)))
    scene = open_scene(dataset.city_model)
    city_map = CityMap(scene)
    for entry in dataset.entries[2:4]:
        photo = PhotoEdges(read_photo(entry.image), entry.camera)
        truth = dataset.truth[entry.key].shifted(-scene.origin)
        median, share = median_and_share(photo.distances(truth, city_map))
        assert (median < 1.6, share > 0.8) == (True, True)
        for wrong in ((0.0, 0.0, 6.0), (3.0, 0.0, 0.0)):
            worse, fewer = median_and_share(photo.distances(truth.shifted(np.array(wrong)), city_map))
            assert (worse > 1.3 * median) or (fewer < share - 0.1)
