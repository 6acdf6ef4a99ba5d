"""Meshes as cities: what they need, damage, files that they name."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lodbench.citymodel import ReadOptions, read_city_model
from lodbench.errors import CityModelError

from .gml_text import write
from .textured_case import write_glb, write_gltf, write_picture


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
