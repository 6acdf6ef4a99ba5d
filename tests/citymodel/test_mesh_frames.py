"""Meshes that lodbench wrote lie where the city did when they are read again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lodbench.citymodel import read_city_model
from lodbench.citymodel.convert import convert_city
from lodbench.citymodel.mesh.frames import frame_of_comments, frame_of_extras

from .gml_text import box_city, write


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
