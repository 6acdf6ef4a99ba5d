"""Heights of roofs by pixels: roofs moved in the map are found where the photos have them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.citymodel import open_scene
from lodbench.datasets.query import Query
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.methods.flight.demolished_buildings import views_of
from lodbench.methods.flight.findings import _common
from lodbench.methods.flight.roof_edges import SweepPicture, edge_evidence, open_pictures
from lodbench.methods.flight.roof_sweep import HEIGHTS_M, RoofCurve, edge_points, roof_points, sweep_roofs
from lodbench.methods.flight.unmapped_buildings import unmapped_buildings
from lodbench.synthesis.camera_paths import FLIGHT_PATHS
from lodbench.synthesis.flights import MapErrors, change_map
from tests.town import CAMERA, box_obj

EDGE_HEIGHTS_M = np.arange(-4.0, 4.01, 0.25)
EDGE_CAMERA = Camera(320, 240, 230.0, 228.0, 161.0, 118.5)


def quads(*corners):
    """Returns two triangles of each quadrangle."""
    return np.array([t for a, b, c, d in corners for t in ((a, b, c), (a, c, d))], dtype=np.float64)


def box(width, depth, top):
    floor, roof = ([(0, 0, z), (width, 0, z), (width, depth, z), (0, depth, z)] for z in (0, top))
    walls = [(floor[i], floor[i - 3], roof[i - 3], roof[i]) for i in range(4)]
    return quads(floor[::-1], roof, *walls)


def test_a_flat_roof_has_its_outline_and_no_diagonal():
    points = edge_points(box(8.0, 6.0, 5.0))
    x, y = points[:, 0], points[:, 1]
    assert len(points) == 2 * (16 + 12)
    assert (np.isclose(x, 0) | np.isclose(x, 8) | np.isclose(y, 0) | np.isclose(y, 6)).all()
    assert np.allclose(points[:, 2:4], (5.0, 1.0))
    # Along the edge.
    assert np.allclose(np.abs(points[:, 4:]).sum(axis=1), 1.0)
    assert np.allclose(np.abs(points[np.isclose(x, 0), 4:6]), (0, 1))


def test_a_gable_has_a_ridge_and_eaves_that_rise_less():
    a, b, c, d, e, f = (0, 0, 3), (4, 0, 3), (4, 6, 3), (0, 6, 3), (2, 0, 5), (2, 6, 5)
    floor = [(0, 0, 0), (0, 6, 0), (4, 6, 0), (4, 0, 0)]
    points = edge_points(quads(floor, (a, e, f, d), (b, c, f, e)))
    ridge, eaves = np.isclose(points[:, 2], 5.0), np.isclose(points[:, 2], 3.0)
    assert ridge.sum() == 12
    assert eaves.sum() == 24
    assert np.allclose(points[ridge, 3], 1.0)
    assert np.allclose(points[eaves, 3], 0.6)


@pytest.mark.parametrize("triangles", [np.zeros((0, 3, 3)), np.array([[[0, 0, 0], [4, 0, 0], [4, 0, 3.0]]])])
def test_walls_alone_have_no_edges_of_a_roof(triangles):
    assert edge_points(triangles).shape == (0, 7)


@pytest.mark.parametrize("higher_m", [0.0, 2.0, -1.5])
def test_a_roof_of_one_colour_is_found_where_photos_have_its_edges(higher_m):
    edges = {7: edge_points(box(20.0, 14.0, 10.0)), 9: np.zeros((0, 7))}
    pictures = [picture(yaw_deg, 10.0 + higher_m) for yaw_deg in (0.0, 120.0, 240.0)]
    near = [np.array([7, 9])] * 3
    is_seen = [np.ones(len(edges[7]), bool)] * 2 + [np.zeros(len(edges[7]), bool)]
    found = edge_evidence(pictures, near, edges, is_seen, EDGE_HEIGHTS_M)
    assert list(found) == [7]
    assert (found[7].photos, found[7].points) == (2, 2 * len(edges[7]))
    nats = found[7].log_likelihoods()
    assert EDGE_HEIGHTS_M[np.argmax(nats)] == pytest.approx(higher_m, abs=0.3)
    assert nats.max() - np.median(nats) > 2.0


def picture(yaw_deg: float, top_m: float) -> SweepPicture:
    """A photo of a plain roof on plain ground, a little noise on both, from 60 m away."""
    turn = Pose.from_euler(EulerAngles(40.0, 0.0, yaw_deg), (0.0, 0.0, 0.0)).rotation
    pose = Pose.from_center(turn, np.array([10.0, 7.0, top_m]) - 60.0 * turn[2])
    roof = np.array([(0, 0), (20, 0), (20, 14), (0, 14)], dtype=np.float64)
    shown = SweepPicture(EDGE_CAMERA, 0.0, pose, np.full((240, 320, 4), 90, np.uint8))
    pixels, _ = shown.project(np.column_stack([roof, np.full(4, top_m)]))
    drawn = shown.pixels.copy()
    cv2.fillPoly(drawn, [np.rint(16 * (pixels - 0.5)).astype(np.int32)], (130, 100, 95, 255), shift=4)
    noise = np.random.default_rng(int(yaw_deg)).normal(0.0, 3.0, drawn.shape)
    drawn = cv2.GaussianBlur(np.clip(drawn + noise, 0, 255).astype(np.uint8), (0, 0), 0.8)
    return SweepPicture(EDGE_CAMERA, 0.0, pose, drawn)


LENS = np.zeros(2)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    path = tmp_path_factory.mktemp("world") / "city.obj"
    path.write_text(box_obj())
    return open_scene(path)


@pytest.fixture(scope="module")
def photos(world, tmp_path_factory):
    """Returns an orbit's queries, with pictures of the world, and their poses."""
    folder, city_map = tmp_path_factory.mktemp("photos"), CityMap(world, threads=1)
    middle = np.array([*world.vertices[:, :2].mean(axis=0), 0.0])
    poses = list(FLIGHT_PATHS["orbit"](middle, np.random.default_rng(4), 8))[:8]
    queries = []
    for k, pose in enumerate(poses):
        (picture,) = city_map.colour(CAMERA, pose.rotation[None], pose.center[None])
        # A lawn that is not alike everywhere.
        lawn = np.random.default_rng(0).normal((60, 90, 50), 4, picture.shape).astype(np.uint8)
        mask = city_map.render(CAMERA, pose)
        cv2.imwrite(str(folder / f"{k}.png"), np.where(mask[..., None], picture, lawn)[..., ::-1])
        queries.append(Query(f"{k}", "all", CAMERA, pose, mask.astype(np.float32), folder / f"{k}.png"))
    return queries, poses


def best_m(curves):
    return {row: float(HEIGHTS_M[np.argmax(curve.nats)]) for row, curve in curves.items()}


def test_a_right_map_s_roofs_are_where_it_has_them(world, photos):
    found = best_m(sweep_roofs(open_pictures(*photos, LENS), CityMap(world, threads=1)))
    assert len(found) >= 5
    assert np.mean([abs(height) <= 0.5 for height in found.values()]) >= 0.9


@pytest.mark.parametrize("seed", range(3))
def test_a_roof_that_the_map_has_wrong_is_found_where_photos_show_it(world, photos, seed):
    wrong, changed = change_map(world, MapErrors(heights=0.3), np.random.default_rng(seed))
    found = best_m(sweep_roofs(open_pictures(*photos, LENS), CityMap(wrong, threads=1)))
    ids = {world.building_ids[row]: height for row, height in found.items()}
    off = [abs(ids[name] + change) for name, change in changed["heights"].items() if name in ids]
    assert len(off) >= 2
    assert np.median(off) <= 0.5


def test_a_lens_that_is_longer_than_told_is_looked_through(world, photos):
    queries, poses = photos
    told = replace(CAMERA, fx=CAMERA.fx / 1.05, fy=CAMERA.fy / 1.05)
    queries = [replace(query, camera=told) for query in queries]
    pictures = open_pictures(queries, poses, np.array([0.05, 0.0]))
    right = best_m(sweep_roofs(pictures, CityMap(world, threads=1)))
    assert np.mean([abs(height) <= 0.5 for height in right.values()]) >= 0.9


def test_exposures_do_not_blur_what_heights_say(world, photos, tmp_path):
    queries, poses = photos
    city_map = CityMap(world, threads=1)
    brighter = []
    for k, query in enumerate(queries):
        gain = (0.8, 1.25)[k % 2]
        picture = cv2.imread(str(query.image)).astype(np.float64) * gain
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.clip(picture, 0, 255).astype(np.uint8))
        brighter.append(replace(query, image=tmp_path / f"{k}.png"))
    plain, exposed = (
        sweep_roofs(open_pictures(taken, poses, LENS), city_map) for taken in (queries, brighter)
    )
    assert plain.keys() == exposed.keys()
    before, after = best_m(plain), best_m(exposed)
    assert np.mean([abs(after[row] - before[row]) <= 0.5 for row in before]) >= 0.8
    sharp, blurred = (np.median([np.ptp(curve.nats) for curve in told.values()]) for told in (plain, exposed))
    assert blurred > 0.6 * sharp


def test_many_photos_are_narrower_than_few(photos, monkeypatch):
    queries, poses = photos
    (whole,) = open_pictures(queries[:1], poses[:1], LENS)
    assert whole.camera == CAMERA
    monkeypatch.setattr("lodbench.methods.flight.roof_edges._PIXELS", 8 * 80 * 60)
    narrow = open_pictures(queries, poses, LENS)
    assert sum(picture.pixels.shape[0] * picture.pixels.shape[1] for picture in narrow) <= 1.02 * 8 * 80 * 60
    assert {picture.camera.width for picture in narrow} == {80}


def test_without_photos_or_with_two_of_them_nothing_is_told(world, photos):
    queries, poses = photos
    city_map = CityMap(world, threads=1)
    blind = [replace(query, image=None) for query in queries]
    # All photos of a flight may be lost.
    for taken, places in ((blind, poses), (queries[:2], poses[:2]), ([], [])):
        assert sweep_roofs(open_pictures(taken, places, LENS), city_map) == {}


def test_points_of_a_roof_lie_on_its_upper_side_only():
    # A gable of 4 m by 6 m, its ridge along y at 5 m, eaves at 3 m, over a floor at 0 m.
    a, b, c, d, e, f = (0, 0, 3), (4, 0, 3), (4, 6, 3), (0, 6, 3), (2, 0, 5), (2, 6, 5)
    floor = [[(0, 0, 0), (4, 0, 0), (4, 6, 0)], [(0, 0, 0), (4, 6, 0), (0, 6, 0)]]
    wall = [[(0, 0, 0), (4, 0, 0), (4, 0, 3)]]
    roof = [[a, e, f], [a, f, d], [b, c, f], [b, f, e]]
    points = roof_points(np.array(floor + wall + roof, dtype=np.float64))
    assert np.allclose(points[:, 2], 5.0 - np.abs(points[:, 0] - 2.0))
    # Eaves rise by 3 of 5 where the ridge does by 5.
    assert np.allclose(points[:, 3], points[:, 2] / 5.0)
    assert 100 <= len(points) <= 160
    assert points[:, :2].min() > 0
    assert (points[:, :2].max(axis=0) < (4, 6)).all()


def test_a_building_of_walls_alone_has_no_roof():
    assert roof_points(np.array([[[0, 0, 0], [4, 0, 0], [4, 0, 3]]], dtype=np.float64)).shape == (0, 4)


def test_points_of_a_roof_are_the_same_however_many_triangles_are_looked_at_at_once(monkeypatch):
    generator = np.random.default_rng(0)
    corners = generator.uniform(0, 20, (50, 1, 2)) + generator.uniform(-2, 2, (50, 3, 2))
    triangles = np.concatenate([corners, generator.uniform(3, 3.5, (50, 3, 1))], axis=2)
    whole = roof_points(triangles)
    monkeypatch.setattr("lodbench.methods.flight.roof_sweep._TRIANGLES", 7)
    assert len(whole) > 10
    assert np.array_equal(roof_points(triangles), whole)


def test_what_the_map_lacks_has_a_height_with_a_sigma_or_none(world, photos):
    queries, poses = photos
    pictures = open_pictures(queries, poses, LENS)
    heights = {}
    for seed in range(3):
        wrong, changed = change_map(world, MapErrors(missing=0.1), np.random.default_rng(seed))
        truth = [_base_and_rise(world, world.building_ids.index(name)) for name in changed["missing"]]
        there = CityMap(wrong, threads=1)
        for place in unmapped_buildings(views_of(queries, poses, 0.0), there, pictures):
            middle = np.array(place["outline"][0]).mean(axis=0) - world.origin[:2]
            heights[seed, min(truth, key=lambda each: np.linalg.norm(each[0] - middle))[1]] = place
    assert len(heights) >= 2
    assert any(place["height_m"] is not None for place in heights.values())
    for (_, rise_m), place in heights.items():
        assert (place["height_m"] is None) == (place["sigma_m"] is None)
        if place["height_m"] is not None:
            assert abs(place["height_m"] - rise_m) < 2.5 * place["sigma_m"]
        if place["at_most_m"] is not None:
            assert rise_m < place["at_most_m"] + 1.0


def _base_and_rise(world, row):
    points = world.vertices[world.vertex_starts[row] : world.vertex_starts[row + 1]]
    low, high = points.min(axis=0), points.max(axis=0)
    return 0.5 * (low + high)[:2], float(high[2] - low[2])


def test_what_is_painted_on_the_ground_is_nothing_that_the_map_lacks(world, photos, monkeypatch):
    queries, poses = photos
    wrong, _ = change_map(world, MapErrors(missing=0.1), np.random.default_rng(1))
    shown, there = views_of(queries, poses, 0.0), CityMap(wrong, threads=1)
    pictures, asked = open_pictures(queries, poses, LENS), []

    def painted(points, heights_m, pictures, city_map):
        asked.append(points)
        return RoofCurve(np.where(heights_m < 0.6, 20.0, 0.0), len(pictures))

    assert unmapped_buildings(shown, there, pictures)
    monkeypatch.setattr("lodbench.methods.flight.unmapped_buildings.sweep_place", painted)
    assert unmapped_buildings(shown, there, pictures) == []
    assert asked


def test_photos_that_cannot_be_read_are_as_none(world, photos, tmp_path):
    queries, poses = photos
    (tmp_path / "broken.jpg").write_bytes(b"no picture")
    broken = [replace(query, image=tmp_path / "broken.jpg") for query in queries]
    assert sweep_roofs(open_pictures(broken, poses, LENS), CityMap(world, threads=1)) == {}


def test_what_all_roofs_are_wrong_about_alike_is_told_by_five_that_are_sharp():
    nats = -0.5 * ((HEIGHTS_M - 1.5) / 0.3) ** 2
    curves = {row: RoofCurve(nats, 8) for row in range(5)}
    assert _common(curves) == 1.5
    assert _common({row: curves[row] for row in range(4)}) is None
    assert _common(curves | {5: RoofCurve(np.zeros(len(HEIGHTS_M)), 3)}) == 1.5
