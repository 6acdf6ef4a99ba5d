import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lodbench.citymodel import mesh_model, open_scene, read_city_model
from lodbench.citymodel.checks import check_city
from lodbench.citymodel.checks.planes import check_planes
from lodbench.citymodel.mesh.obj import read_obj
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.read import city_info
from lodbench.errors import CityModelError
from lodbench.findings import Findings

from .gml_text import write

SQUARE = "v 0 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\n"


def faces(text: str) -> tuple[list[int], list[list[float]]]:
    raw = read_obj(io.BytesIO(text.encode()), "x.obj")
    return raw.building.tolist(), raw.points.tolist()


class TestReadObj:
    @pytest.mark.parametrize(
        "face", ["f 1 2 3 4", "f 1/1 2/2 3/3 4/4", "f 1//7 2//7 3//7 4//7", "f 1/1/1 2/1/1 3/1/1 4/1/1",
                 "f -4 -3 -2 -1", "  f\t1 2 3 4", "f 1 2 \\\n 3 4"],
    )  # fmt: skip
    def test_face_forms(self, face: str) -> None:
        assert faces(SQUARE + face)[1] == [[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]]

    def test_negative_index_counts_from_the_face(self) -> None:
        text = SQUARE + "f -4 -3 -2\nv 9 9 9\nf -2 -3 -4\n"
        assert faces(text)[1][3:] == [[0, 2, 0], [2, 2, 0], [2, 0, 0]]

    def test_a_byte_order_mark_hides_no_vertex(self) -> None:
        assert faces("\ufeff" + SQUARE + "f 1 2 3\n")[1] == [[0, 0, 0], [2, 0, 0], [2, 2, 0]]

    def test_extra_numbers_on_a_vertex(self) -> None:
        text = "v 0 0 0 1\nv 1 0 0 .5 .5 .5\nv 0 1 0\nf 1 2 3\n"
        assert faces(text)[1] == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]

    def test_buildings_hang_together_by_position(self) -> None:
        far = "v 9 0 0\nv 10 0 0\nv 10 1 0\n"
        again = "v 2 2 0\nv 5 5 0\nv 2 5 0\n"  # repeats a corner of the square under a new index
        text = SQUARE + far + again + "f 1 2 3 4\nf 5 6 7\nf 8 9 10\n"
        assert faces(text)[0] == [0, 1, 0]

    def test_stray_elements_are_findings(self) -> None:
        text = (
            "mtllib a\no x\ng y\nusemtl m\ns 1\nl 1 2\np 3\nl 2 3\n" + SQUARE + "vt 0 0\nvn 0 0 1\nf 1 2 3\n"
        )
        raw = read_obj(io.BytesIO(text.encode()), "x.obj")
        assert [item.detail for item in raw.findings.items] == ["2 `l`", "1 `p`", "1 `usemtl`"]
        assert set(raw.findings.counts()) == {"LB208 ELEMENT_IGNORED"}


class TestFaults:
    @pytest.mark.parametrize(
        ("text", "line"),
        [
            (SQUARE + "f 1 2 5", 5),
            (SQUARE + "f 1 2 3\nf 0 1 2", 6),
            (SQUARE + "f -5 1 2", 5),
            (SQUARE + "f 1 2", 5),
            (SQUARE + "f 1 2 x", 5),
            (SQUARE + "f 1 2 3.5", 5),
            (SQUARE + "f 1 2 nan", 5),
            ("v 0 0 nan\n" + SQUARE + "f 1 2 3", 1),
            ("v 0 0\n" + SQUARE + "f 1 2 3", 1),
            (SQUARE + "v 1e999 0 0\nf 1 2 3", 5),
            (SQUARE + "v a b c\nf 1 2 3", 5),
        ],
    )
    def test_names_the_line(self, text: str, line: int) -> None:
        with pytest.raises(CityModelError, match=f"line {line}:"):
            read_obj(io.BytesIO(text.encode()), "x.obj")

    def test_no_faces(self, tmp_path: Path) -> None:
        with pytest.raises(CityModelError, match="no faces"):
            read_city_model(write(tmp_path / "x.obj", SQUARE))


def test_concave_outline_of_many_corners(tmp_path: Path) -> None:
    angles = np.linspace(0, 2 * np.pi, 116)[:-1]
    radius = np.where(np.arange(115) % 2, 5.0, 10.0)
    xy = np.stack([radius * np.cos(angles), radius * np.sin(angles)], axis=1)
    lines = [f"v {x!r} {y!r} 3" for x, y in xy.tolist()] + ["f " + " ".join(map(str, range(1, 116)))]
    model = read_city_model(write(tmp_path / "star.obj", "\n".join(lines)))
    mesh = mesh_model(model)
    x, y = xy.T
    shoelace = 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
    assert len(mesh.scene.triangles) == 113
    assert mesh.area_m2 == pytest.approx(shoelace, rel=1e-12)
    assert mesh.meshed_m2 == pytest.approx(shoelace, rel=1e-9)
    assert mesh.findings.counts() == {}


@pytest.mark.attack
def test_a_face_of_too_many_corners_is_told_as_lost_at_once(tmp_path: Path) -> None:
    turns = np.linspace(0, 400 * np.pi, 200_000)
    lines = [f"v {r * np.cos(a):.4f} {r * np.sin(a):.4f} 0" for a, r in zip(turns, turns, strict=True)]
    lines += ["f " + " ".join(map(str, range(1, len(turns) + 1))), "v 0 0 9", "v 9 0 9", "v 0 9 9"]
    lines += [f"f {len(turns) + 1} {len(turns) + 2} {len(turns) + 3}"]
    mesh = mesh_model(read_city_model(write(tmp_path / "spiral.obj", "\n".join(lines))))
    assert (len(mesh.scene.triangles), mesh.meshed_m2) == (1, pytest.approx(40.5))
    assert mesh.lost_m2 == pytest.approx(mesh.area_m2 - 40.5)
    (finding,) = mesh.findings.items
    assert finding.detail.endswith("200,000 corners are not cut")


@pytest.mark.attack
def test_a_face_of_many_corners_that_cross_is_not_looked_at_for_crossings(tmp_path: Path) -> None:
    corners = np.random.default_rng(0).random((100_000, 2)) * 1000
    lines = [f"v {x:.3f} {y:.3f} 0" for x, y in corners]
    lines += ["f " + " ".join(map(str, range(1, len(corners) + 1)))]
    findings = Findings()
    check_planes(read_city_model(write(tmp_path / "random.obj", "\n".join(lines))), findings)
    assert not findings.items


@pytest.mark.attack
def test_a_level_that_is_lost_whole_is_told_too(tmp_path: Path) -> None:
    model = read_city_model(write(tmp_path / "flat.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"))
    assert city_info(model)["findings"] == {"LB104 ZERO_AREA": 1}
    assert [row.code.name for row in check_city(model).rows] == ["ZERO_AREA"]


def test_obj_serves_any_lod(tmp_path: Path) -> None:
    path = write(tmp_path / "Häuser (1), a=b.obj", SQUARE + "f 1 2 3 4\n")
    assert open_scene(path, lod="1").lod == ""
    assert open_scene(path).crs is None


def test_real_model(shared_data: Path) -> None:
    model = read_city_model(shared_data / "uavd4l" / "UAVD4L-LoD1.obj")
    assert sum(model.polygons_read) == 16_511
    assert len(model.building_ids) == 702
    assert np.array_equal(model.origin, np.zeros(3))
    mesh = mesh_model(model)
    assert len(mesh.scene.vertices) == 30_963
    assert mesh.lost_m2 / mesh.area_m2 < 1e-5
    assert mesh.findings.counts()["LB106 AREA_MISMATCH"] == 38


@pytest.mark.parametrize(("up_axis", "high"), [("auto", [4, 5, 3]), ("z", [4, 5, 3]), ("y", [4, 0, 5])])
def test_the_axis_that_points_up(tmp_path: Path, up_axis: Any, high: list[float]) -> None:
    text = "v 0 0 0\nv 4 0 0\nv 4 5 3\nf 1 2 3\n"
    model = read_city_model(write(tmp_path / "up.obj", text), options=ReadOptions(up_axis=up_axis))
    assert model.polygons.points.max(axis=0).tolist() == high
    assert model.polygons.points[2].tolist() == ([4, -3, 5] if up_axis == "y" else [4, 5, 3])
