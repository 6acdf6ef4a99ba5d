"""Parts of OpenStreetMap's buildings in place of their outlines, and roofs of stated shapes as level 2."""

import struct
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from lodbench.citymodel import ReadOptions, read_city_model
from lodbench.citymodel.checks.report import check_city
from lodbench.citymodel.extrude import clean_rings, extrude
from lodbench.citymodel.model import CityModel
from lodbench.citymodel.read import mesh_model
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.surface.ground import ground_under
from lodbench.citymodel.vector.columns import find_column
from lodbench.citymodel.vector.gdal import WkbPolygons
from lodbench.errors import CityModelError, ConfigError

from .gml_text import write
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


class TestWkb:
    ring = np.array([[0, 0, 1], [4, 0, 2], [4, 4, 3], [0, 0, 1]], np.float64)

    @pytest.mark.parametrize(
        ("order", "code", "width", "extra"),
        [("<", 3, 2, b""), (">", 3, 2, b""), ("<", 1003, 3, b""), ("<", 0x80000003, 3, b""),
         ("<", 0xA0000003, 3, struct.pack("<I", 4326))],
    )  # fmt: skip
    def test_dialects(self, order: str, code: int, width: int, extra: bytes) -> None:
        head = struct.pack(order + "BI", order == "<", code) + extra + struct.pack(order + "II", 1, 4)
        polygons = WkbPolygons()
        polygons.add(head + self.ring[:, :width].astype(order + "f8").tobytes(), 7)
        assert polygons.owner == [7]
        assert polygons.rings[0][:, :width].tolist() == self.ring[:, :width].tolist()

    @pytest.mark.parametrize("cut", [3, 8, 20, 60])
    def test_cut_off(self, cut: int) -> None:
        data = struct.pack("<BIII", 1, 3, 1, 4) + self.ring[:, :2].astype("<f8").tobytes()
        with pytest.raises(ValueError, match="cut off"):
            WkbPolygons().add(data[:cut], 0)

    def test_nesting_ends(self) -> None:
        with pytest.raises(ValueError, match="nested"):
            WkbPolygons().add(struct.pack("<BII", 1, 7, 1) * 50, 0)


class TestRings:
    def test_clean_rings(self) -> None:
        ring = np.array([[0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 0]], np.float64)
        points, starts, repeats = clean_rings([ring, ring[:0], ring[2:3]])
        assert points.tolist() == [[0, 0], [1, 0], [1, 1]]
        assert starts.tolist() == [0, 3, 3, 3]
        assert repeats.tolist() == [1, 0, 0]

    def test_extrude_counts(self) -> None:
        points = np.array([[0, 0], [1, 0], [0, 1]], np.float64)
        blocks = extrude(points, np.array([0, 3]), np.array([0, 1]), np.array([2.0]), np.array([5.0]))
        assert blocks.ring_lengths.tolist() == [3, 3, 4, 4, 4]
        assert blocks.kind.tolist() == [3, 2, 1, 1, 1]

    def test_find_column(self) -> None:
        assert find_column(["ID", "Bldg_Height"], ("height", "bldgheight")) == "Bldg_Height"
        assert find_column(["a"], ("height",)) is None

    @pytest.mark.parametrize(
        "text",
        [
            "",
            "ncols 2\nnrows x\n",
            "ncols 2\nnrows 2\n1 2 3\n",
            "ncols 0\nnrows 9\n",
            "ncols inf\nnrows 9\n",
            "ncols 1\nnrows 1\ncellsize 0\n1\n",
            "ncols 1\nnrows 1\nxllcorner 0\nyllcorner 0\n1\n",
            "ncols 1\nnrows 1\ncellsize 1e999\n1\n",
            "ncols 1\nnrows 1\nxllcorner nan\n1\n",
        ],
    )
    def test_malformed_terrain(self, tmp_path: Path, text: str) -> None:
        options = ReadOptions(terrain=str(write(tmp_path / "t.asc", text)))
        with pytest.raises(CityModelError, match="no ASCII grid"):
            ground_under(np.zeros((1, 2)), "EPSG:4326", options)

    @pytest.mark.parametrize(
        "options",
        [{"storey_height_m": 0.0}, {"base": "flying"}, {"sunk_m": -1.0}],
        ids=lambda o: next(iter(o)),
    )
    def test_options_out_of_range(self, options: dict[str, Any]) -> None:
        with pytest.raises(ConfigError):
            ReadOptions(**options)
