from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from solid_checks import assert_sound, volume_m3

from lodbench.citymodel.model import SurfaceKind
from lodbench.synthesis.town.extrusion import Body, Strip
from lodbench.synthesis.town.fittings import Annex, RoofBox
from lodbench.synthesis.town.roofs import Roof, flat, gabled, hipped, mansard, serrated
from lodbench.synthesis.town.solid import prism

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
