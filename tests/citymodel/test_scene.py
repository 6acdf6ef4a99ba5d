"""Boxes around the buildings of a scene."""

from itertools import pairwise
from operator import attrgetter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodbench.citymodel.model import CityModel, Polygons, SurfaceKind, choose_lod, group_cuts
from lodbench.citymodel.raw import GrowingArray
from lodbench.citymodel.read import mesh_model
from lodbench.citymodel.scene import (
    Scene,
    build_scene,
    building_boxes,
    connected_components,
    number_rows,
    point_bits,
)
from lodbench.citymodel.triangulate import polygons_at
from lodbench.errors import CityModelError
from lodbench.findings import Findings


class TestNumberRows:
    @given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3)), min_size=1, max_size=40))
    def test_like_a_dictionary(self, rows: list[tuple[int, int]]) -> None:
        numbers, first = number_rows([np.array(c, np.uint64) for c in zip(*rows, strict=True)])
        known: dict[tuple[int, int], int] = {}
        assert numbers.tolist() == [known.setdefault(row, len(known)) for row in rows]
        assert [rows[i] for i in first] == list(known)

    def test_colliding_hashes(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("lodbench.citymodel.scene.HASH_ODD", np.uint64(0))
        rows = np.random.default_rng(1).integers(0, 5, (200, 3)).astype(np.uint64)
        numbers, _ = number_rows(list(rows.T))
        _, expected = np.unique(rows, axis=0, return_inverse=True)
        assert (
            len(set(zip(numbers.tolist(), expected.reshape(-1).tolist(), strict=True))) == expected.max() + 1
        )

    def test_negative_zero(self) -> None:
        points = np.array([[0.0, -0.0, 1.0], [-0.0, 0.0, 1.0]])
        assert number_rows(point_bits(points))[0].tolist() == [0, 0]


@given(st.integers(1, 30), st.data())
def test_connected_components(count: int, data: st.DataObject) -> None:
    nodes = st.integers(0, count - 1)
    edges = data.draw(st.lists(st.tuples(nodes, nodes), max_size=40))
    label = list(range(count))
    for _ in range(count):
        for a, b in edges:
            label[a] = label[b] = min(label[a], label[b])
    ends = np.array(edges, np.int64).reshape(-1, 2)
    assert connected_components(count, ends[:, 0], ends[:, 1]).tolist() == label


class TestBuildScene:
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [1 + 1e-9, 1, 0], [5, 5, 5]], np.float64)

    def test_groups_and_shares(self) -> None:
        triangles = np.array([[0, 1, 2], [0, 1, 2], [0, 4, 3]])
        scene = build_scene(self.points, triangles, np.array([1, 0, 1], np.int32), ("a", "b"))
        assert scene.triangle_starts.tolist() == [0, 1, 3]
        assert scene.vertex_starts.tolist() == [0, 3, 7]
        assert scene.triangles.tolist() == [[0, 1, 2], [3, 4, 5], [3, 5, 6]]

    def test_drops_triangles_without_area_and_keeps_empty_buildings(self) -> None:
        triangles = np.array([[2, 4, 0], [0, 1, 2]])
        scene = build_scene(self.points, triangles, np.array([1, 2], np.int32), ("a", "b", "c"))
        assert scene.triangle_starts.tolist() == [0, 0, 0, 1]

    def test_refuses_nothing_and_nan(self) -> None:
        with pytest.raises(CityModelError, match="no surfaces"):
            build_scene(self.points, np.zeros((0, 3), np.int64), np.zeros(0, np.int32), ())
        with pytest.raises(CityModelError, match="not finite"):
            build_scene(self.points * np.nan, np.array([[0, 1, 2]]), np.zeros(1, np.int32), ("a",))


class TestChooseLod:
    @pytest.mark.parametrize(
        ("present", "wanted", "expected"),
        [
            (["0", "1", "2"], None, "1"),
            (["0", "2"], None, "2"),
            (["3"], None, "3"),
            (["0"], None, "0"),
            (["0", "1.2", "1.3", "2.2"], None, "1.2"),
            (["0", "1.2", "1.3", "2.2"], "1", "1.2"),
            (["0", "1.2", "1.3", "2.2"], "LoD2", "2.2"),
            (["1.2", "1.3"], "1.3", "1.3"),
            (["4"], "3", "4"),
            ([""], "1", ""),
        ],
    )
    def test_choice(self, present: list[str], wanted: str | None, expected: str) -> None:
        assert choose_lod(present, wanted, Findings()) == expected

    def test_substitution_is_told(self) -> None:
        findings = Findings()
        choose_lod(["1.2"], "1", findings)
        assert findings.counts() == {"LB402 LOD_SUBSTITUTED": 1}

    def test_absent(self) -> None:
        with pytest.raises(CityModelError, match="file has: 0, 1"):
            choose_lod(["0", "1"], "2", Findings())
        with pytest.raises(CityModelError, match="no geometry"):
            choose_lod([], "1", Findings())


class TestEachBuildingsOwnLevel:
    """a has LoD0 to 2, b LoD0 and 1, c LoD1 and an interior at LoD2, d LoD0 alone."""

    lods = ("2", "0", "1")
    held = (("a", "0"), ("a", "1"), ("a", "2"), ("b", "0"), ("b", "1"), ("c", "1"), ("c", "2"), ("d", "0"))

    def model(self) -> CityModel:
        corners = np.random.default_rng(1).normal(size=(len(self.held), 3, 3))
        kind = [SurfaceKind.INTERIOR if held == ("c", "2") else SurfaceKind.WALL for held in self.held]
        polygons = Polygons(
            points=corners.reshape(-1, 3),
            ring_starts=np.arange(len(self.held) + 1) * 3,
            polygon_starts=np.arange(len(self.held) + 1),
            building=np.array(["abcd".index(building) for building, _ in self.held], np.int32),
            lod=np.array([self.lods.index(lod) for _, lod in self.held], np.int16),
            kind=np.array(kind, np.uint8),
        )
        ids = ("a", "b", "c", "d")
        return CityModel("x", "GML", None, None, np.zeros(3), ids, 0, self.lods, polygons, (8,), Findings())

    @pytest.mark.parametrize(
        ("wanted", "expected"),
        [
            ("finest", {("a", "2"), ("b", "1"), ("c", "1")}),
            ("Coarsest", {("a", "1"), ("b", "1"), ("c", "1")}),
            ("2", {("a", "2"), ("c", "2")}),
            (None, {("a", "1"), ("b", "1"), ("c", "1")}),
        ],
    )
    def test_choice(self, wanted: str | None, expected: set[tuple[str, str]]) -> None:
        name, chosen = polygons_at(self.model(), wanted, Findings())
        assert {self.held[k] for k in np.flatnonzero(chosen)} == expected
        assert name == (wanted or "1").lower()

    def test_what_has_no_walls_is_told(self) -> None:
        mesh = mesh_model(self.model(), "finest")
        assert mesh.scene.lod == "finest"
        assert mesh.scene.triangle_starts.tolist() == [0, 1, 2, 3, 3]
        assert [(f.object_id, f.detail) for f in mesh.findings.items] == [("d", "no finest LoD")]


class TestBlocks:
    @given(st.lists(st.integers(0, 6), max_size=30), st.integers(1, 8))
    def test_groups_are_never_cut(self, groups: list[int], size: int) -> None:
        groups.sort()
        cuts = group_cuts(np.array(groups, np.int64), size)
        assert cuts[0] == 0
        assert cuts[-1] == len(groups)
        for first, last in pairwise(cuts):
            assert first < last
            assert last == len(groups) or groups[last - 1] != groups[last]
            # One group less would be too few.
            assert last - first < size + groups[first:last].count(groups[last - 1])

    @pytest.mark.parametrize("size", [1, 3, 7])
    def test_blocks_make_the_same_mesh(self, size: int, monkeypatch: pytest.MonkeyPatch) -> None:
        """The polygons of a building need not stand together."""
        rng = np.random.default_rng(2)
        corners = [rng.normal(size=(3, 3)) for _ in range(40)]
        corners[7][1] = corners[7][0] + (1e-9, 0, 0)  # no area: a finding that numbers its polygon
        polygons = Polygons(
            points=np.concatenate(corners),
            ring_starts=np.arange(41) * 3,
            polygon_starts=np.arange(41),
            building=rng.integers(0, 9, 40).astype(np.int32),
            lod=np.zeros(40, np.int16),
            kind=np.zeros(40, np.uint8),
        )
        ids = tuple("abcdefghij")
        model = CityModel("x", "GML", None, None, np.zeros(3), ids, 0, ("1",), polygons, (40,), Findings())
        whole = mesh_model(model)
        monkeypatch.setattr("lodbench.citymodel.read.CHUNK_POLYGONS", size)
        parts = mesh_model(model)
        assert parts.scene.digest() == whole.scene.digest()
        assert parts.area_m2 == pytest.approx(whole.area_m2, rel=1e-12)
        assert parts.num_polygons == 40
        key = attrgetter("detail")
        assert sorted(parts.findings.items, key=key) == sorted(whole.findings.items, key=key)
        assert whole.findings.counts() == {"LB104 ZERO_AREA": 1, "LB401 LOD_ABSENT": 1}


@given(st.lists(st.integers(0, 40), max_size=20))
def test_growing_array(sizes: list[int]) -> None:
    blocks = [np.random.default_rng(size).normal(size=(size, 3)) for size in sizes]
    array = GrowingArray(np.float32, (3,))
    for _ in range(2):  # once finished it begins anew
        for block in blocks:
            array.extend(block)
        rows = array.finish()
        assert np.array_equal(rows, np.concatenate([np.zeros((0, 3)), *blocks]).astype(np.float32))


# A roof of three corners, a building that was lost, and another roof.
SCENE = Scene(
    vertices=np.array(
        [[0, 0, 2], [10, 0, 5], [0, 8, 9], [30, 30, 1], [34, 30, 1], [30, 36, 7]], dtype=np.float32
    ),
    triangles=np.arange(6, dtype=np.int32).reshape(2, 3),
    vertex_starts=np.array([0, 3, 3, 6]),
    triangle_starts=np.array([0, 1, 1, 2]),
    building_ids=("a", "lost", "c"),
    lod="1",
    crs=None,
    origin=np.zeros(3),
)


def test_buildings_without_triangles_are_left_out():
    boxes = building_boxes(SCENE)
    np.testing.assert_array_equal(boxes.building, [0, 2])
    np.testing.assert_array_equal(boxes.low, [[0, 0, 2], [30, 30, 1]])
    np.testing.assert_array_equal(boxes.high, [[10, 8, 9], [34, 36, 7]])
    np.testing.assert_array_equal(boxes.bases, [[5, 4, 2], [32, 33, 1]])


@pytest.mark.parametrize(
    ("center", "is_clear"),
    [
        ((5, 4, 6), False),
        ((5, 4, 11.5), True),
        ((11.5, 4, 6), False),
        ((12, 4, 6), True),
        ((32, 33, 8), False),
    ],
)
def test_a_camera_keeps_its_distance_sideways_and_above(center, is_clear):
    assert building_boxes(SCENE).are_clear_of(np.array(center, dtype=float), 2.0) is is_clear
