"""Meshes as cities: what they need, damage, files that they name."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lodbench.citymodel import ReadOptions, read_city_model
from lodbench.errors import CityModelError

from .gml_text import write


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
