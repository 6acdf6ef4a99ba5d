from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lodbench.citymodel import mesh_city, mesh_model, read_city_model
from lodbench.citymodel.model import SurfaceKind
from lodbench.citymodel.scene import Scene

from .gml_text import write
from .twins import TOWN, documents


def triangle_set(scene: Scene, *, up_to_translation: bool = False) -> list[set[tuple[int, ...]]]:
    """Per building, its triangles as sorted corners in whole millimetres of the reference system."""
    sets = []
    for b in range(scene.num_buildings):
        triangles = scene.triangles[scene.triangle_starts[b] : scene.triangle_starts[b + 1]]
        corners = scene.vertices.astype(np.float64)[triangles] + scene.origin
        if up_to_translation:
            corners -= corners.reshape(-1, 3).min(axis=0)
        rounded = np.rint(corners * 1000).astype(int)
        sets.append({tuple(np.array(sorted(t.tolist())).reshape(-1).tolist()) for t in rounded})
    return sets


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("town")
    return {name: write(folder / name, text) for name, text in documents().items()}


@pytest.mark.parametrize("name", list(documents()))
def test_every_format_gives_the_same_mesh(town: dict[str, Path], name: str) -> None:
    reference = triangle_set(mesh_city(read_city_model(town["v2.gml"])))
    model = read_city_model(town[name])
    scene = mesh_city(model, "3")
    assert model.findings.counts() == {}
    assert model.building_ids == ("house-0", "house-1", "house-2")
    assert (model.crs, model.lods, scene.lod) == ("EPSG:25832", ("3",), "3")
    assert triangle_set(scene) == reference
    kinds = [SurfaceKind(kind).name for kind in model.polygons.kind[: len(TOWN[0])]]
    assert kinds == ["GROUND", "ROOF"] + ["WALL"] * 6 + ["OPENING"]


def test_a_window_fills_the_hole_of_its_wall(town: dict[str, Path]) -> None:
    mesh = mesh_model(read_city_model(town["v3.gml"]))
    perimeter = sum(8 * (4.0 + i) * (5.0 + i) for i in range(3))
    floors = sum(2 * (3 - 0.09) * (4.0 + i) ** 2 for i in range(3))
    assert mesh.meshed_m2 == pytest.approx(perimeter + floors, abs=1e-3)


def test_real_pair_agrees_per_building_up_to_translation(shared_data: Path) -> None:
    folder = shared_data / "city" / "lod3_reference"
    first = mesh_city(read_city_model(folder / "lod2_buildings_v3.gml"))
    second = mesh_city(read_city_model(folder / "lod2_buildings_as_CityJSON_features.jsonl"))

    assert first.building_ids == second.building_ids
    assert triangle_set(first, up_to_translation=True) == triangle_set(second, up_to_translation=True)
