"""Buildings that stand in the map only, and such that it lacks, by masks at the true poses."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.citymodel import open_scene
from lodbench.datasets.query import Query
from lodbench.geometry import EulerAngles, Pose
from lodbench.methods.flight.gone_buildings import gone_buildings, views_of
from lodbench.methods.flight.missing_buildings import _grid, _shares, missing_buildings
from lodbench.synthesis.camera_paths import FLIGHT_PATHS
from lodbench.synthesis.flights import MapErrors, change_map
from lodbench.synthesis.mask_degradation import degrade_mask
from tests.town import CAMERA, box_obj


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    path = tmp_path_factory.mktemp("world") / "city.obj"
    path.write_text(box_obj())
    return open_scene(path)


def views(world, count=10):
    """Returns an orbit's views with masks as wrong as a network's."""
    middle = np.array([*world.vertices[:, :2].mean(axis=0), 0.0])
    poses = list(FLIGHT_PATHS["orbit"](middle, np.random.default_rng(4), count))[:count]
    city_map = CityMap(world, threads=1)
    queries = []
    for k, pose in enumerate(poses):
        mask, _ = degrade_mask(city_map.render(CAMERA, pose), 0.9, np.random.default_rng(k))
        queries.append(Query(f"p{k}", "all", CAMERA, pose, mask.astype(np.float32)))
    return views_of(queries, poses, 0.0)


def test_a_right_map_lacks_nothing_and_has_nothing_too_much(world):
    city_map = CityMap(world, threads=1)
    assert gone_buildings(views(world), city_map) == []
    assert missing_buildings(views(world), city_map) == []


@pytest.mark.parametrize("seed", range(3))
def test_a_building_too_many_is_gone_with_the_photos_that_should_show_it(world, seed):
    wrong, changed = change_map(world, MapErrors(extra=0.1), np.random.default_rng(seed))
    found = gone_buildings(views(world), CityMap(wrong, threads=1))
    assert [change["id"] for change in found] == changed["extra"]
    assert all(len(change["photos"]) >= 3 and change["probability"] > 0.9 for change in found)


@pytest.mark.parametrize("seed", range(3))
def test_a_building_that_the_map_lacks_is_found_where_it_stands(world, seed):
    wrong, changed = change_map(world, MapErrors(missing=0.1), np.random.default_rng(seed))
    found = missing_buildings(views(world), CityMap(wrong, threads=1))
    rows = [world.building_ids.index(name) for name in changed["missing"]]
    points = [world.vertices[world.vertex_starts[r] : world.vertex_starts[r + 1], :2] for r in rows]
    assert len(found) == len(rows)
    for change in found:
        ring = np.array(change["outline"][0]) - world.origin[:2]
        assert any(
            (ring.mean(axis=0) > p.min(axis=0) - 1).all() and (ring.mean(axis=0) < p.max(axis=0) + 1).all()
            for p in points
        )
        assert len(change["photos"]) >= 3
        assert change["area_m2"] >= 16.0


def test_it_does_not_matter_in_which_squares_the_ground_is_looked_at(world, monkeypatch):
    wrong, _ = change_map(world, MapErrors(missing=0.1), np.random.default_rng(1))
    shown, there = views(world, 6), CityMap(wrong, threads=1)
    whole = missing_buildings(shown, there)
    monkeypatch.setattr("lodbench.methods.flight.missing_buildings._SQUARE", 5)
    in_squares = missing_buildings(shown, there)
    assert len(whole) > 0
    assert [change["outline"] for change in in_squares] == [change["outline"] for change in whole]
    assert [change["share"] for change in in_squares] == pytest.approx([c["share"] for c in whole])


def test_a_photo_far_away_costs_no_more_than_another(world, monkeypatch):
    wrong, _ = change_map(world, MapErrors(missing=0.1), np.random.default_rng(1))
    shown, there, looked = views(world, 6), CityMap(wrong, threads=1), []
    far = replace(shown[0], name="far", pose=shown[0].pose.shifted([2e6, -3e6, 0.0]))

    def noting(places, *rest):
        looked.append(places)
        return _shares(places, *rest)

    monkeypatch.setattr("lodbench.methods.flight.missing_buildings._shares", noting)
    found = missing_buildings([*shown, far], there)
    # The ground between them is twelve million squares.
    assert len(looked) < 60
    assert len(found) == len(missing_buildings(shown, there)) > 0


def test_two_photos_are_too_few(world):
    wrong, _ = change_map(world, MapErrors(missing=0.1, extra=0.1), np.random.default_rng(0))
    few = views(world)[:2]
    assert gone_buildings(few, CityMap(wrong, threads=1)) == []
    assert missing_buildings(few, CityMap(wrong, threads=1)) == []


def test_a_camera_below_the_city_s_usual_ground_sees_no_ground_kilometres_behind_it(world):
    view = views(world, 4)[0]
    # The upper rays that are looked along run half a degree below the horizon.
    above_deg = np.degrees(np.arctan((view.camera.cy - 0.3 * view.camera.height) / view.camera.fy))
    pose = Pose.from_euler(EulerAngles(89.5 - above_deg, 0.0, 0.0), (0.0, 0.0, -500.0))
    _, counts = _grid([replace(view, pose=pose)], 0.0)
    # Cells of 2 m; nobody looks further than 400 m.
    assert max(counts) <= 2 * 400 / 2


def test_one_place_from_which_no_ground_is_seen_is_no_error(world):
    one = views(world, 4)[0]
    low = replace(one, pose=Pose.from_euler(EulerAngles(0.0, 0.0, 0.0), (0.0, 0.0, -500.0)))
    assert missing_buildings([low] * 3, CityMap(world, threads=1)) == []


def test_a_court_that_masks_hold_lies_flat_and_is_no_building(world):
    """The same place, painted on the ground in all masks, and standing there."""
    square = np.array([[-30.0, -90.0], [0.0, -90.0], [0.0, -65.0], [-30.0, -65.0]])
    there, found = CityMap(world, threads=1), []
    for height_m in (0.0, 6.0):
        shown = []
        for view in views(world):
            mask = view.mask.copy()
            corners = np.concatenate([np.column_stack([square, np.full(4, z)]) for z in {0.0, height_m}])
            local = (corners - view.pose.center) @ view.pose.rotation.T
            pixels = local[:, :2] / local[:, 2:] * [view.camera.fx, view.camera.fy]
            hull = cv2.convexHull((pixels + np.array([view.camera.cx, view.camera.cy])).astype(np.int32))
            canvas = mask.astype(np.uint8)
            cv2.fillConvexPoly(canvas, hull, 1)
            shown.append(replace(view, mask=canvas > 0))
        found.append(missing_buildings(shown, there))
    flat, standing = found
    assert flat == []
    (building,) = standing
    assert building["area_m2"] == pytest.approx(750.0, rel=0.2)
    assert building["apart_deg"] > 60.0
