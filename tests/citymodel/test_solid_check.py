"""Solids that cut themselves or each other, lie twice or inside out of place: each with its code."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .gml_text import Ring, box_rings, city, member, polygon, surface_members
from .test_shells import BOX, defects

X, Y, Z = 500000.0, 5600000.0, 50.0


def moved(rings: Sequence[Ring], x: float = 0.0, y: float = 0.0, z: float = 0.0) -> list[Ring]:
    return [[(a + x, b + y, c + z) for a, b, c in ring] for ring in rings]


def shell(rings: Sequence[Ring]) -> str:
    return f"<gml:CompositeSurface>{surface_members(map(polygon, rings))}</gml:CompositeSurface>"


def solids(*shapes: Sequence[Sequence[Ring]]) -> str:
    """A building of several solids, each of an outer shell and inner ones."""
    texts = []
    for outer, *inner in shapes:
        holes = "".join(f"<gml:interior>{shell(rings)}</gml:interior>" for rings in inner)
        texts.append(f"<gml:Solid><gml:exterior>{shell(outer)}</gml:exterior>{holes}</gml:Solid>")
    members = "".join(f"<gml:solidMember>{text}</gml:solidMember>" for text in texts)
    return city(
        member(f"<bldg:lod2Solid><gml:CompositeSolid>{members}</gml:CompositeSolid></bldg:lod2Solid>")
    )


def turned(rings: Sequence[Ring]) -> list[Ring]:
    return [list(ring)[::-1] for ring in rings]


SMALL = box_rings(X + 3, Y + 3, Z + 2, 2.0, 2.0)


def test_sound_solids_stay_unreported(tmp_path):
    # Side by side, the wall between them is one polygon, seen from both sides.
    assert list(defects(tmp_path, solids([BOX], [moved(BOX, x=10)]))) == ["LB109"]
    assert defects(tmp_path, solids([BOX, turned(SMALL)])) == {}  # a hole in its middle


def test_a_solid_of_which_no_face_is_left(tmp_path: Path) -> None:
    nowhere: list[Ring] = [[(X, Y, float("nan"))] * 4 for _ in range(6)]
    assert list(defects(tmp_path, solids([nowhere]))) == ["LB107"]


def test_solids_that_cut_each_other(tmp_path: Path) -> None:
    found = defects(tmp_path, solids([BOX], [moved(BOX, x=5, y=3, z=2)]))
    assert list(found) == ["LB613"]


def test_a_solid_twice(tmp_path):
    # Slightly off, so that the copies are no copies of polygons, and within the tolerance of corners.
    found = defects(tmp_path, solids([BOX], [moved(BOX, z=1e-5)]))
    assert "LB614" in found


def test_a_hole_that_cuts_its_outside(tmp_path: Path) -> None:
    assert "LB610" in defects(tmp_path, solids([BOX, turned(moved(SMALL, z=3))]))


def test_a_hole_beside_its_solid(tmp_path: Path) -> None:
    found = defects(tmp_path, solids([BOX, turned(moved(SMALL, x=30))]))
    assert list(found) == ["LB612"]


def test_the_same_hole_twice(tmp_path: Path) -> None:
    assert "LB611" in defects(tmp_path, solids([BOX, turned(SMALL), turned(moved(SMALL, z=1e-5))]))


def test_a_shell_that_cuts_itself(tmp_path):
    # A prism whose top is turned against its bottom so far that its sides pass through each other.
    angles = np.radians(np.arange(5) * 72.0)
    low = [(X + 5 * float(np.cos(a)), Y + 5 * float(np.sin(a)), Z) for a in angles]
    high = [(X + 5 * float(np.cos(a)), Y + 5 * float(np.sin(a)), Z + 6) for a in angles + np.radians(150.0)]
    sides: list[Ring] = []
    for k in range(5):
        m = (k + 1) % 5
        sides += [[low[k], low[m], high[m]], [low[k], high[m], high[k]]]
    found = defects(tmp_path, solids([[low[::-1], high, *sides]]))
    assert "LB609" in found


def test_a_folded_polygon(tmp_path: Path) -> None:
    low, high, *walls = BOX
    # A narrow tooth that stands up by 8 mm over 10 mm: planar to a centimetre, and folded.
    a, b, c, d = high
    tooth = [(b[0], b[1] + 5, b[2]), (b[0] + 0.01, b[1] + 5.0, b[2] + 0.009), (b[0], b[1] + 5.02, b[2])]
    found = defects(tmp_path, solids([[low, [a, b, *tooth, c, d], *walls]]))
    assert "LB119" in found
    assert "LB105" not in found


def test_solids_of_a_composite_that_do_not_touch(tmp_path: Path) -> None:
    found = defects(tmp_path, solids([BOX], [moved(BOX, x=20)]))
    assert list(found) == ["LB616"]
    assert "2 solids in 2 pieces" in str(found["LB616"])
    # A third one between the two joins them, by part of a wall; an edge or a corner alone joins nothing.
    between = box_rings(X + 10, Y + 2, Z, 10.0, 3.0)
    assert "LB616" not in defects(tmp_path, solids([BOX], [moved(BOX, x=20)], [between]))
    assert "LB616" in defects(tmp_path, solids([BOX], [moved(BOX, x=10, y=10)]))


def test_solids_of_no_composite_may_stand_apart(tmp_path: Path) -> None:
    text = solids([BOX], [moved(BOX, x=20)]).replace("CompositeSolid", "MultiSolid")
    assert defects(tmp_path, text) == {}


def test_a_hole_that_cuts_the_inside_in_two(tmp_path: Path) -> None:
    """Two pyramids, base on base, whose base reaches all four walls; or a little less."""
    for reach, codes in ((0.0, ["LB615"]), (0.5, [])):
        low, high = reach, 10 - reach
        plan = ((low, low), (high, low), (high, high), (low, high))
        corners = [(X + x, Y + y, Z + 2.5) for x, y in plan]
        hole: list[Ring] = []
        for k in range(4):
            m = (k + 1) % 4
            hole += [[corners[m], corners[k], (X + 5, Y + 5, Z + 4)]]
            hole += [[corners[k], corners[m], (X + 5, Y + 5, Z + 1)]]
        assert list(defects(tmp_path, solids([BOX, hole]))) == codes
