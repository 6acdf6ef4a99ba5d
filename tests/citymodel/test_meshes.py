"""Meshes as cities: needs, damage, files they name, pictures; the same city when written and read again."""

import io
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from lodbench.citymodel import ReadOptions, mesh_model, open_scene, read_city_model
from lodbench.citymodel.checks.report import check_city, check_planes, city_info
from lodbench.citymodel.convert import convert_city
from lodbench.citymodel.mesh.reader import frame_of_comments, frame_of_extras, read_obj
from lodbench.citymodel.textured_map import read_textured
from lodbench.cli import main
from lodbench.errors import CityModelError, DatasetError
from lodbench.findings import Findings

from .gml_text import box_city, write
from .textured_case import assert_is_the_roof, write_glb, write_gltf, write_gml, write_obj, write_picture


class TestMeshes:
    def test_a_mesh_needs_nothing_but_triangles(self, tmp_path: Path) -> None:
        corners = "vertex 0 0 1\nvertex 2 0 1\nvertex 0 2 1"
        text = f"solid a\nfacet normal 0 0 1\nouter loop\n{corners}\nendloop\nendfacet\nendsolid a\n"
        path = write(tmp_path / "a.stl", text)
        model = read_city_model(path, options=ReadOptions(up_axis="y"))
        assert model.format == "STL"
        assert model.polygons.points.tolist() == [[0, -1, 0], [2, -1, 0], [0, -1, 2]]

    @pytest.mark.parametrize("name", ["a.ply", "a.glb", "a.stl", "a.gltf"])
    @pytest.mark.parametrize(
        "content", [b"ply\nformat ascii 1.0\nend_header\n", b"glTF\x02\0\0\0", b"solid\n", b"{}"]
    )
    def test_damage(self, tmp_path: Path, name: str, content: bytes) -> None:
        with pytest.raises(CityModelError):
            read_city_model(write(tmp_path / name, content))

    def test_external_files_are_not_opened(self, tmp_path: Path) -> None:
        write(tmp_path / "b.bin", bytes(36))
        document = {
            "asset": {"version": "2.0"},
            "buffers": [{"uri": "b.bin", "byteLength": 36}],
            "bufferViews": [{"buffer": 0, "byteLength": 36}],
            "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "nodes": [{"mesh": 0}],
            "scenes": [{"nodes": [0]}],
        }
        with pytest.raises(CityModelError, match="glTF"):
            read_city_model(write(tmp_path / "a.gltf", json.dumps(document)))


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda g: g["accessors"][0].update(count=-1), r"accessors\[0\] of its glTF has the count -1"),
        (lambda g: g["accessors"][0].update(count=0), "the count 0"),
        (lambda g: g["accessors"][2].update(count="6"), r"accessors\[2\] of its glTF has the count 6"),
        (lambda g: g["accessors"][0].update(byteOffset=-4), "the byteOffset -4"),
        (lambda g: g["bufferViews"][1].update(byteLength=-1), r"bufferViews\[1\] .* the byteLength -1"),
        (lambda g: g["accessors"][0].update(sparse={"count": 1}), "stores triangles sparsely"),
        (lambda g: g["accessors"][2].update(sparse={"count": 10**9}), r"sparsely \(accessors\[2\]"),
        (lambda g: g.update(extensionsRequired=["KHR_draco_mesh_compression"]), "KHR_draco_mesh_compression"),
        (lambda g: g.update(extensionsRequired=["KHR_materials_unlit", "X_new"]), "extension 'X_new'"),
        (lambda g: g.update(extensionsRequired="EXT_meshopt_compression"), "EXT_meshopt_compression"),
        (lambda g: g["accessors"][0].update(count=2), "corner 3 of 2"),
    ],
)
def test_what_gltf_asks_for_and_is_not_read_is_refused(tmp_path: Path, change, match: str) -> None:
    """A negative count was a traceback; the others were passed over, and other triangles read."""
    with pytest.raises(CityModelError, match=match):
        read_city_model(write_gltf(tmp_path, change=change))


@pytest.mark.parametrize("name", ["KHR_materials_unlit", "KHR_texture_transform", "EXT_mesh_features"])
def test_extensions_that_leave_the_triangles_alone_are_read(tmp_path: Path, name: str) -> None:
    path = write_gltf(tmp_path, change=lambda content: content.update(extensionsRequired=[name]))
    assert len(read_city_model(path).polygons) == 2


def test_what_is_asked_for_in_a_binary_file_is_told_too(tmp_path: Path) -> None:
    write_picture(tmp_path / "roof.png")
    draco = ["KHR_draco_mesh_compression"]
    path = write_glb(tmp_path, lambda content: content.update(extensionsRequired=draco))
    with pytest.raises(CityModelError, match="KHR_draco_mesh_compression"):
        read_city_model(path)


@pytest.mark.parametrize("name", ["a.obj", "a.ply", "a.glb"])
def test_there_and_back(tmp_path: Path, name: str) -> None:
    model = read_city_model(write(tmp_path / "a.gml", box_city()))
    convert_city(model, tmp_path / name)
    again = read_city_model(tmp_path / name)
    assert again.crs == "EPSG:25832"
    assert again.findings.counts() == {}
    for corner in (np.min, np.max):
        placed = [corner(m.polygons.points, axis=0) + m.origin for m in (model, again)]
        assert placed[0] == pytest.approx(placed[1], abs=1e-3)


def test_what_others_write_is_no_frame() -> None:
    assert frame_of_comments(["origin of all things", "crs none of it"]) is None
    assert frame_of_comments(["origin 1 2 nan", "crs EPSG:25832"]) is None
    assert frame_of_extras({"lodbench": {"origin": [1, 2], "crs": None}}) is None
    assert frame_of_extras({"lodbench": {"origin": [1, 2, 3], "crs": 7}}) is None
    assert frame_of_extras(None) is None


@pytest.mark.parametrize("options", ["-s 1 1 1 ", "-o 0 0 -blendu on ", "-clamp on "])
def test_options_before_a_picture_s_name_are_passed_over(tmp_path, options):
    write_picture(tmp_path / "roof.png")
    assert_is_the_roof(read_textured(write_obj(tmp_path, f"{options}roof.png")))


@pytest.mark.parametrize("options", ["-s 2 2 1 ", "-blendu on -o 0 0.5 ", "-o -0.5 0 "])
def test_options_that_move_a_picture_are_refused(tmp_path, options):
    write_picture(tmp_path / "roof.png")
    with pytest.raises(DatasetError, match=r"map\.mtl: .* moves its picture"):
        read_textured(write_obj(tmp_path, f"{options}roof.png"))


def test_a_material_that_nothing_defines_is_refused(tmp_path):
    write_picture(tmp_path / "roof.png")
    path = write_obj(tmp_path)
    path.write_text(path.read_text().replace("usemtl roof", "usemtl wall"))
    with pytest.raises(DatasetError, match="uses materials that nothing defines: wall"):
        read_textured(path)


@pytest.mark.parametrize(("uri", "words"), [("gone.png", "not there: gone.png"), ("../a.png", "leads out")])
def test_glb_that_names_a_picture_which_cannot_be_had_is_refused(tmp_path, uri, words):
    write_picture(tmp_path / "a.png")
    write_picture(tmp_path / "map" / "roof.png")
    path = write_glb(tmp_path / "map", lambda content: content.update(images=[{"uri": uri}]))
    with pytest.raises(DatasetError, match=words):
        read_textured(path)


@pytest.mark.parametrize(
    ("texture", "words"),
    [
        ({"texCoord": 1}, "second texture coordinates"),
        ({"extensions": {"KHR_texture_transform": {"scale": [2, 2]}}}, "moves its picture"),
    ],
)
@pytest.mark.parametrize("write", [write_gltf, write_glb], ids=["gltf", "glb"])
def test_pictures_that_lie_by_other_coordinates_are_refused(tmp_path, write, texture, words):
    write_picture(tmp_path / "roof.png")

    def change(content):
        content["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"].update(texture)

    with pytest.raises(DatasetError, match=words):
        read_textured(write(tmp_path, change=change))


def test_pictures_of_another_kind_are_refused(tmp_path):
    write_picture(tmp_path / "roof.png")

    def change(content):
        content["textures"] = [{"extensions": {"KHR_texture_basisu": {"source": 0}}}]

    with pytest.raises(DatasetError, match="has no PNG, JPEG or WebP"):
        read_textured(write_gltf(tmp_path, change=change))


def test_a_transform_that_moves_nothing_is_none(tmp_path):
    write_picture(tmp_path / "roof.png")
    same = {"KHR_texture_transform": {"offset": [0.0, 0.0], "scale": [1.0, 1.0]}}

    def change(content):
        content["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["extensions"] = same

    assert_is_the_roof(read_textured(write_gltf(tmp_path, change=change)))


def test_a_material_s_colour_multiplies_the_light_of_its_picture(tmp_path):
    write_picture(tmp_path / "roof.png")

    def change(content):
        content["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [1.0, 0.5, 0.0, 1.0]

    (picture,) = read_textured(write_gltf(tmp_path, change=change)).pictures[:1]
    # Half of the light of white is 188 in sRGB.
    assert picture[0].tolist() == [[255, 0, 0], [0, 188, 0], [0, 0, 0], [255, 188, 0]]


def test_grey_of_16_bits_keeps_its_shade(tmp_path):
    assert cv2.imwrite(str(tmp_path / "roof.png"), np.full((2, 4), 30000, dtype=np.uint16))
    (picture,) = read_textured(write_obj(tmp_path)).pictures[:1]
    assert np.unique(picture).tolist() == [117]
    assert cv2.imwrite(str(tmp_path / "roof.tif"), np.full((2, 4), 0.5, dtype=np.float32))
    with pytest.raises(DatasetError, match="pixels of 32 bits"):
        read_textured(write_obj(tmp_path, "roof.tif"))


@pytest.mark.parametrize("ending", [".glb", ".obj"])
def test_there_and_back_of_textured_writer(ending: str, tmp_path: Path) -> None:
    source = write_gml(tmp_path)
    target = tmp_path / f"out/map{ending}"
    target.parent.mkdir()
    assert main(["city", "convert", str(source), str(target), "--textures"]) == 0
    first, again = read_textured(source), read_textured(target)
    assert len(again.corners) == len(first.corners)
    offset = first.corners.reshape(-1, 3).min(axis=0) - again.corners.reshape(-1, 3).min(axis=0)
    assert offset[:2].tolist() == np.floor(offset[:2]).tolist()  # the origin, in whole metres
    rows = [np.round(mesh.corners.reshape(len(mesh.corners), -1), 3) for mesh in (first, again)]
    order = [np.lexsort(row.T) for row in rows]
    np.testing.assert_allclose(again.corners[order[1]] + offset, first.corners[order[0]], atol=1e-3)
    np.testing.assert_allclose(again.uv[order[1]], first.uv[order[0]], atol=1e-5)
    np.testing.assert_array_equal(again.pictures[0], first.pictures[0])
    name = target.read_bytes()
    assert b"EPSG:25832" in name


def test_materials_that_are_left_out_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    roof = {"type": "MultiSurface", "lod": "2", "boundaries": [[[0, 1, 2]]]}
    town = {"type": "CityJSON", "version": "1.0", "vertices": [[0.5, 0, 0], [4.5, 0, 0], [0.5, 4, 0]]}
    town |= {"CityObjects": {"a": {"type": "Building", "geometry": [roof]}}}
    town |= {"appearance": {"materials": [{"name": "red"}]}}
    (tmp_path / "a.city.json").write_text(json.dumps(town))
    assert main(["city", "convert", str(tmp_path / "a.city.json"), str(tmp_path / "a.gml"), "--json"]) == 0
    assert "or materials" in json.loads(capsys.readouterr().out)["left_out"][0]


def test_pictures_that_are_left_out_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = write_gml(tmp_path)
    assert main(["city", "convert", str(source), str(tmp_path / "a.city.json"), "--json"]) == 0
    assert "pictures of surfaces" in json.loads(capsys.readouterr().out)["left_out"][0]
    assert main(["city", "convert", str(source), str(tmp_path / "a.ply"), "--textures"]) == 2
    assert "no room for pictures" in capsys.readouterr().err


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
