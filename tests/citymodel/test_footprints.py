import json
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import Transformer

from lodbench.citymodel import ReadOptions, mesh_model, open_scene, read_city_model
from lodbench.citymodel.model import CityModel
from lodbench.citymodel.surface.ground import ground_under
from lodbench.errors import CityModelError

from .gml_text import codes, write

LON, LAT, STEP = 116.40, 39.90, 0.0001


def square(i: int = 0, size: float = STEP) -> list[list[float]]:
    x, y = LON + 3 * i * STEP, LAT
    return [[x, y], [x + size, y], [x + size, y + size], [x, y + size], [x, y]]


def geojson(features: list[tuple[Any, dict[str, Any]]], **more: Any) -> str:
    rows = []
    for geometry, properties in features:
        if isinstance(geometry, list):
            geometry = {"type": "Polygon", "coordinates": geometry}
        rows.append({"type": "Feature", "geometry": geometry, "properties": properties})
    return json.dumps({"type": "FeatureCollection", "features": rows, **more})


class TestReading:
    @pytest.fixture(autouse=True)
    def _needs_pyogrio(self) -> None:
        pytest.importorskip("pyogrio")

    def read(self, tmp_path: Path, text: str, **options: Any) -> CityModel:
        return read_city_model(write(tmp_path / "f.geojson", text), options=ReadOptions(**options))

    def test_block(self, tmp_path: Path) -> None:
        model = self.read(tmp_path, geojson([([square()], {"Height": 12.5, "ground": 40.0})]))
        assert (model.format, model.crs, model.lods) == ("footprints", "EPSG:32650", ("1",))
        mesh = mesh_model(model, "1")
        low, high = mesh.scene.extent_m
        assert (low[2], high[2]) == (40.0, 52.5)
        assert high[0] - low[0] == pytest.approx(8.54, abs=0.2)
        assert mesh.scene.triangles.shape == (12, 3)

    def test_faces_look_outward_whatever_the_source_winds(self, tmp_path: Path) -> None:
        hole = [[x, y] for x, y in square(size=STEP / 2)]
        hole = [[x + STEP / 4, y + STEP / 4] for x, y in hole]
        for outline in (square(), square()[::-1]):
            for inner in (hole, hole[::-1]):
                scene = open_scene(write(tmp_path / "f.geojson", geojson([([outline, inner], {"h": 5})])))
                corners = scene.vertices.astype(np.float64)[scene.triangles]
                volume = (
                    np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
                )
                plan = (
                    abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]).sum()
                    / 4
                )
                assert volume == pytest.approx(plan * 5, rel=1e-3)

    def test_multipolygon_is_one_building(self, tmp_path: Path) -> None:
        shape = {"type": "MultiPolygon", "coordinates": [[square()], [square(1)]]}
        model = self.read(tmp_path, geojson([(shape, {"height": 3, "osm_id": "w17"})]))
        assert model.building_ids == ("w17",)
        assert len(model.polygons) == 12

    @pytest.mark.parametrize(
        ("properties", "height"),
        [
            ({"HGT": 7.0}, 7.0),
            ({"Floor": 4}, 12.0),
            ({"height": None, "floors": 2}, 6.0),
            ({"height": "7,5 m"}, 7.5),
            ({"height_mea": 9.0, "elevation": 50.0}, 9.0),
            ({"elevation": 50.0}, 50.0),
            ({"levels": 3, "elevation": 515.0}, 9.0),
            ({"b3_h_dak_70p": 10.0, "b3_h_maaiveld": -1.0}, 11.0),
        ],
    )
    def test_heights_are_found(self, tmp_path: Path, properties: dict[str, Any], height: float) -> None:
        model = self.read(tmp_path, geojson([([square()], properties)]))
        assert np.ptp(model.polygons.points[:, 2]) == pytest.approx(height)

    def test_named_columns(self, tmp_path: Path) -> None:
        text = geojson([([square()], {"a": 5, "b": 2, "z": 100, "height": 1})])
        model = self.read(tmp_path, text, height_column="a", ground_column="z")
        assert sorted(set(model.polygons.points[:, 2])) == [100, 105]
        model = self.read(tmp_path, text, storeys_column="b", storey_height_m=3.5)
        assert np.ptp(model.polygons.points[:, 2]) == 7

    def test_heights_that_outlines_have_are_told_where_no_ground_is_known(self, tmp_path):
        lifted = [[*point, 510.0] for point in square()]
        model = self.read(tmp_path, geojson([([lifted], {"height": 5})]))
        (found,) = [item for item in model.findings.items if item.code.name == "GROUND_DEFAULTED"]
        assert found.detail == "ground_m=0; the outlines lie at 510 to 510, which is not used"

    def test_missing_heights(self, tmp_path: Path) -> None:
        rows = [([square(i)], {"height": h}) for i, h in enumerate([5.0, None, 0.0, -2.0])]
        model = self.read(tmp_path, geojson(rows))
        assert len(model.building_ids) == 1
        assert codes(model)["LB405"] == 3
        model = self.read(tmp_path, geojson(rows), default_height_m=8.0)
        assert len(model.building_ids) == 4
        assert codes(model)["LB406"] == 3

    def test_numbers_where_nobody_measured(self, tmp_path: Path) -> None:
        measured, no_roof, no_ground = ((50.0, 40.0), (-9999.0, 40.0), (47.0, -9999.0))
        pairs = [measured, no_roof, no_ground, (3.4e38, 40.0), (40.0, -3.4028234663852886e38)]
        rows = [([square(i)], {"roof": top, "ground": low}) for i, (top, low) in enumerate(pairs)]
        model = self.read(tmp_path, geojson(rows))
        assert sorted(set(model.polygons.points[:, 2])) == [40.0, 50.0]
        assert codes(model)["LB405"] == 4
        rows = [([square(i)], {"height": 5.0, "ground": low}) for i, (_, low) in enumerate(pairs)]
        model = self.read(tmp_path, geojson(rows), ground_m=38.0)
        assert sorted(set(model.polygons.points[:, 2])) == [38.0, 40.0, 43.0, 45.0]
        assert codes(model)["LB410"] == 2
        with pytest.raises(CityModelError, match="no footprint with a height"):
            self.read(tmp_path, geojson([([square()], {"elevation": 2600.0})]))

    def test_odd_geometries(self, tmp_path: Path) -> None:
        x, y = LON, LAT
        rows: list[tuple[Any, dict[str, Any]]] = [
            ([square()], {"height": 5}),
            (None, {"height": 5}),
            ({"type": "Point", "coordinates": [x, y]}, {"height": 5}),
            ([[[x, y], [x, y], [x + STEP, y], [x, y]]], {"height": 5}),
        ]
        model = self.read(tmp_path, geojson(rows))
        assert len(model.building_ids) == 1
        assert codes(model).items() >= {"LB101": 1, "LB206": 1, "LB207": 2}.items()

    def test_terrain(self, tmp_path: Path) -> None:
        corner = f"xllcorner {LON - 1}\nyllcorner {LAT - 1}\n"
        grid = f"ncols 2\nnrows 1\n{corner}cellsize 2\nnodata_value -9\n31.5 -9\n"
        terrain = write(tmp_path / "dtm.asc", grid)
        model = self.read(tmp_path, geojson([([square()], {"height": 5})]), terrain=str(terrain))
        assert model.polygons.points[:, 2].min() == 31.5

    @pytest.mark.parametrize(("column", "ground"), [(None, 31.5), ("base", 3.0)])
    def test_a_terrain_goes_before_a_column_that_nobody_named(self, tmp_path, column, ground):
        """``base`` may count from anywhere; the terrain that is given does not."""
        corner = f"xllcorner {LON - 1}\nyllcorner {LAT - 1}\n"
        terrain = write(tmp_path / "d.asc", f"ncols 1\nnrows 1\n{corner}cellsize 2\n31.5\n")
        rows = [([square(0)], {"height": 5, "base": 3.0}), ([square(2)], {"height": 5, "base": None})]
        model = self.read(tmp_path, geojson(rows), terrain=str(terrain), ground_column=column)
        lowest = np.unique(model.polygons.points[:, 2]).tolist()
        assert lowest == sorted({ground, ground + 5, 31.5, 36.5})

    def test_cells_that_are_no_squares(self, tmp_path: Path) -> None:
        """GDAL writes ``dx`` and ``dy`` then, and no ``cellsize``."""
        head = f"ncols 2\nnrows 2\nxllcenter {LON}\nyllcenter {LAT}\ndx {2 * STEP}\ndy {4 * STEP}\n"
        terrain = write(tmp_path / "d.asc", head + "10 20\n30 40\n")
        points = np.array([[0.0, 0.0], [0.9, 1.9], [1.1, -1.9], [0.9, 2.1], [1.1, 2.1]]) * STEP + [LON, LAT]
        heights = ground_under(points, "EPSG:4326", ReadOptions(terrain=str(terrain)))
        assert heights.tolist() == [30, 30, 40, 10, 20]

    def test_a_raster_of_which_only_a_window_is_read(self, tmp_path: Path) -> None:
        rasterio = pytest.importorskip("rasterio")
        heights = np.arange(12, dtype=np.float32).reshape(3, 4) * 10
        heights[0, 0] = -9
        cell = 3 * STEP
        shape = {"driver": "GTiff", "count": 1, "width": 4, "height": 3, "dtype": "float32", "nodata": -9}
        grid = rasterio.Affine(cell, 0, LON - STEP, 0, -cell, LAT + 2 * cell)
        with rasterio.open(tmp_path / "dtm.tif", "w", crs="EPSG:4326", transform=grid, **shape) as raster:
            raster.write(heights, 1)
        text = geojson([([square(i)], {"height": 5}) for i in (1, 2, 9)])
        model = self.read(tmp_path, text, terrain=str(tmp_path / "dtm.tif"), ground_m=3.0)
        owner = np.repeat(model.polygons.building, np.diff(model.polygons.ring_starts))
        lowest = [model.polygons.points[owner == b, 2].min() for b in range(3)]
        assert lowest == [heights[1, 1], heights[1, 2], 3.0]
        assert model.findings.counts()["LB410 GROUND_DEFAULTED"] == 1
        turned = rasterio.Affine(cell, cell, LON, cell, -cell, LAT)
        with rasterio.open(tmp_path / "t.tif", "w", crs="EPSG:4326", transform=turned, **shape) as raster:
            raster.write(heights, 1)
        with pytest.raises(CityModelError, match="turned"):
            self.read(tmp_path, text, terrain=str(tmp_path / "t.tif"))
        with pytest.warns(rasterio.errors.NotGeoreferencedWarning):
            with rasterio.open(tmp_path / "nowhere.tif", "w", **shape) as raster:
                raster.write(heights, 1)
        with pytest.raises(CityModelError, match="does not say where it lies"):
            self.read(tmp_path, text, terrain=str(tmp_path / "nowhere.tif"))
        with pytest.raises(CityModelError, match="as a raster"):
            self.read(tmp_path, text, terrain=str(write(tmp_path / "no.tif", "II*")))

    @pytest.mark.parametrize(
        ("raster_crs", "unit", "stored"),
        [
            ("EPSG:2263", None, 328.083),
            ("EPSG:2263", "metre", 100.0),
            ("EPSG:26918", None, 100.0),
            ("EPSG:4326", None, 100.0),
            ("EPSG:26918", "US survey foot", 328.083),
        ],
    )
    @pytest.mark.parametrize("crs", ["EPSG:2263", "EPSG:26918"])
    def test_a_terrain_counts_in_its_own_unit(self, tmp_path, crs, raster_crs, unit, stored):
        rasterio = pytest.importorskip("rasterio")
        east, north = Transformer.from_crs(4326, crs, always_xy=True).transform(-73.98, 40.75)
        ring = [[east + dx, north + dy] for dx, dy in ((0, 0), (30, 0), (30, 30), (0, 30), (0, 0))]
        x, y = Transformer.from_crs(4326, raster_crs, always_xy=True).transform(-73.98, 40.75)
        cell = 0.01 if raster_crs == "EPSG:4326" else 1000.0
        shape = {"driver": "GTiff", "count": 1, "width": 2, "height": 2, "dtype": "float32"}
        grid = rasterio.Affine(cell, 0, x - cell, 0, -cell, y + cell)
        with rasterio.open(tmp_path / "dtm.tif", "w", crs=raster_crs, transform=grid, **shape) as raster:
            raster.write(np.full((2, 2), stored, np.float32), 1)
            if unit is not None:
                raster.set_band_unit(1, unit)
        text, terrain = geojson([([ring], {"height": 20})]), str(tmp_path / "dtm.tif")
        model = self.read(tmp_path, text, crs=crs, terrain=terrain)
        assert model.polygons.points[:, 2].min() == pytest.approx(100.0, abs=1e-3)

    def test_cells_where_nobody_measured_are_no_ground(self, tmp_path: Path) -> None:
        corner = f"xllcorner {LON - 1}\nyllcorner {LAT - 1}\n"
        terrain = write(tmp_path / "d.asc", f"ncols 1\nnrows 1\n{corner}cellsize 2\nnodata_value 0\n-9999\n")
        model = self.read(tmp_path, geojson([([square()], {"height": 5})]), terrain=str(terrain), ground_m=7)
        assert model.polygons.points[:, 2].min() == 7.0
        assert codes(model)["LB410"] == 1

    def test_override_and_projected_coordinates(self, tmp_path: Path) -> None:
        ring = [[500000, 4400000], [500010, 4400000], [500010, 4400010], [500000, 4400000]]
        text = geojson([([ring], {"height": 5})])
        model = self.read(tmp_path, text, crs="EPSG:32650")
        assert model.origin.tolist() == [500000, 4400000, 0]

    def test_upright_polygons_are_surfaces(self, tmp_path: Path) -> None:
        x, y = 500000.0, 4400000.0
        wall = [[x, y, 1], [x + 9, y, 1], [x + 9, y, 6], [x, y, 6], [x, y, 1]]
        roof = [[x, y, 6], [x + 9, y, 6], [x + 9, y + 9, 6], [x, y, 6]]
        shape = {"type": "MultiPolygon", "coordinates": [[wall], [roof]]}
        model = self.read(tmp_path, geojson([(shape, {"id": "a"})]), crs="EPSG:32650")
        assert (model.format, model.lods, model.building_ids) == ("surfaces", ("2",), ("a",))
        assert mesh_model(model).meshed_m2 == pytest.approx(45 + 40.5)
        assert model.findings.counts() == {}

    def test_footprints_draped_over_the_ground_are_footprints(self, tmp_path: Path) -> None:
        x, y = 500000.0, 4400000.0
        ring = [[x, y, 100], [x + 9, y, 100.5], [x + 9, y + 9, 101], [x, y + 9, 100.2], [x, y, 100]]
        model = self.read(tmp_path, geojson([([ring], {"height": 5, "ground": 100})]), crs="EPSG:32650")
        assert (model.format, model.lods) == ("footprints", ("1",))
        assert mesh_model(model).meshed_m2 == pytest.approx(2 * 81 + 4 * 45)
        no_heights = self.read(tmp_path, geojson([([ring], {"id": "a"})]), crs="EPSG:32650")
        assert (no_heights.format, no_heights.lods) == ("surfaces", ("2",))
        degrees = [[*corner, 50.0 + k % 4] for k, corner in enumerate(square())]
        assert self.read(tmp_path, geojson([([degrees], {"height": 5})])).format == "footprints"

    def test_polygons_beside_points_and_lines(self, tmp_path: Path) -> None:
        others = [
            {"type": "Point", "coordinates": [LON, LAT]},
            {"type": "LineString", "coordinates": square()[:3]},
            {"type": "MultiPoint", "coordinates": square()[:2]},
        ]
        parts = [*others, {"type": "Polygon", "coordinates": [square()]}]
        shape = {"type": "GeometryCollection", "geometries": parts}
        model = self.read(tmp_path, geojson([(shape, {"height": 5})]))
        assert len(model.polygons) == 6
        assert codes(model)["LB206"] == 2

    def test_settings_are_metres_where_the_plane_is_in_feet(self, tmp_path: Path) -> None:
        foot, x, y = 1200 / 3937, 983000.0, 199000.0
        ring = [[x, y], [x + 30, y], [x + 30, y + 30], [x, y + 30], [x, y]]
        rows = [{"height": 50, "floors": 1}, {"height": None, "floors": 4}, {"height": None, "floors": None}]
        text = geojson([([ring], row) for row in rows])
        model = self.read(tmp_path, text, crs="EPSG:2263", default_height_m=20.0, ground_m=100.0)
        z = model.polygons.points[:, 2]
        owner = np.repeat(model.polygons.building, np.diff(model.polygons.ring_starts))
        assert z.min() == pytest.approx(100.0)
        tops = [z[owner == n].max() - 100.0 for n in range(3)]
        assert tops == pytest.approx([50 * foot, 4 * 3.0, 20.0])

    def test_faults(self, tmp_path: Path) -> None:
        with pytest.raises(CityModelError, match="has no column of heights"):
            self.read(tmp_path, geojson([([square()], {"name": "x"})]))
        with pytest.raises(CityModelError, match="no column 'hight'") as caught:
            self.read(tmp_path, geojson([([square()], {"height": 3})]), height_column="hight")
        assert "height" in caught.value.hint
        with pytest.raises(CityModelError, match="no footprint with a height; of footprint-1, height is 0"):
            self.read(tmp_path, geojson([([square()], {"height": 0})]))
        text = geojson([([square()], {"id": "a", "height": "33 ft", "floors": None})])
        with pytest.raises(CityModelError, match="of a, height is '33 ft', floors is empty") as caught:
            self.read(tmp_path, text)
        assert "height_column=" in caught.value.hint
        with pytest.raises(CityModelError, match="is no GeoJSON file"):
            self.read(tmp_path, "not json at all")
        with pytest.raises(CityModelError, match="cannot be read as a vector file"):
            self.read(tmp_path, '{"type": "not GeoJSON"}')
        with pytest.raises(CityModelError, match="no terrain model"):
            self.read(tmp_path, geojson([([square()], {"height": 3})]), terrain="nowhere.asc")

    def test_shapefile_needs_its_prj(self, tmp_path: Path, shared_data: Path) -> None:
        folder = shared_data / "city/footprints_height/delft_dev_shp"
        for file in folder.iterdir():
            if file.suffix != ".prj":
                write(tmp_path / file.name, file.read_bytes())
        with pytest.raises(CityModelError, match=r"\.prj"):
            read_city_model(tmp_path / "buildings.shp")
        assert len(read_city_model(tmp_path / "buildings.shp", crs="EPSG:4326").building_ids) == 443

    @pytest.mark.parametrize("name", ["delft_dev.gpkg", "delft_dev_shp/buildings.shp"])
    def test_real_footprints_against_the_block_model(self, shared_data: Path, name: str) -> None:
        scene = open_scene(shared_data / "city/footprints_height" / name, lod="1")
        assert scene.num_buildings == 443
        low, high = scene.extent_m
        assert (high - low)[:2] == pytest.approx([314.8, 323.9], abs=8)

    def test_zipped_shapefile(self, tmp_path: Path, shared_data: Path) -> None:
        folder = shared_data / "city/footprints_height/delft_dev_shp"
        with zipfile.ZipFile(tmp_path / "city.zip", "w") as archive:
            for file in folder.iterdir():
                archive.write(file, f"inner/{file.name}")
        assert len(read_city_model(tmp_path / "city.zip").building_ids) == 443

    def test_geoparquet(self, tmp_path: Path) -> None:
        pa = pytest.importorskip("pyarrow")
        parquet = pytest.importorskip("pyarrow.parquet")
        ring = np.array(square())
        wkb = struct.pack("<BIII", 1, 3, 1, len(ring)) + ring.astype("<f8").tobytes()
        table = pa.table({"geometry": [wkb], "height": [6.0]})
        geo = {"version": "1.0.0", "primary_column": "geometry", "columns": {"geometry": {"encoding": "WKB"}}}
        path = tmp_path / "f.parquet"
        parquet.write_table(table.replace_schema_metadata({"geo": json.dumps(geo)}), path)
        model = read_city_model(path)
        assert model.crs == "EPSG:32650"
        assert np.ptp(model.polygons.points[:, 2]) == 6
        parquet.write_table(table, path)
        with pytest.raises(CityModelError, match="not GeoParquet"):
            read_city_model(path)
