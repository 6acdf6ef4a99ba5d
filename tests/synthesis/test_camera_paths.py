"""Where cameras are put, and what stands around a city."""

import json
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from lodbench.citymodel.scene import building_boxes
from lodbench.datasets.pose_text import format_pose, lines_to_text, read_poses
from lodbench.errors import ConfigError, DatasetError
from lodbench.geometry import EulerAngles, Pose
from lodbench.kernels.looks import SurfaceClass
from lodbench.storage import random_stream
from lodbench.synthesis.camera_paths import CAMERA_PATHS, MOST_VIEWS, GenerateParams, SurveyArea
from lodbench.synthesis.generate import generate_training_data
from lodbench.synthesis.land_cover import Ground, ground_from_bases, look_down
from lodbench.synthesis.objects import MeshBuilder
from lodbench.synthesis.plan_views import (
    BELOW_GROUND,
    IN_BUILDING,
    NO_BUILDINGS,
    TWO_REGIONS,
    plan_views,
    regions_of,
)
from lodbench.synthesis.surroundings import CLUTTER, Spot, make_surroundings, standing_clutter
from tests.synthesis.conftest import SMALL, WHOLE, box_city


@pytest.fixture(scope="module")
def town():
    scene = box_city()
    ground = ground_from_bases(look_down(scene))
    return scene, SurveyArea(building_boxes(scene).bases, ground, scene.origin)


def params(**settings):
    return GenerateParams("city.obj", "out", **{"size": (120, 90), **settings})


def candidates(params, place):
    return list(CAMERA_PATHS[params.sampling](params, place))


def test_pitch_counts_from_nadir_and_30_60_are_the_same_two_either_way(town):
    for pitch, down in ((0.0, -1.0), (30.0, -np.cos(np.radians(30))), (90.0, 0.0)):
        pose = candidates(params(pitch=[pitch], yaw=[20.0], height=[90.0]), town[1])[0]
        assert pose.rotation[2, 2] == pytest.approx(down, abs=1e-12)
    gimbal = params(pitch=[30.0, 60.0], pitch_from="horizon")
    assert sorted(gimbal.pitches_from_nadir()) == [30.0, 60.0]
    assert params(pitch=[10.0], pitch_from="horizon").pitches_from_nadir() == [80.0]


def test_the_grid_is_half_the_height_apart_and_that_high_above_the_ground(town):
    poses = candidates(params(pitch=[30.0], height=[100.0], yaw=[0.0]), town[1])
    centers = np.stack([pose.center for pose in poses])
    for axis in (0, 1):
        steps = np.diff(np.unique(centers[:, axis].round(6)))
        # Buildings' middles span 200 m; four places at about 50 m, ends included, as UAVD4L spaces them.
        np.testing.assert_allclose(steps, 200.0 / 3)
    np.testing.assert_allclose(centers[:, 2], 20.0 + 100.0, atol=0.2)
    assert len(candidates(params(), town[1])) == 16 * 8 * 2 + 9 * 8 * 2


def test_a_trajectory_is_followed_and_looks_ahead(town, tmp_path):
    place = town[1]._replace(origin=np.array([1000.0, 2000.0, 0.0]))
    corners = [[0.0, 0.0, 130.0], [0.0, 90.0, 140.0], [60.0, 90.0, 140.0]]
    path = tmp_path / "poses.txt"
    poses = [Pose.from_euler(EulerAngles(0, 0, 0), np.add(c, place.origin)) for c in corners]
    path.write_text(lines_to_text(format_pose(f"{k}", pose) for k, pose in enumerate(poses)))
    along = candidates(params(sampling="trajectory", poses=str(path), spacing_m=30.0, pitch=[45.0]), place)
    assert len(along) == 3 + 2
    # By itself half its own height apart: 110 and 120 m above the ground, which is at 20.
    assert len(candidates(params(sampling="trajectory", poses=str(path), pitch=[45.0]), place)) == 2 + 1
    np.testing.assert_allclose(along[1].center, [0.0, 30.0, 130.0 + 10.0 / 3], atol=1e-9)
    assert along[0].euler.yaw_deg == pytest.approx(0.0, abs=1e-9)  # north
    assert along[-1].euler.yaw_deg == pytest.approx(-90.0)  # east
    around = candidates(params(sampling="priors", poses=str(path), count=4), place)
    assert len(around) == 12
    offsets = np.array([pose.center - corners[k // 4] for k, pose in enumerate(around)])
    assert (np.abs(offsets) <= [10.0, 10.0, 30.0]).all()
    assert np.abs(offsets).max() > 1.0


def test_views_without_buildings_are_taken_when_requested(town):
    scene, place = town
    asked = params(sampling="anywhere", count=40, height=[60.0], pitch=[0.0], val_share=0.2, test_share=0.2)
    assert not {view.name for view in plan_views(asked, scene, place.ground).views} >= {"000000", "000001"}
    every = plan_views(replace(asked, min_buildings=0.0, overlap=1.0), scene, place.ground)
    assert len(every.views) == 40 - sum(every.skipped.values()) > 30
    assert {view.split for view in every.views} == {"train", "val", "test"}


def test_views_are_skipped_for_a_reason_and_counted(town, tmp_path):
    scene, place = town
    middle = place.bases[0]
    centers = [
        (middle[0], middle[1], 5.0),  # below the ground, which is at 20
        (middle[0], middle[1], 24.0),  # inside the first building
        (middle[0] - 150.0, middle[1], 120.0),  # looks away from all
        (100.0, 100.0, 140.0),  # over the middle
    ]
    path = tmp_path / "poses.txt"
    angles = [EulerAngles(10, 0, 0), EulerAngles(10, 0, 0), EulerAngles(70, 0, 90), EulerAngles(0, 0, 0)]
    poses = [Pose.from_euler(angle, center) for angle, center in zip(angles, centers, strict=True)]
    path.write_text(lines_to_text(format_pose(f"{k}", pose) for k, pose in enumerate(poses)))
    asked = params(
        sampling="priors", poses=str(path), count=1, prior_m=(0.0, 0.0, 0.0), prior_deg=(0.0, 0.0, 0.0)
    )
    made = plan_views(replace(asked, val_share=0.0, test_share=0.0), scene, place.ground)
    assert made.skipped == {BELOW_GROUND: 1, IN_BUILDING: 1, NO_BUILDINGS: 1}
    assert [view.name for view in made.views] == ["000003"]
    low = params(sampling="grid", height=[40.0], pitch=[0.0], yaw=[0.0], val_share=0.3, test_share=0.3)
    split = plan_views(low, scene, place.ground)
    assert split.skipped[TWO_REGIONS] > 0
    assert {view.split for view in split.views} == {"train", "val", "test"}


def test_regions_are_strips_with_the_shares_requested(town):
    bases = town[1].bases
    region = regions_of(bases, 0.2, 0.2)
    along = bases[:, int(np.ptp(bases[:, 1]) > np.ptp(bases[:, 0]))]
    assert along[region == 0].max() < along[region == 1].min()
    assert along[region == 1].max() < along[region == 2].min()
    assert set(regions_of(bases, 0.0, 0.0)) == {0}
    assert set(regions_of(bases, 0.0, 0.2)) == {0, 2}


def test_no_building_is_seen_in_two_splits(box_file, tmp_path):
    asked = GenerateParams(
        str(box_file),
        str(tmp_path / "data"),
        images=False,
        labels=True,
        val_share=0.3,
        test_share=0.3,
        overlap=0.0,
        **{**SMALL, "height": [50.0], "pitch": [0.0], "spacing_m": 15.0},
    )
    made = generate_training_data(asked)
    seen = {
        split: {
            int(number)
            for path in (made.out / split / "labels").glob("*.png")
            for number in np.unique(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
            if number
        }
        for split, count in made.views.items()
        if count
    }
    assert len(seen) >= 2
    splits = list(seen.values())
    assert not any(splits[i] & splits[j] for i in range(len(splits)) for j in range(i))


def test_names_hold_the_pose_in_whole_metres_and_degrees(box_file, tmp_path):
    asked = GenerateParams(
        str(box_file), str(tmp_path / "data"), images=False, naming="pose", **SMALL, **WHOLE
    )
    made = generate_training_data(asked)
    for name, pose in read_poses(made.out / "train" / "poses.txt").items():
        x, y, z, pitch, yaw, roll = (int(word) for word in name.removesuffix(".jpg").split("@"))
        np.testing.assert_allclose(pose.center, [x, y, z], atol=1.0)
        assert pose.euler == pytest.approx((pitch, roll, yaw), abs=1.0)
    manifest = json.loads((made.out / "manifest.json").read_text())
    assert manifest["settings"]["naming"] == "pose"


def test_occluders_are_cut_out_of_masks_only_when_requested(box_file, tmp_path):
    shown = {}
    for cut in (False, True):
        asked = GenerateParams(
            str(box_file), str(tmp_path / f"{cut}"), occluders_in_mask=cut, images=False, **SMALL, **WHOLE
        )
        made = generate_training_data(asked)
        shown[cut] = [cv2.imread(str(p), 0) > 0 for p in sorted((made.out / "train" / "masks").iterdir())]
    for whole, cut in zip(shown[False], shown[True], strict=True):
        assert not (cut & ~whole).any()
    assert sum(mask.sum() for mask in shown[True]) < sum(mask.sum() for mask in shown[False])


def test_the_spacing_that_is_advised_is_enough_for_all_heights():
    bases = np.array([[0.0, 0.0, 0.0], [20_000.0, 15_000.0, 0.0]])
    place = SurveyArea(bases, Ground(0.0, 0.0, 1000.0, np.zeros((16, 21))), np.zeros(3))
    asked = params(sampling="grid", height=[100.0, 120.0, 150.0], spacing_m=5.0)
    with pytest.raises(ConfigError) as told:
        next(CAMERA_PATHS["grid"](asked, place))
    advised = float(re.search(r"spacing_m=(\d+)", told.value.hint)[1])
    next(CAMERA_PATHS["grid"](replace(asked, spacing_m=advised), place))
    views_per_height = 8 * 2 * round(20_000 / advised) * round(15_000 / advised)
    assert 0.9 * MOST_VIEWS < 3 * views_per_height <= MOST_VIEWS


SLOPE = Ground(-100.0, -100.0, 10.0, np.fromfunction(lambda row, column: 2.0 * column, (21, 21)))


@pytest.fixture(scope="module")
def made(city):
    return make_surroundings(city, seed=3)


def corners_of(props, *kinds):
    chosen = np.isin(props.surface, kinds)
    return props.vertices[props.triangles[chosen]].astype(float)


def test_trees_cars_and_clutter_keep_clear_of_buildings(made, city):
    boxes = building_boxes(city)
    for kind in (SurfaceClass.TRUNK, SurfaceClass.CAR_BODY, SurfaceClass.CLUTTER):
        points = corners_of(made[0], kind).reshape(-1, 3)
        assert len(points) > 30
        inside = (points[:, None, :2] > boxes.low[:, :2] + 0.5) & (
            points[:, None, :2] < boxes.high[:, :2] - 0.5
        )
        assert not inside.all(axis=2).any(), kind


def test_what_stands_beside_buildings_is_boxed_and_what_is_painted_is_not(made, city):
    props, land = made
    boxes = np.array(standing_clutter(props, land)) - np.tile(props.origin[:2], 2)
    containers = corners_of(props, SurfaceClass.CLUTTER).mean(axis=1)
    inside = ((containers[:, None, :2] >= boxes[:, :2]) & (containers[:, None, :2] <= boxes[:, 2:])).all(
        axis=2
    )
    assert inside.any(axis=1).all()
    heaps = (props.surface == SurfaceClass.GROUND) & props.tint.any(axis=1)
    assert len(np.unique(props.objects[heaps | (props.surface == SurfaceClass.CLUTTER)])) >= len(boxes) > 5
    # A yard is wider than anything that stands.
    assert (boxes[:, 2:] - boxes[:, :2]).max() < 18.0


def test_a_city_with_a_house_at_zero_gets_no_land(city):
    """Memory was asked for by the hundred gigabytes."""
    vertices = city.vertices.copy()
    vertices[:8] += np.float32(5e6)
    with pytest.raises(DatasetError, match=r"5,000 km wide: land is made up for at most 60 km"):
        make_surroundings(replace(city, vertices=vertices), seed=3)


def test_everything_stands_on_the_ground(made):
    # Trunks are rooted.
    for kind, lowest_m, highest_m in ((SurfaceClass.CAR_BODY, -0.5, 2.2), (SurfaceClass.TRUNK, -3.0, 12.0)):
        points = corners_of(made[0], kind).reshape(-1, 3)
        above = points[:, 2] - made[1].ground.at(points)
        assert above.min() > lowest_m
        assert above.max() < highest_m


def test_the_same_seed_makes_the_same_and_another_something_else(made, city):
    again, other = make_surroundings(city, seed=3), make_surroundings(city, seed=4)
    np.testing.assert_array_equal(again[0].vertices, made[0].vertices)
    np.testing.assert_array_equal(again[1].cover.classes, made[1].cover.classes)
    assert len(other[0].vertices) != len(made[0].vertices)


def test_ground_is_interpolated_and_flat_beyond_its_rim():
    found = SLOPE.at(np.array([[-100.0, 0.0], [-95.0, 3.0], [50.0, 50.0], [400.0, 0.0]]))
    np.testing.assert_allclose(found, [0.0, 1.0, 30.0, 40.0])


@pytest.mark.parametrize("kind", CLUTTER)
def test_clutter_stays_in_its_circle_on_the_slope(kind):
    add, radius_m = CLUTTER[kind]
    for draw in range(4):
        builder = MeshBuilder(0)
        spot = Spot(np.array([5.0, -8.0]), np.array([0.6, 0.8]), SLOPE)
        add(builder, spot, random_stream(draw, kind))
        props = builder.build(np.zeros(3))
        points = props.vertices.astype(float)
        assert len(points) > 3
        assert np.linalg.norm(points[:, :2] - spot.middle, axis=1).max() < radius_m
        above = points[:, 2] - SLOPE.at(points)
        assert above.min() > -4.0
        assert above.max() < 9.0
        kinds = [SurfaceClass(kind) for kind in set(props.surface.tolist())]
        assert all(kind.is_ground or kind >= SurfaceClass.TRUNK for kind in kinds)
