from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodbench.citymodel.identity import connected_components, number_rows, point_bits
from lodbench.citymodel.lods import choose_lod
from lodbench.citymodel.scene import build_scene
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
        monkeypatch.setattr("lodbench.citymodel.identity._MULTIPLIER", np.uint64(0))
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
