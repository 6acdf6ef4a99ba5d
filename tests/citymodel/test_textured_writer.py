"""Photographed surfaces written: the same triangles, pictures and places when they are read again."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lodbench.citymodel.mesh.texture_files import read_textured
from lodbench.cli import main

from .textured_case import write_gml


@pytest.mark.parametrize("ending", [".glb", ".obj"])
def test_there_and_back(ending: str, tmp_path: Path) -> None:
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
