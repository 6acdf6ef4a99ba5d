import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodbench.citymodel.model import Polygons, starts_of
from lodbench.citymodel.triangulate import Triangulation, triangulate
from lodbench.findings import Findings


def polygons_of(*polygons: list[NDArray[np.float64]]) -> Polygons:
    rings = [ring for polygon in polygons for ring in polygon]
    count = len(polygons)
    return Polygons(
        points=np.concatenate(rings),
        ring_starts=starts_of(np.array([len(ring) for ring in rings])),
        polygon_starts=starts_of(np.array([len(polygon) for polygon in polygons])),
        building=np.zeros(count, np.int32),
        lod=np.zeros(count, np.int16),
        kind=np.zeros(count, np.uint8),
    )


def mesh(*polygons: list[NDArray[np.float64]]) -> tuple[Triangulation, dict[str, int]]:
    findings = Findings()
    result = triangulate(polygons_of(*polygons), ("b",), findings)
    return result, findings.counts()


def ring(*points: tuple[float, ...]) -> NDArray[np.float64]:
    return np.array([(*p, 0.0)[:3] for p in points], np.float64)


EAST = np.array([1.0, 0.0, 0.0])
SQUARE = ring((0, 0), (4, 0), (4, 4), (0, 4))


@st.composite
def rotations(draw: st.DrawFn) -> NDArray[np.float64]:
    numbers = st.floats(-1, 1)
    matrix = np.array([[draw(numbers) for _ in range(3)] for _ in range(3)]) + 2 * np.eye(3)
    rotation, _ = np.linalg.qr(matrix)
    return rotation * np.sign(np.linalg.det(rotation))


@st.composite
def star_polygons(draw: st.DrawFn) -> NDArray[np.float64]:
    """Simple plane polygons, concave as a rule: corners in angular order at various radii."""
    radii = draw(st.lists(st.floats(0.5, 20), min_size=3, max_size=30))
    angles = np.linspace(0, 2 * np.pi, len(radii), endpoint=False)
    return np.stack([radii * np.cos(angles), radii * np.sin(angles), 0 * angles], axis=1)


@given(star_polygons(), rotations(), st.booleans())
def test_area_and_orientation(outline: NDArray[np.float64], turn: NDArray[np.float64], flip: bool) -> None:
    points = (outline[::-1] if flip else outline) @ turn.T + [3e5, 5e6, 100.0]
    result, counts = mesh([points])
    x, y = outline[:, 0], outline[:, 1]
    expected = 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
    assert counts == {}
    assert result.area_m2[0] == pytest.approx(expected, rel=1e-7)
    assert result.meshed_m2[0] == pytest.approx(expected, rel=1e-7)
    corners = points[result.triangles] - points[0]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.all(normals @ turn[:, 2] * (-1 if flip else 1) > -1e-6)


@given(star_polygons(), rotations())
def test_holes_of_either_orientation(outline: NDArray[np.float64], turn: NDArray[np.float64]) -> None:
    frame = ring((-25, -25), (25, -25), (25, 25), (-25, 25))
    areas = {
        mesh([frame @ turn.T, hole @ turn.T])[0].meshed_m2[0].round(6) for hole in (outline, outline[::-1])
    }
    assert len(areas) == 1
    assert mesh([frame @ turn.T, outline @ turn.T])[1] == {}


class TestQuads:
    @pytest.mark.parametrize("start", range(4))
    def test_concave_from_every_corner(self, start: int) -> None:
        dart = np.roll(ring((0, 0), (4, 0), (1, 1), (0, 4)), start, axis=0)
        result, counts = mesh([dart])
        assert counts == {}
        assert result.meshed_m2[0] == pytest.approx(4.0)
        assert len(result.triangles) == 2

    def test_corner_on_an_edge_makes_no_empty_triangle(self) -> None:
        result, _ = mesh([ring((0, 0), (2, 0), (4, 0), (0, 4))])
        corners = ring((0, 0), (2, 0), (4, 0), (0, 4))[result.triangles]
        areas = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
        assert areas.min() > 1

    def test_upright_wall(self) -> None:
        wall = np.array([[0, 0, 0], [3, 4, 0], [3, 4, 10], [0, 0, 10]], np.float64)
        assert mesh([wall])[0].meshed_m2.tolist() == [50.0]


class TestFindings:
    def test_line_has_no_area(self) -> None:
        result, counts = mesh([ring((0, 0), (1, 1), (2, 2))], [SQUARE])
        assert counts == {"LB104 ZERO_AREA": 1}
        assert result.polygon.tolist() == [1, 1]

    @pytest.mark.parametrize(
        "outline",
        [ring((0, 0), (4, 4), (4, 0), (0, 3)), ring((0, 0), (4, 0), (4, 4), (1, -1), (0, 4))],
        ids=["bow-tie", "pentagon"],
    )
    def test_crossing_rings(self, outline: NDArray[np.float64]) -> None:
        assert "LB106 AREA_MISMATCH" in mesh([outline])[1]

    def test_halves_that_cancel_out_are_lost_and_ways_there_and_back_are_not(self) -> None:
        bow_tie, way = ring((0, 0), (4, 4), (4, 0), (0, 4)), ring((0, 0), (4, 0), (4, 4), (4, 0))
        result, counts = mesh([bow_tie], [way], [SQUARE])
        assert counts == {"LB104 ZERO_AREA": 1, "LB106 AREA_MISMATCH": 1}
        assert result.area_m2.tolist() == pytest.approx([8.0, 0.0, 16.0])
        assert result.lost_m2 == pytest.approx(8.0)

    def test_hole_outside(self) -> None:
        assert "LB106 AREA_MISMATCH" in mesh([SQUARE, 0.5 * SQUARE + 10.0 * EAST])[1]

    def test_bent(self) -> None:
        roof = SQUARE.copy()
        roof[0, 2] = 0.5
        result, counts = mesh([roof])
        assert counts == {"LB105 NOT_PLANAR": 1}
        assert result.meshed_m2[0] > result.area_m2[0]
        assert result.lost_m2 < 1e-9

    def test_far_from_any_plane(self) -> None:
        roof = 10 * SQUARE
        roof[0, 2] = 12.6
        assert mesh([roof])[1] == {"LB111 FAR_FROM_PLANAR": 1}

    def test_a_centimetre_is_planar(self) -> None:
        roof = SQUARE.copy()
        roof[0, 2] = 0.01
        assert mesh([roof])[1] == {}


def test_nothing() -> None:
    empty = Polygons(
        np.zeros((0, 3)), np.zeros(1, np.int64), np.zeros(1, np.int64),
        np.zeros(0, np.int32), np.zeros(0, np.int16), np.zeros(0, np.uint8),
    )  # fmt: skip
    assert len(triangulate(empty, (), Findings()).triangles) == 0
