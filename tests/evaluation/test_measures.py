"""Basins, roof edges against the edges of a photo, and findings of flights against changes of a map."""

from pathlib import Path

import numpy as np
import pytest

from lodbench.bench.flights import MapScore, score_map
from lodbench.bench.real_report import PhotoEdges, median_and_share, roof_edges
from lodbench.citymap import CityMap
from lodbench.citymodel import open_scene
from lodbench.datasets.folder import RealFlightParams, open_real_flight
from lodbench.errors import ConfigError
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.harness.runs.basin import basin_steps, protocol_lines
from lodbench.segmentation.masks import read_photo
from tests.town import box_obj


def test_steps_are_both_tables_widest_last():
    steps = basin_steps([100, 30], [60.0], [None])
    assert [step.label for step in steps] == ["Delta 30 m", "Delta 100 m", "Delta 60 deg"]
    far, turned = steps[1].prior(), steps[2].prior()
    assert (far.x_m, far.y_m, far.z_m, far.yaw_deg) == (100, 100, 100, 7.5)
    assert (turned.x_m, turned.y_m, turned.z_m, turned.yaw_deg) == (10, 10, 30, 60)


def test_limits_follow_their_ranges():
    steps = basin_steps([200, 30], [], [25, 100])
    assert [(step.half_width, step.limit) for step in steps] == [(30, 100), (200, 25)]


@pytest.mark.parametrize(
    ("ranges", "yaws", "limits", "said"),
    [
        ([0], [], [None], r"ranges=0 is not in \(0, 10000\]"),
        ([float("nan")], [], [None], r"ranges=nan is not in \(0, 10000\]"),
        ([], [181], [None], r"yaw_ranges=181 is not in \(0, 180\]"),
        ([30, 30], [], [None], "occurs twice"),
        ([], [], [None], "no range"),
        ([30, 50, 100], [], [10, 10], "2 limits"),
    ],
)
def test_bad_ranges_stop_before_any_work(ranges, yaws, limits, said):
    with pytest.raises(ConfigError, match=said):
        basin_steps(ranges, yaws, limits)


def test_the_protocol_says_which_tilt_and_that_no_pose_is_dropped():
    text = " ".join(protocol_lines("truth", 3, True))
    assert "oracle" in text
    assert "no pose is dropped" in text
    assert "seed 3" in text


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


CHANGED = {"heights": {"a": 3.0, "b": -2.0, "unseen": 4.0}, "missing": ["m", "hidden"], "extra": ["x", "y"]}
BOXES = {"m": (100.0, 100.0, 110.0, 112.0), "hidden": (300.0, 300.0, 310.0, 310.0)}


def building(name, higher_m, doubt, photos=5):
    return {"id": name, "higher_m": higher_m, "sigma_m": 0.3, "photos": photos, "doubt": doubt}


def place(west, south):
    ring = [[west, south], [west + 8, south], [west + 8, south + 8], [west, south + 8], [west, south]]
    return {
        "kind": "unmapped",
        "outline": [ring],
        "area_m2": 64.0,
        "height_m": 5.0,
        "sigma_m": 0.5,
        "at_most_m": 8.0,
        "share": 0.9,
        "photos": ["p"],
    }


def test_counts_of_a_flight_and_of_two():
    findings = {
        "buildings": [
            building("a", -2.8, True),  # recovered
            building("b", 1.0, False),  # too little, not found
            building("c", 0.2, False),  # right
            building("d", 1.6, True),  # in doubt for nothing
            building("e", 9.0, True),  # in doubt, though no photo shows its roof
            building("y", -5.0, True),  # stands in the map only
        ],
        "changes": [
            {"kind": "demolished", "id": "x", "probability": 1.0, "photos": ["p"]},
            {"kind": "demolished", "id": "c", "probability": 0.95, "photos": ["p"]},
            place(111.0, 113.0),  # beside the corner of what is missing, within three metres
            place(500.0, 500.0),
            place(700.0, 700.0),  # on a container
        ],
    }
    score = score_map(
        findings,
        CHANGED,
        {"a", "b", "c", "d", "m", "x", "y"},
        {"a", "b", "c", "d", "y"},
        BOXES,
        clutter=[(706.0, 700.0, 712.0, 702.4), (110.0, 110.0, 120.0, 120.0)],
    )
    assert score == MapScore(
        heights=4, recovered=2, wrong=2, doubted_wrong=1, doubted=3, rightly=1, demolished=2,
        reported_demolished=2, rightly_demolished=1, unmapped=1, found=1, places=3,
        rightly_unmapped=1, clutter=1,
    )  # fmt: skip
    assert (score + score).heights == 8
    assert (score + MapScore()) == score
