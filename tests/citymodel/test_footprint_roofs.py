"""Parts of OpenStreetMap's buildings in place of their outlines, and roofs of stated shapes as level 2."""

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from lodbench.citymodel import ReadOptions, read_city_model
from lodbench.citymodel.checks import check_city
from lodbench.citymodel.meshing import mesh_model
from lodbench.citymodel.model import CityModel
from lodbench.citymodel.scene import Scene

from .surface_case import NORTH, WEST, osm_pbf, osm_text, write_footprints

pytest.importorskip("pyogrio")
shapely = pytest.importorskip("shapely")
DETAILS = ReadOptions(has_details=True)
LON, LAT = 7.0, 51.0


def volume_m3(scene: Scene, building: int) -> float:
    """Returns what the triangles of a building enclose, by the divergence theorem."""
    faces = scene.triangles[scene.triangle_starts[building] : scene.triangle_starts[building + 1]]
    a, b, c = scene.vertices[faces].astype(np.float64).swapaxes(0, 1)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def top_m(scene: Scene, building: int) -> float:
    vertices = scene.vertices[scene.vertex_starts[building] : scene.vertex_starts[building + 1]]
    return float(vertices[:, 2].max() + scene.origin[2])


class TestShapes:
    # Length 24, width 10, eaves at 6, ridge at 9, floor at 0.
    ROOFS: ClassVar[dict[str, float]] = {
        "flat": 24 * 10 * 9.0,
        "gabled": 24 * 10 * 6.0 + 24 * 10 * 3 / 2,
        "hipped": 24 * 10 * 6.0 + 3 * 10 * (3 * 24 - 10) / 6,
        "pyramidal": 24 * 10 * 6.0 + 24 * 10 * 3 / 3,
    }

    def read(self, path: Path, shapes: list[Any], **columns: Any) -> CityModel:
        given = {"id": [f"h{n}" for n in range(len(shapes))], "height": [9.0] * len(shapes)}
        return read_city_model(write_footprints(path, shapes, **given, **columns), options=DETAILS)

    def turned(self, degrees: float) -> Any:
        house = shapely.box(WEST, NORTH, WEST + 24, NORTH + 10)
        from shapely import affinity

        return affinity.rotate(house, degrees)

    @pytest.mark.parametrize("degrees", [0, 33, 90])
    def test_volumes_are_those_of_solid_geometry(self, tmp_path: Path, degrees: float) -> None:
        columns = {"roof_shape": list(self.ROOFS), "roof_height": [3.0] * 4}
        model = self.read(tmp_path / "f.gpkg", [self.turned(degrees)] * 4, **columns)
        scene = mesh_model(model, "2").scene
        volumes = [volume_m3(scene, n) for n in range(4)]
        assert volumes == pytest.approx(list(self.ROOFS.values()), rel=1e-4)
        assert [top_m(scene, n) for n in range(4)] == pytest.approx([9.0] * 4, abs=1e-3)
        codes = {row.code.name for row in check_city(model).rows}
        assert not {"SHELL_NOT_CLOSED", "NOT_PLANAR", "NON_MANIFOLD_EDGE"} & codes
        # Blocks stay as they are.
        assert volume_m3(mesh_model(model, "1").scene, 1) == pytest.approx(24 * 10 * 9.0, rel=1e-4)

    def test_a_ridge_across(self, tmp_path: Path) -> None:
        columns = {
            "roof_shape": ["gabled"] * 2, "roof_height": [3.0] * 2, "roof_orientation": ["along", "across"],
        }  # fmt: skip
        model = self.read(tmp_path / "f.gpkg", [self.turned(0)] * 2, **columns)
        scene = mesh_model(model, "2").scene
        tops = [scene.vertices[scene.vertex_starts[n] : scene.vertex_starts[n + 1]] for n in range(2)]
        ridges = [each[each[:, 2] > each[:, 2].max() - 0.01] for each in tops]
        assert [np.ptp(ridge[:, 0]) for ridge in ridges] == pytest.approx([24, 0], abs=1e-3)
        assert volume_m3(scene, 1) == pytest.approx(self.ROOFS["gabled"], rel=1e-4)

    def test_what_has_no_stated_roof_keeps_its_block_alone(self, tmp_path: Path) -> None:
        corner = shapely.difference(self.turned(0), shapely.box(WEST + 8, NORTH + 4, WEST + 30, NORTH + 20))
        columns = {
            "roof_shape": ["gabled", "onion", "gabled", "gabled"],
            "roof_height": [3.0, 3.0, float("nan"), 12.0],
        }  # fmt: skip
        model = self.read(tmp_path / "f.gpkg", [corner, *[self.turned(0)] * 3], **columns)
        assert model.lods == ("1",)
        assert len(model.building_ids) == 4

    def test_in_degrees_and_with_a_notch(self, tmp_path: Path) -> None:
        notch = shapely.difference(self.turned(33), shapely.Point(WEST + 12, NORTH + 5).buffer(0.5))
        columns = {"roof_shape": ["hipped"], "roof_height": [3.0]}
        shapes = [notch]
        path = write_footprints(
            tmp_path / "f.geojson", shapes, "EPSG:4326", id=["h"], height=[9.0], **columns
        )
        model = read_city_model(path, options=DETAILS)
        scene = mesh_model(model, "2").scene
        # The hole is a shaft of 0.78 m2 in the middle of the ridge.
        assert volume_m3(scene, 0) == pytest.approx(self.ROOFS["hipped"] - 0.78 * 8.85, rel=5e-3)


def ring(west: float, south: float, east: float, north: float) -> list[tuple[float, float]]:
    """Returns a rectangle of metres as longitudes and latitudes."""
    x, y = 1 / (111_320 * np.cos(np.radians(LAT))), 1 / 111_250
    return [
        (round(LON + e * x, 7), round(LAT + n * y, 7))
        for e, n in ((west, south), (east, south), (east, north), (west, north))
    ]


class TestParts:
    WAYS = (
        (ring(0, 0, 20, 20), {"building": "yes", "height": "10"}),
        (ring(0, 0, 10, 20), {"building:part": "yes", "height": "15"}),
        (ring(12, 5, 18, 10), {"building:part": "yes", "height": "30", "min_height": "10"}),
        (ring(12, 12, 18, 18), {"building:part": "yes"}),
        (ring(40, 0, 60, 20), {"building": "yes", "height": "10"}),
        (ring(40, 0, 60, 10), {"building:part": "yes", "building:levels": "2"}),
        (ring(40, 10, 60, 20), {"building:part": "yes", "building:levels": "4"}),
        (ring(80, 0, 90, 10), {"building:part": "yes", "height": "7"}),
        (ring(81, 20, 90, 30), {"building:part": "no", "height": "7"}),
    )

    @pytest.mark.parametrize("name", ["town.osm", "town.osm.pbf"])
    def test_parts_replace_their_outline_where_they_cover_it(self, tmp_path: Path, name: str) -> None:
        path = tmp_path / name
        ways = list(self.WAYS)
        path.write_bytes(osm_pbf(ways) if name.endswith("pbf") else osm_text(ways).encode())
        model = read_city_model(path, options=DETAILS)
        assert model.building_ids == ("way/1", "way/2", "way/3", "way/6", "way/7", "way/8")
        scene = mesh_model(model, "1").scene
        volumes = [volume_m3(scene, n) for n in range(6)]
        left = 20 * 20 - 10 * 20 - 6 * 5
        wanted = [left * 10, 200 * 15, 30 * 20, 200 * 6, 200 * 12, 100 * 7]
        # Degrees of seven digits are a centimetre; a projection has 0.04 % here.
        assert volumes == pytest.approx(wanted, rel=0.01)
        assert [top_m(scene, n) for n in range(6)] == pytest.approx([10, 15, 30, 6, 12, 7], abs=0.01)
        assert model.objects is not None
        told = [each.get("part_of") for each in model.objects.attributes]
        assert told == [None, "way/1", "way/1", "way/5", "way/5", None]
        assert not [item for item in model.findings.items if item.code.severity.name == "ERROR"]

    def test_a_bow_tie_is_no_reason_to_lose_a_city(self, tmp_path: Path) -> None:
        bow = [(LON, LAT), (LON + 1e-4, LAT + 1e-4), (LON + 1e-4, LAT), (LON, LAT + 1e-4)]
        ways = [(bow, {"building:part": "yes", "height": "4"}), *self.WAYS[:2]]
        path = tmp_path / "town.osm"
        path.write_text(osm_text(ways))
        assert {"way/2", "way/3"} <= set(read_city_model(path).building_ids)
