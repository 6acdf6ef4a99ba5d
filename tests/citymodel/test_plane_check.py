"""Polygons that are unsound in their plane, upright and lying, each with its code and place."""

import pytest

from lodbench.citymodel import read_city_model
from lodbench.citymodel.checks.planes import check_planes
from lodbench.findings import Finding, Findings

from .gml_text import city, member, multi_surface, polygon, surface_members, write

E, N = 500000.0, 5600000.0
SQUARE = [(0, 0), (10, 0), (10, 10), (0, 10)]
HOLE = [(2, 2), (2, 4), (4, 4), (4, 2)]


def lift(ring: list[tuple[float, float]], is_upright: bool) -> list[tuple[float, float, float]]:
    return [(E + x, N, 50.0 + y) if is_upright else (E + x, N + y, 50.0) for x, y in ring]


def moved(
    ring: list[tuple[float, float]], dx: float, dy: float, scale: float = 1.0
) -> list[tuple[float, float]]:
    return [(dx + scale * x, dy + scale * y) for x, y in ring]


@pytest.mark.parametrize("is_upright", [False, True])
@pytest.mark.parametrize(
    ("outline", "holes", "code"),
    [
        (SQUARE, [HOLE], None),
        ([(0, 0), (10, 0), (10, 10), (5, 0), (0, 10)], [], "LB112"),
        ([(0, 0), (10, 0), (10, 10), (3, -3), (0, 10)], [], "LB112"),
        (SQUARE, [moved(HOLE, 7, 0)], "LB113"),
        (SQUARE, [SQUARE[::-1]], None),
        (SQUARE, [HOLE, HOLE], "LB114"),
        (SQUARE, [[(0, 5), (5, 10), (10, 5), (5, 0)]], "LB115"),
        (SQUARE, [moved(HOLE, 20, 0)], "LB116"),
        (SQUARE, [moved(HOLE, -3, -3, 2.5), moved(HOLE, 1, 1)], "LB117"),
        (SQUARE, [HOLE[::-1]], "LB118"),
    ],
)
def test_codes(tmp_path, outline, holes, code, is_upright):
    text = polygon(lift(outline, is_upright), [lift(hole, is_upright) for hole in holes])
    model = read_city_model(write(tmp_path / "a.gml", city(member(multi_surface(surface_members([text]))))))
    findings = Findings()
    check_planes(model, findings)
    found = [item.code.code for item in findings.items]
    assert found == ([] if code is None else [code])
    assert all(_is_in_town(item) for item in findings.items)


def _is_in_town(item: Finding) -> bool:
    assert item.place is not None
    x, y, z = item.place
    return E - 30 <= x <= E + 30 and N - 30 <= y <= N + 30 and 20 <= z <= 80 and item.polygon == 0
