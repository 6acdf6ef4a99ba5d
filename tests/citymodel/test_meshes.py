"""Meshes as cities: needs, damage, files they name, pictures; the same city when written and read again."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from lodbench.citymodel import ReadOptions, read_city_model
from lodbench.citymodel.convert import convert_city
from lodbench.citymodel.mesh.reader import frame_of_comments, frame_of_extras
from lodbench.citymodel.mesh.texture_files import read_textured
from lodbench.cli import main
from lodbench.errors import CityModelError, DatasetError

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
