"""What flights say of a map: heights of buildings, buildings demolished and unmapped, what contradicts it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.citymodel import open_scene
from lodbench.datasets.query import Query
from lodbench.geometry import EulerAngles, Pose
from lodbench.geometry.pose import vector_from_pose
from lodbench.methods.flight import findings as module
from lodbench.methods.flight.demolished_buildings import (
    apart_deg,
    demolished_buildings,
    views_of,
    without_contradicted,
)
from lodbench.methods.flight.findings import BuildingHeight, _Outlines, _sigmas_of_doubt, building_heights
from lodbench.methods.flight.params import FlightParams
from lodbench.methods.flight.roof_sweep import HEIGHTS_M, RoofCurve
from lodbench.methods.flight.unmapped_buildings import _grid, _shares, unmapped_buildings
from lodbench.synthesis.camera_paths import FLIGHT_PATHS
from lodbench.synthesis.flights import MapErrors, change_map
from lodbench.synthesis.mask_degradation import degrade_mask
from tests.town import CAMERA, box_obj

# Roofs of others, which pixels find as the map has them.
OTHERS = {row: RoofCurve(-0.5 * (HEIGHTS_M / 0.3) ** 2, 8) for row in range(1, 6)}
# How far heights are known before outlines are looked at, with two parts of a roof and errors as told.
BEFOREHAND_M = 1.73


def told(monkeypatch, outlines=None, nats=None, rise_m=20.0) -> BuildingHeight | None:
    by_outlines = {} if outlines is None else {0: _Outlines(*outlines, beforehand_m=BEFOREHAND_M)}
    monkeypatch.setattr(module, "_by_outlines", lambda aligned, params: by_outlines)
    rises = np.array([rise_m, *[20.0] * 5])
    monkeypatch.setattr(module, "floors_and_rises", lambda scene: (np.zeros(6), rises))
    curves = OTHERS if nats is None else {**OTHERS, 0: RoofCurve(nats, 8)}
    return building_heights(None, curves, None, FlightParams()).get(0)


def peaks(*heights_m: float, nats: float = 8.0):
    away = np.min([np.abs(HEIGHTS_M - height) for height in heights_m], axis=0)
    return -np.minimum(0.5 * (away / 0.3) ** 2, nats)


@pytest.mark.parametrize(
    ("higher_m", "sigma_m", "rise_m", "is_in_doubt"),
    [
        (2.5, 0.5, 3.0, True),
        (-2.5, 0.5, 8.0, True),
        (1.5, 1.0, 8.0, False),  # too unsure
        (0.9, 0.1, 8.0, False),  # too little
        (-2.5, 0.5, 2.9, False),  # a shed that masks do not show: it may be gone, but is no lower
        (30.0, 1.0, 8.0, True),  # a tower that pixels were not looked up for
    ],
)
def test_outlines_alone_contradict_the_map(monkeypatch, higher_m, sigma_m, rise_m, is_in_doubt):
    height = told(monkeypatch, (higher_m, sigma_m), rise_m=rise_m)
    assert height.is_in_doubt is is_in_doubt
    assert height.photos == 0
    if is_in_doubt:
        assert height.higher_m == pytest.approx(higher_m, abs=0.3)


def test_outlines_choose_between_two_heights_that_pixels_find_alike(monkeypatch):
    height = told(monkeypatch, (2.5, 1.0), peaks(3.0, -3.0))
    assert height.higher_m == pytest.approx(3.0, abs=0.2)
    assert height.sigma_m < 0.8
    assert height.is_in_doubt
    assert height.photos == 8
    # By itself neither is told.
    assert told(monkeypatch, None, peaks(3.0, -3.0)) is None


def test_most_heights_of_a_map_are_right(monkeypatch):
    # Two heights that explain photos alike, one of them the map's.
    assert not told(monkeypatch, None, peaks(0.0, -3.0)).is_in_doubt
    assert told(monkeypatch, None, peaks(-3.0)).is_in_doubt
    # What pixels hardly tell stays as outlines have it.
    assert not told(monkeypatch, (0.0, 0.7), peaks(-3.0, nats=2.0)).is_in_doubt


def test_what_was_known_beforehand_counts_once(monkeypatch):
    # Outlines that halve what was open place a roof twice as high as the joint problem does.
    height = told(monkeypatch, (1.6, BEFOREHAND_M / np.sqrt(2.0)), peaks(3.2, nats=2.5))
    assert height.higher_m == pytest.approx(3.2, abs=0.2)
    assert height.is_in_doubt
    # Those that tell nothing leave it to pixels.
    for outlines in (None, (0.0, BEFOREHAND_M), (0.1, BEFOREHAND_M + 0.1)):
        assert told(monkeypatch, outlines, peaks(3.2)).higher_m == pytest.approx(3.2, abs=0.1)


def test_what_outlines_place_beyond_the_heights_that_pixels_look_at_is_theirs(monkeypatch):
    height = told(monkeypatch, (10.0, 0.5), peaks(0.0))
    assert (height.higher_m, height.photos) == (pytest.approx(10.0, abs=0.1), 0)


def test_heights_are_against_what_all_roofs_are_wrong_about(monkeypatch):
    monkeypatch.setattr(module, "_common", lambda curves: -3.0)
    assert told(monkeypatch, None, peaks(-3.0)).higher_m == pytest.approx(0.0, abs=0.05)
    assert told(monkeypatch, None, peaks(-1.0)).higher_m == pytest.approx(2.0, abs=0.15)


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
    assert demolished_buildings(views(world), city_map) == []
    assert unmapped_buildings(views(world), city_map) == []


@pytest.mark.parametrize("seed", range(3))
def test_a_building_too_many_is_gone_with_the_photos_that_should_show_it(world, seed):
    wrong, changed = change_map(world, MapErrors(extra=0.1), np.random.default_rng(seed))
    found = demolished_buildings(views(world), CityMap(wrong, threads=1))
    assert [change["id"] for change in found] == changed["extra"]
    assert all(len(change["photos"]) >= 3 and change["probability"] > 0.9 for change in found)


@pytest.mark.parametrize("seed", range(3))
def test_a_building_that_the_map_lacks_is_found_where_it_stands(world, seed):
    wrong, changed = change_map(world, MapErrors(missing=0.1), np.random.default_rng(seed))
    found = unmapped_buildings(views(world), CityMap(wrong, threads=1))
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
    whole = unmapped_buildings(shown, there)
    monkeypatch.setattr("lodbench.methods.flight.unmapped_buildings._SQUARE", 5)
    in_squares = unmapped_buildings(shown, there)
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

    monkeypatch.setattr("lodbench.methods.flight.unmapped_buildings._shares", noting)
    found = unmapped_buildings([*shown, far], there)
    # The ground between them is twelve million squares.
    assert len(looked) < 60
    assert len(found) == len(unmapped_buildings(shown, there)) > 0


def test_two_photos_are_too_few(world):
    wrong, _ = change_map(world, MapErrors(missing=0.1, extra=0.1), np.random.default_rng(0))
    few = views(world)[:2]
    assert demolished_buildings(few, CityMap(wrong, threads=1)) == []
    assert unmapped_buildings(few, CityMap(wrong, threads=1)) == []


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
    assert unmapped_buildings([low] * 3, CityMap(world, threads=1)) == []


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
        found.append(unmapped_buildings(shown, there))
    flat, standing = found
    assert flat == []
    (building,) = standing
    assert building["area_m2"] == pytest.approx(750.0, rel=0.2)
    assert building["apart_deg"] > 60.0


# Wide enough to show edges of a single roof.
WIDE = CAMERA.scaled(3 * CAMERA.width, 3 * CAMERA.height)


def photos(world, folder, count=6):
    """Returns an orbit's photos, whose surfaces are as bright as they look up, and their places, (P, 6)."""
    middle = np.array([*world.vertices[:, :2].mean(axis=0), 0.0])
    poses = list(FLIGHT_PATHS["orbit"](middle, np.random.default_rng(4), count))[:count]
    city_map, queries = CityMap(world, threads=1), []
    for k, pose in enumerate(poses):
        (normals,) = city_map.normals(WIDE, pose.rotation[None], pose.center[None])
        shade = np.where((normals != 0).any(axis=-1), 110 + 90 * normals[..., 2] + 20 * normals[..., 0], 60)
        path = folder / f"p{k}.png"
        cv2.imwrite(str(path), np.clip(shade, 0, 255).astype(np.uint8))
        queries.append(Query(f"p{k}", "all", WIDE, pose, None, path))
    return queries, np.array([vector_from_pose(pose) for pose in poses])


def said(heights=(), gone=()):
    buildings = [
        {"id": name, "higher_m": m, "sigma_m": 0.3, "photos": 6, "doubt": True} for name, m in heights
    ]
    return {"buildings": buildings, "changes": [{"kind": "demolished", "id": name} for name in gone]}


def test_directions_are_compared_at_the_place():
    cameras = np.array([[0.0, 0.0, 100.0], [100.0, 0.0, 100.0], [5.0, 0.0, 100.0]])
    assert apart_deg(np.zeros(3), cameras) == pytest.approx(45.0)
    assert apart_deg(np.zeros(3), cameras[[0, 2]]) == pytest.approx(np.degrees(np.arctan(0.05)))
    assert apart_deg(np.zeros(3), cameras[:1]) == 0.0
    # The same cameras look at something far away from one side.
    assert apart_deg(np.array([0.0, 0.0, -1000.0]), cameras) < 6.0


def test_what_stands_by_the_photos_edges_is_neither_gone_nor_of_another_height(world, tmp_path):
    queries, vectors = photos(world, tmp_path)
    here = CityMap(world, threads=1)
    names = world.building_ids[:4]
    findings = said([(name, 3.0) for name in names[:2]], names[2:])
    kept = without_contradicted(findings, queries, vectors, np.zeros(4), here)
    assert [b["doubt"] for b in kept["buildings"]] == [False, False]
    assert kept["changes"] == []
    # From one side masks may err alike, and so may edges: no height is contradicted. But what lies on
    # edges is not shown to be gone.
    alike = [queries[0], replace(queries[0], name="again")]
    same = without_contradicted(findings, alike, vectors[[0, 0]], np.zeros(4), here)
    assert same == {**findings, "changes": []}
    # Without photos there are no edges.
    blind = [replace(query, image=None) for query in queries]
    assert without_contradicted(findings, blind, vectors, np.zeros(4), here) == findings


def test_what_the_map_has_wrong_stays_wrong(world, tmp_path):
    queries, vectors = photos(world, tmp_path)
    wrong, changed = change_map(world, MapErrors(heights=0.3, extra=0.2), np.random.default_rng(5))
    findings = said([(name, -m) for name, m in changed["heights"].items()], changed["extra"])
    assert findings["buildings"]
    assert findings["changes"]
    kept = without_contradicted(findings, queries, vectors, np.zeros(4), CityMap(wrong, threads=1))
    assert kept == findings


def test_heights_are_doubted_beyond_what_all_of_a_flight_are_off_by():
    def flight(*off_m):
        return [BuildingHeight(m, 0.5, 4, False) for m in off_m]

    assert _sigmas_of_doubt([]) == pytest.approx(3.0)
    assert _sigmas_of_doubt(flight(0.1, -0.2, 0.1, 4.0)) == pytest.approx(3.0)
    # Masks that are off by three times what is known of them.
    assert _sigmas_of_doubt(flight(1.0, -1.5, 1.0, -1.0)) == pytest.approx(3.0 * 1.4826 * 2.0)
