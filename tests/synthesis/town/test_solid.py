"""Solids, shapes, relief and props of drawn towns."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lxml import etree
from solid_checks import assert_sound, volume_m3

from lodbench.citymodel import ReadOptions
from lodbench.citymodel.model import SurfaceKind
from lodbench.citymodel.surface.ground import ground_under
from lodbench.kernels.looks import SurfaceClass
from lodbench.synthesis.town import shapes
from lodbench.synthesis.town.build import ascii_grid_text, relief_text
from lodbench.synthesis.town.buildings import Annex, RoofBox
from lodbench.synthesis.town.props import demo_props
from lodbench.synthesis.town.roofs import Body, Roof, Strip, flat, gabled, hipped, mansard, serrated
from lodbench.synthesis.town.shapes import prism
from lodbench.synthesis.town.town import ORIGIN_M, filled, refined

SQUARE = np.array([[0.0, 0.0], [40.0, 0.0], [40.0, 30.0], [0.0, 30.0]])


def turned(points: np.ndarray, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, s], [-s, c]]) + [310.5, -42.25]


def bar(length: float = 20.0, depth: float = 10.0, angle: float = 0.0) -> Strip:
    return Strip.bent(turned(np.array([[0.0, 0.0], [length, 0.0]]), angle), [depth])


def built(strip: Strip, roof: Roof, *details: Annex | RoofBox):
    body = Body(strip, roof, 100.0)
    for detail in details:
        detail.add_to(body)
    return body.builder.build()


def kinds(solid) -> dict[str, int]:
    return {kind.name: sum(face.kind == kind for face in solid.faces) for kind in SurfaceKind if kind}


@pytest.mark.parametrize(
    ("roof", "volume"),
    [
        (flat(6.0), 20 * 10 * 6.0),
        (gabled(6.0, 45.0, 10.0), 20 * 10 * 6.0 + 20 * 10 * 5.0 / 2),
        # A hipped roof is a prism of the ridge's length and two half pyramids.
        (hipped(6.0, 45.0, 10.0, 20.0), 20 * 10 * 6.0 + 10 * 10 * 5.0 / 2 + 10 * 10 * 5.0 / 3),
        (serrated(6.0, 2.0, 3), 20 * 10 * 7.0),
    ],
)
def test_volumes_by_hand(roof, volume):
    solid = built(bar(), roof)
    assert_sound(solid)
    assert volume_m3(solid) == pytest.approx(volume, rel=1e-3)


def test_a_square_hipped_roof_is_a_pavilion():
    roof = hipped(5.0, 40.0, 10.0, 10.0)
    assert roof.name == "pavilion"
    solid = built(bar(10.0, 10.0), roof)
    assert_sound(solid)
    assert kinds(solid)["ROOF"] == 4


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1, 3),
    st.floats(0, 6.28),
    st.floats(7, 12),
    st.floats(3, 20),
    st.floats(15, 55),
    st.sampled_from(["flat", "gabled", "hipped", "mansard"]),
)
def test_wings_are_closed_at_any_angle(wings, angle, depth, eave, pitch, kind):
    corners = np.array([[0.0, 0.0], [34.0, 0.0], [38.0, 31.0], [5.0, 36.0]])[: wings + 1]
    roof = {
        "flat": flat(eave),
        "gabled": gabled(eave, pitch, depth, 0.45),
        "hipped": hipped(eave, pitch, depth, 34.0),
        "mansard": mansard(eave, depth),
    }[kind]
    assert_sound(built(Strip.bent(turned(corners, angle), [depth] * wings), roof))


@given(st.floats(0, 6.28), st.floats(6, 12), st.sampled_from([flat(9.0), gabled(9.0, 40.0, 10.0)]))
def test_courtyards_are_closed(angle, depth, roof):
    solid = built(Strip.bent(turned(SQUARE, angle), [depth] * 4, closed=True), roof)
    assert_sound(solid)
    assert sum(len(face.rings) == 2 for face in solid.faces if face.kind == SurfaceKind.GROUND) == 1


@settings(max_examples=60, deadline=None)
@given(
    st.floats(0, 6.28),
    st.sampled_from(["outer", "inner", "first", "last"]),
    st.floats(0.5, 3.0),
    st.floats(2.0, 5.0),
    st.sampled_from([flat(6.0), gabled(6.0, 40.0, 10.0), hipped(6.0, 35.0, 10.0, 20.0)]),
)
def test_annexes_keep_a_body_closed(angle, side, start, length, roof):
    plain = built(bar(angle=angle), roof)
    solid = built(bar(angle=angle), roof, Annex(side, 0, start, length, 3.0, 2.8))
    assert_sound(solid)
    assert volume_m3(solid) - volume_m3(plain) == pytest.approx(length * 3.0 * 2.8, rel=5e-3)


@pytest.mark.parametrize("slope", [0, 1])
def test_dormers_keep_a_body_closed(slope):
    strip, roof = bar(angle=0.7), gabled(6.0, 45.0, 10.0)
    boxes = [RoofBox(0, slope, start, 1.5, 1.0, 2.0) for start in (2.0, 6.0, 10.0)]
    assert all(box.fits(Body(strip, roof, 100.0)) for box in boxes)
    solid = built(strip, roof, *boxes)
    assert_sound(solid)
    # A dormer is half a box: its roof runs level from its front into the slope.
    assert volume_m3(solid) - volume_m3(built(strip, roof)) == pytest.approx(
        3 * 1.5 * 2.0 * 2.0 / 2, rel=0.01
    )


def test_boxes_on_flat_roofs_keep_a_body_closed():
    solid = built(bar(), flat(20.0), RoofBox(0, 0, 4.0, 4.0, 3.0, 3.0, 2.5))
    assert_sound(solid)
    assert volume_m3(solid) == pytest.approx(20 * 10 * 20 + 4 * 3 * 2.5)


def test_boxes_that_leave_their_face_do_not_fit():
    body = Body(bar(), hipped(6.0, 45.0, 10.0, 20.0), 100.0)
    assert not RoofBox(0, 0, 0.5, 1.5, 3.0, 1.0).fits(body)
    assert RoofBox(0, 0, 8.0, 1.5, 1.0, 2.0).fits(body)


def test_prism_with_a_hole():
    hole = np.array([[10.0, 10.0], [10.0, 20.0], [30.0, 20.0], [30.0, 10.0]])
    solid = prism([SQUARE, hole], 50.0, 60.0)
    assert_sound(solid)
    assert volume_m3(solid) == pytest.approx((40 * 30 - 20 * 10) * 10)


RECTANGLE = np.array([[0.0, 0.0], [30.0, 0.0], [30.0, 20.0], [0.0, 20.0]])


def test_area_and_angles():
    assert shapes.area(RECTANGLE) == 600.0
    assert shapes.area(RECTANGLE[::-1]) == -600.0
    np.testing.assert_allclose(shapes.corner_angles_deg(RECTANGLE), 90.0)


def test_inset_moves_every_edge():
    inner = shapes.inset(RECTANGLE, 4.0)
    assert inner is not None
    np.testing.assert_allclose(inner, [[4, 4], [26, 4], [26, 16], [4, 16]])
    assert shapes.inset(RECTANGLE, 10.0) is None


def test_cut_keeps_the_inward_side():
    part = shapes.cut(RECTANGLE, np.array([10.0, 0.0]), np.array([1.0, 0.0]))
    assert shapes.area(part) == pytest.approx(400.0)
    assert len(shapes.cut(RECTANGLE, np.array([40.0, 0.0]), np.array([1.0, 0.0]))) == 0


def test_contains_handles_notches():
    notched = np.array([[0, 0], [10, 0], [10, 10], [5, 4], [0, 10]], dtype=float)
    inside = shapes.contains(notched, np.array([[5.0, 2.0], [5.0, 8.0], [1.0, 8.0], [11.0, 1.0]]))
    np.testing.assert_array_equal(inside, [True, False, True, False])


@given(st.floats(-40, 40), st.floats(-40, 40), st.floats(0, 180))
def test_keeps_apart_agrees_with_the_overlap(x, y, angle):
    other = cv2.boxPoints(((x, y), (18.0, 9.0), angle)).astype(float)
    other = other if shapes.area(other) > 0 else other[::-1]
    clipped = RECTANGLE
    for corner, left in zip(other, shapes.left_of(shapes.edge_directions(other)), strict=True):
        clipped = shapes.cut(clipped, corner, left)
    overlap = shapes.area(clipped) if len(clipped) > 2 else 0.0
    if shapes.keeps_apart(RECTANGLE, other, 0.0):
        assert overlap < 1e-6
    else:
        assert overlap > 0.0


def test_touching_walls_are_apart_but_leave_no_gap():
    neighbour = RECTANGLE + np.array([30.0, 0.0])
    assert shapes.keeps_apart(RECTANGLE, neighbour, 0.0)
    assert not shapes.keeps_apart(RECTANGLE, neighbour, 0.5)


def test_box_of_follows_the_longer_side():
    turn = np.radians(25.0)
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    along, length, width = shapes.box_of(RECTANGLE @ rotation)
    assert (length, width) == (pytest.approx(30.0), pytest.approx(20.0))
    assert abs(along @ np.array([np.cos(turn), np.sin(turn)])) == pytest.approx(1.0)


GML = "{http://www.opengis.net/gml}"


def test_the_raster_gives_readers_the_ground_of_the_town(town, tmp_path):
    path = tmp_path / "terrain.asc"
    path.write_text(ascii_grid_text(town.terrain), encoding="ascii")
    places = np.random.default_rng(0).uniform(-600, 600, (500, 2))
    found = ground_under(places + ORIGIN_M[:2], "EPSG:25832", ReadOptions(terrain=str(path)))
    wrong = np.abs(found - town.terrain.height(places))
    # Cells of four metres on slopes of up to a tenth; the banks of the river are steeper.
    assert np.median(wrong) < 0.06
    assert np.percentile(wrong, 99) < 1.0


def test_the_relief_is_a_tin_whose_corners_are_the_ground(town):
    root = etree.fromstring(relief_text(town.terrain, "relief").encode())
    triangles = root.findall(f".//{GML}Triangle//{GML}posList")
    assert len(triangles) == 2 * 64 * 64
    corners = np.array([[float(v) for v in t.text.split()] for t in triangles[::50]]).reshape(-1, 4, 3)
    np.testing.assert_array_equal(corners[:, 0], corners[:, 3])
    local = corners[:, :3].reshape(-1, 3) - ORIGIN_M
    np.testing.assert_allclose(local[:, 2], town.terrain.height(local[:, :2]), atol=0.001)
    a, b, c = (corners[:, k] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


@pytest.mark.slow
def test_hills_are_higher_where_the_look_says_so(town, town_of):
    places = np.stack(np.meshgrid(*[np.arange(-500.0, 501.0, 50.0)] * 2), axis=-1).reshape(-1, 2)
    assert 25.0 < np.ptp(town.terrain.height(places)) < 70.0
    assert town_of(1).terrain.height(places)[0] != pytest.approx(town.terrain.height(places)[0], abs=0.1)


@pytest.fixture(scope="module")
def props(town):
    return demo_props(town)


def corners_of(props, *kinds):
    chosen = np.isin(props.surface, kinds)
    return props.vertices[props.triangles[chosen]].astype(float)


@pytest.mark.slow
def test_every_class_is_there_and_indices_hold(props, town):
    assert set(np.unique(props.surface)) == set(SurfaceClass) - {SurfaceClass.CLUTTER}
    assert props.triangles.min() == 0
    assert props.triangles.max() == len(props.vertices) - 1
    assert np.isfinite(props.vertices).all()
    assert props.has_buildings
    assert props.num_buildings == len(town.standing)
    is_building = (props.surface >= SurfaceClass.WALL) & (props.surface < SurfaceClass.TRUNK)
    np.testing.assert_array_equal(props.objects < props.num_buildings, is_building)
    np.testing.assert_array_equal(props.origin, ORIGIN_M)


def test_buildings_are_those_of_the_town(props, town):
    for number in (0, 40, 300):
        solid = town.standing[number].lod3
        mine = (props.objects == number) & np.isin(props.surface, (20, 21, 22, 23, 24, 27))
        corners = props.vertices[props.triangles[mine]].astype(float)
        middle = corners.reshape(-1, 3).mean(axis=0)
        crossed = np.cross(corners[:, 0] - middle, corners[:, 1] - middle)
        volume = np.sum(crossed * (corners[:, 2] - middle)) / 6.0
        assert volume == pytest.approx(volume_m3(solid), rel=1e-3)


def test_ground_faces_up_and_lies_on_the_terrain(props, town):
    for kind in (SurfaceClass.ROAD, SurfaceClass.MARKING, SurfaceClass.PAVEMENT, SurfaceClass.GRASS):
        corners = corners_of(props, kind)[::7]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        middle = corners.mean(axis=1)
        above = middle[:, 2] - town.terrain.height(middle[:, :2])
        # Bridges and their parapets are off the ground.
        dry = town.terrain.river_distance(middle[:, :2]) > 45.0
        assert (normal[dry, 2] > 0).all(), kind
        assert np.abs(above[dry]).max() < 0.3, kind


def test_layers_of_the_ground_stay_in_order(town):
    # The road under a block and the pavement on it are two meshes of one hill.
    block = town.streets.blocks[3].ring
    points, triangles = refined(*filled(block), lambda middles: np.full(len(middles), 12.0))
    middles = town.terrain.on_ground(points, 0.12)[triangles].mean(axis=1)
    assert (middles[:, 2] > town.terrain.height(middles[:, :2]) + 0.05).all()


def test_trees_stand_clear_of_buildings_and_cars_on_roads(props, town):
    trunks = corners_of(props, SurfaceClass.TRUNK).mean(axis=1)
    assert (town.occupancy.at(trunks[:, :2]) == 0).all()
    cars = corners_of(props, SurfaceClass.CAR_BODY).mean(axis=1)
    assert np.mean(town.occupancy.at(cars[:, :2]) == 0) > 0.999
    above = cars[:, 2] - town.terrain.height(cars[:, :2])
    assert above.min() > -0.2
    assert above.max() < 2.2
    leaves = corners_of(props, SurfaceClass.FOLIAGE)
    assert (leaves.mean(axis=1)[:, 2] > town.terrain.height(leaves.mean(axis=1)[:, :2])).mean() > 0.99


@pytest.mark.slow
def test_the_same_town_has_the_same_props(props, town):
    again = demo_props(town)
    np.testing.assert_array_equal(again.vertices, props.vertices)
    np.testing.assert_array_equal(again.triangles, props.triangles)
    np.testing.assert_array_equal(again.tint, props.tint)


def test_refining_leaves_no_cracks_and_no_area_behind():
    ring = np.array([[0.0, 0.0], [90.0, 5.0], [100.0, 70.0], [40.0, 95.0], [30.0, 40.0]])
    points, triangles = refined(*filled(ring), lambda middles: 4.0 + 0.2 * np.abs(middles[:, 0]))
    a, b, c = (points[triangles[:, k]] for k in range(3))
    double = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    x, y = ring.T
    expected = 0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)
    assert (double > 0).all()
    assert 0.5 * double.sum() == pytest.approx(expected)
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    assert counts.max() == 2
    # An edge with one triangle lies on the outline: a crack would be inside.
    border = points[unique[counts == 1]]
    assert np.linalg.norm(border[:, 1] - border[:, 0], axis=1).sum() == pytest.approx(
        np.linalg.norm(ring - np.roll(ring, 1, axis=0), axis=1).sum()
    )
