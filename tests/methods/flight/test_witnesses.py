"""Findings about the map: photos from different sides, and edges that contradict them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.citymodel import open_scene
from lodbench.datasets.query import Query
from lodbench.geometry.pose import vector_from_pose
from lodbench.methods.flight.building_heights import BuildingHeight
from lodbench.methods.flight.findings import _sigmas_of_doubt
from lodbench.methods.flight.witnesses import apart_deg, without_contradicted
from lodbench.synthesis.camera_paths import FLIGHT_PATHS
from lodbench.synthesis.flights import MapErrors, change_map
from tests.town import CAMERA, box_obj

# Wide enough to show edges of a single roof.
WIDE = CAMERA.scaled(3 * CAMERA.width, 3 * CAMERA.height)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    path = tmp_path_factory.mktemp("world") / "city.obj"
    path.write_text(box_obj())
    return open_scene(path)


def photos(world, folder, count=6):
    """Returns an orbit's photos, whose surfaces are as bright as they look up, and their places, (P, 6)."""
    middle = np.array([*world.vertices[:, :2].mean(axis=0), 0.0])
    poses = list(FLIGHT_PATHS["orbit"](middle, np.random.default_rng(4), count))[:count]
    city_map, queries = CityMap(world, threads=1), []
    for k, pose in enumerate(poses):
        (normals,) = city_map.normals(WIDE, pose.rotation[None], pose.center[None])
        shade = np.where((normals != 0).any(axis=-1), 110 + 90 * normals[..., 2] + 20 * normals[..., 0], 60)
        path = folder / f"p{k}.png"
        cv2.imwrite(str(path), np.clip(shade, 0, 255).astype(np.uint8))
        queries.append(Query(f"p{k}", "all", WIDE, pose, None, path))
    return queries, np.array([vector_from_pose(pose) for pose in poses])


def said(heights=(), gone=()):
    buildings = [
        {"id": name, "higher_m": m, "sigma_m": 0.3, "photos": 6, "doubt": True} for name, m in heights
    ]
    return {"buildings": buildings, "changes": [{"kind": "demolished", "id": name} for name in gone]}


def test_directions_are_compared_at_the_place():
    cameras = np.array([[0.0, 0.0, 100.0], [100.0, 0.0, 100.0], [5.0, 0.0, 100.0]])
    assert apart_deg(np.zeros(3), cameras) == pytest.approx(45.0)
    assert apart_deg(np.zeros(3), cameras[[0, 2]]) == pytest.approx(np.degrees(np.arctan(0.05)))
    assert apart_deg(np.zeros(3), cameras[:1]) == 0.0
    # The same cameras look at something far away from one side.
    assert apart_deg(np.array([0.0, 0.0, -1000.0]), cameras) < 6.0


def test_what_stands_by_the_photos_edges_is_neither_gone_nor_of_another_height(world, tmp_path):
    queries, vectors = photos(world, tmp_path)
    here = CityMap(world, threads=1)
    names = world.building_ids[:4]
    findings = said([(name, 3.0) for name in names[:2]], names[2:])
    kept = without_contradicted(findings, queries, vectors, np.zeros(4), here)
    assert [b["doubt"] for b in kept["buildings"]] == [False, False]
    assert kept["changes"] == []
    # From one side masks may err alike, and so may edges: no height is contradicted. But what lies on
    # edges is not shown to be gone.
    alike = [queries[0], replace(queries[0], name="again")]
    same = without_contradicted(findings, alike, vectors[[0, 0]], np.zeros(4), here)
    assert same == {**findings, "changes": []}
    # Without photos there are no edges.
    blind = [replace(query, image=None) for query in queries]
    assert without_contradicted(findings, blind, vectors, np.zeros(4), here) == findings


def test_what_the_map_has_wrong_stays_wrong(world, tmp_path):
    queries, vectors = photos(world, tmp_path)
    wrong, changed = change_map(world, MapErrors(heights=0.3, extra=0.2), np.random.default_rng(5))
    findings = said([(name, -m) for name, m in changed["heights"].items()], changed["extra"])
    assert findings["buildings"]
    assert findings["changes"]
    kept = without_contradicted(findings, queries, vectors, np.zeros(4), CityMap(wrong, threads=1))
    assert kept == findings


def test_heights_are_doubted_beyond_what_all_of_a_flight_are_off_by():
    def flight(*off_m):
        return [BuildingHeight(m, 0.5, 4, False) for m in off_m]

    assert _sigmas_of_doubt([]) == pytest.approx(3.0)
    assert _sigmas_of_doubt(flight(0.1, -0.2, 0.1, 4.0)) == pytest.approx(3.0)
    # Masks that are off by three times what is known of them.
    assert _sigmas_of_doubt(flight(1.0, -1.5, 1.0, -1.0)) == pytest.approx(3.0 * 1.4826 * 2.0)
