"""Heights of footprints by a surface model, by attributes, by tags of OpenStreetMap, and what says so."""

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from lodbench.citymodel import ReadOptions, read_city_model
from lodbench.citymodel.model import CityModel
from lodbench.citymodel.surface.grid import open_surface
from lodbench.citymodel.surface.ground import estimate_ground, fill_gaps, find_ground
from lodbench.errors import CityModelError
from lodbench.findings import Findings

from .gml_text import codes
from .surface_case import (
    CELL_M,
    NORTH,
    WEST,
    ground_m,
    heights_of,
    osm_pbf,
    osm_text,
    rectangle,
    write_footprints,
    write_raster,
)

pytest.importorskip("rasterio")
pytest.importorskip("pyogrio")

HOUSES = [(10.0, 10.0, 22.0, 20.0, 6.0), (40.0, 12.0, 48.0, 30.0, 9.5), (60.0, 60.0, 90.0, 80.0, 3.2)]


def footprints(tmp_path: Path, crs: str = "EPSG:25832", **columns: Any) -> Path:
    return write_footprints(tmp_path / "f.gpkg", [rectangle(*house) for house in HOUSES], crs, **columns)


def read(path: Path, **options: Any) -> CityModel:
    return read_city_model(path, options=ReadOptions(has_details=True, **options))


def told(model: CityModel, name: str) -> list[Any]:
    assert model.objects is not None
    return [each.get(name) for each in model.objects.attributes]


def tops(model: CityModel) -> list[float]:
    """Returns the height of each building above its own floor."""
    heights = []
    for building in range(len(model.building_ids)):
        own = np.flatnonzero(model.polygons.building == building)
        points = np.concatenate(
            [
                model.polygons.points[model.polygons.ring_starts[r] : model.polygons.ring_starts[r + 1], 2]
                for p in own
                for r in range(model.polygons.polygon_starts[p], model.polygons.polygon_starts[p + 1])
            ]
        )
        heights.append(float(np.ptp(points)))
    return heights


class TestHeights:
    def test_flat_roofs_are_as_high_as_the_surface_model_says(self, tmp_path: Path) -> None:
        surface = write_raster(tmp_path / "dsm.tif", heights_of(HOUSES))
        model = read(footprints(tmp_path), surface=str(surface))
        assert tops(model) == pytest.approx([house[4] for house in HOUSES], abs=0.3)
        assert told(model, "height_from") == ["surface model"] * 3
        assert told(model, "ground_from") == ["estimated from the surface model"] * 3
        assert "LB703" in codes(model)

    def test_a_terrain_model_gives_the_ground_exactly(self, tmp_path: Path) -> None:
        surface = write_raster(tmp_path / "dsm.tif", heights_of(HOUSES))
        terrain = write_raster(tmp_path / "dtm.tif", heights_of([]))
        model = read(footprints(tmp_path), surface=str(surface), terrain=str(terrain))
        assert tops(model) == pytest.approx([house[4] for house in HOUSES], abs=0.1)
        assert told(model, "ground_from") == ["terrain model"] * 3
        assert "LB704" not in codes(model)

    def test_other_zero_heights_of_the_terrain_model_are_a_finding(self, tmp_path: Path) -> None:
        surface = write_raster(tmp_path / "dsm.tif", heights_of(HOUSES) + 47.0)
        terrain = write_raster(tmp_path / "dtm.tif", heights_of([]))
        model = read(footprints(tmp_path), surface=str(surface), terrain=str(terrain))
        (found,) = [item for item in model.findings.items if item.code.code == "LB704"]
        assert "+47.0 m" in found.detail

    def test_gable_roofs_take_the_middle_and_tell_eaves_and_ridge(self, tmp_path: Path) -> None:
        surface = write_raster(tmp_path / "dsm.tif", heights_of(HOUSES, pitch=0.5))
        terrain = write_raster(tmp_path / "dtm.tif", heights_of([]))
        model = read(footprints(tmp_path), surface=str(surface), terrain=str(terrain))
        widths = np.array([house[3] - house[1] for house in HOUSES])
        eaves = np.array([house[4] for house in HOUSES])
        np.testing.assert_allclose(tops(model), eaves + 0.125 * widths, atol=0.3)
        np.testing.assert_allclose(told(model, "ridge_height_m"), eaves + 0.225 * widths, atol=0.4)
        np.testing.assert_allclose(told(model, "eaves_height_m"), eaves + 0.025 * widths, atol=0.4)

    def test_a_chimney_and_a_hole_change_nothing(self, tmp_path: Path) -> None:
        heights = heights_of(HOUSES)
        heights[24:28, 30:34] += 8.0
        heights[30:34, 24:40] = -9999.0
        surface = write_raster(tmp_path / "dsm.tif", heights)
        terrain = write_raster(tmp_path / "dtm.tif", heights_of([]))
        model = read(footprints(tmp_path), surface=str(surface), terrain=str(terrain))
        assert tops(model)[0] == pytest.approx(6.0, abs=0.1)
        assert "LB701" in codes(model)

    @pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:25833", "EPSG:3857"])
    def test_footprints_in_another_system(self, tmp_path: Path, crs: str) -> None:
        surface = write_raster(tmp_path / "dsm.tif", heights_of(HOUSES))
        model = read(footprints(tmp_path, crs), surface=str(surface))
        assert tops(model) == pytest.approx([house[4] for house in HOUSES], abs=0.3)

    def test_attributes_count_where_nothing_rises_and_outside(self, tmp_path: Path) -> None:
        surface = write_raster(tmp_path / "dsm.tif", heights_of(HOUSES[:1]))
        shapes = [rectangle(*HOUSES[0]), rectangle(*HOUSES[1]), rectangle(300, 300, 310, 310)]
        path = write_footprints(
            tmp_path / "f.gpkg", shapes, id=["a", "b", "c"], height=[99.0, 12.0, float("nan")],
            levels=[1.0, 1.0, 4.0],
        )  # fmt: skip
        model = read(path, surface=str(surface), ground_m=50.0)
        assert told(model, "height_from") == ["surface model", "column height", "column levels"]
        assert tops(model) == pytest.approx([6.0, 12.0, 12.0], abs=0.3)
        assert told(model, "ground_from")[1:] == ["estimated from the surface model", "ground_m"]
        found = [item.object_id for item in model.findings.items if item.code.code == "LB709"]
        assert found == ["b", "c"]

    def test_a_footprint_without_any_height_is_left_out_and_told(self, tmp_path: Path) -> None:
        surface = write_raster(tmp_path / "dsm.tif", heights_of(HOUSES[:1]))
        model = read(footprints(tmp_path), surface=str(surface))
        assert model.building_ids == ("h0",)
        lost = [item.object_id for item in model.findings.items if item.code.name == "HEIGHT_MISSING"]
        assert lost == ["h1", "h2"]

    def test_heights_do_not_depend_on_where_blocks_end(self, tmp_path: Path, monkeypatch: Any) -> None:
        surface = write_raster(tmp_path / "dsm.tif", heights_of(HOUSES, pitch=0.3))
        once = tops(read(footprints(tmp_path), surface=str(surface)))
        monkeypatch.setattr("lodbench.citymodel.surface.grid.BLOCK", 32)
        monkeypatch.setattr("lodbench.citymodel.surface.ground.BLOCK", 32)
        monkeypatch.setattr("lodbench.citymodel.surface.ground.BLOCK", 32)
        assert tops(read(footprints(tmp_path), surface=str(surface))) == once


class TestUnits:
    def test_whole_numbers_with_scale_and_offset(self, tmp_path: Path) -> None:
        stored = np.rint((heights_of(HOUSES) - 100.0) / 0.01)
        surface = write_raster(
            tmp_path / "dsm.tif", stored, dtype="int16", nodata=-32768, scale=0.01, offset=100.0
        )
        model = read(footprints(tmp_path), surface=str(surface))
        assert tops(model) == pytest.approx([house[4] for house in HOUSES], abs=0.3)

    def test_feet_of_the_band(self, tmp_path: Path) -> None:
        surface = write_raster(tmp_path / "dsm.tif", heights_of(HOUSES) / 0.3048, unit="ft")
        model = read(footprints(tmp_path), surface=str(surface))
        assert tops(model) == pytest.approx([house[4] for house in HOUSES], abs=0.3)

    def test_feet_of_plane_and_heights(self, tmp_path: Path) -> None:
        from rasterio.transform import from_origin

        foot = 1200 / 3937
        step = CELL_M / foot
        surface = write_raster(
            tmp_path / "dsm.tif", heights_of(HOUSES) / foot, crs="EPSG:2263",
            transform=from_origin(985000.0, 200000.0, step, step),
        )  # fmt: skip
        import shapely

        shapes = [rectangle(*house) for house in HOUSES]
        moved = shapely.transform(
            np.array(shapes), lambda p: (p - (WEST, NORTH)) / foot + (985000.0, 200000.0)
        )
        path = tmp_path / "f.gpkg"
        import pyogrio

        pyogrio.raw.write(
            str(path), shapely.to_wkb(moved), [np.array(["a", "b", "c"], object)], fields=["id"],
            geometry_type="Polygon", crs="EPSG:2263",
        )  # fmt: skip
        model = read(path, surface=str(surface))
        assert tops(model) == pytest.approx([house[4] for house in HOUSES], abs=0.3)

    def test_steps_of_a_metre_are_a_finding(self, tmp_path: Path) -> None:
        surface = write_raster(tmp_path / "dsm.tif", np.rint(heights_of(HOUSES)))
        assert "LB706" in codes(read(footprints(tmp_path), surface=str(surface)))


class TestGround:
    def test_gaps_are_filled_between_their_rims(self) -> None:
        x, y = np.meshgrid(np.arange(60.0), np.arange(45.0))
        plane = (ground_m(x, y)).astype(np.float32)
        gappy = plane.copy()
        gappy[10:25, 12:40] = np.nan
        filled = fill_gaps(gappy)
        assert not np.isnan(filled).any()
        assert np.abs(filled - plane).max() < 0.35
        assert (filled[~np.isnan(gappy)] == plane[~np.isnan(gappy)]).all()

    def test_halls_are_no_ground_and_hills_are(self) -> None:
        x, y = np.meshgrid(np.arange(0.0, 600.0, 2.0), np.arange(0.0, 600.0, 2.0))
        ground = (30.0 * np.exp(-(((x - 300) / 150) ** 2) - ((y - 300) / 150) ** 2)).astype(np.float32)
        surface = ground.copy()
        surface[20:65, 20:70] += 8.0
        surface[140:150, 140:160] += 12.0
        found = estimate_ground(surface, 2.0)
        assert np.abs(found - ground).max() < 1.5
        assert np.abs(found - ground).mean() < 0.1

    def test_ground_between_coarse_cells_is_linear(self, tmp_path: Path) -> None:
        grid = open_surface(write_raster(tmp_path / "dsm.tif", heights_of([])))
        terrain = write_raster(tmp_path / "dtm.tif", heights_of([]))
        ground = find_ground(grid, ReadOptions(terrain=str(terrain)), Findings())
        found = ground.window((20, 180), (20, 180))
        assert np.abs(found - heights_of([])[20:180, 20:180]).max() < 0.03


RING = [(11.0, 48.0), (11.0002, 48.0), (11.0002, 48.0001), (11.0, 48.0001)]


def shifted(n: int) -> list[tuple[float, float]]:
    return [(lon + 0.001 * n, lat) for lon, lat in RING]


class TestOpenStreetMap:
    WAYS: ClassVar = [
        (shifted(0), {"building": "yes", "height": "12 m"}),
        (
            shifted(1),
            {"building": "house", "building:levels": "2", "roof:shape": "gabled", "roof:height": "2.5"},
        ),
        (shifted(2), {"building": "yes", "building:levels": "3", "roof:levels": "1"}),
        (shifted(3), {"building": "yes", "height": "32'6\"", "min_height": "3"}),
        (shifted(4), {"building": "no", "height": "40"}),
        (shifted(5), {"landuse": "forest"}),
        (shifted(6), {"building": "yes", "name": 'The "Old" House'}),
    ]

    @pytest.mark.parametrize("name", ["town.osm", "town.osm.pbf"])
    def test_tags_give_heights(self, tmp_path: Path, name: str) -> None:
        path = tmp_path / name
        path.write_bytes(osm_pbf(self.WAYS) if name.endswith("pbf") else osm_text(self.WAYS).encode())
        model = read(path)
        assert model.building_ids == ("way/1", "way/2", "way/3", "way/4")
        assert told(model, "measuredHeight") == pytest.approx([12.0, 8.5, 12.0, 9.906])
        assert tops(model) == pytest.approx([12.0, 8.5, 12.0, 6.906])
        assert told(model, "height_from")[1] == "column building:levels"
        lost = [item.object_id for item in model.findings.items if item.code.name == "HEIGHT_MISSING"]
        assert lost == ["way/7"]
        assert model.pitched is not None
        assert model.pitched.tolist() == [False, True, False, False]

    def test_a_file_of_another_kind_is_refused(self, tmp_path: Path) -> None:
        path = tmp_path / "town.osm.pbf"
        path.write_bytes(b"PK\x03\x04 no extract at all")
        with pytest.raises(CityModelError, match="no OSM file"):
            read(path)


class TestBadSurfaces:
    @pytest.mark.parametrize(
        ("changed", "match"),
        [
            ({"crs": "EPSG:4326"}, "in degrees"),
            ({"nodata": 0.0, "zero": True}, "no height in any cell"),
            ({"turned": True}, "is turned"),
            ({"coarse": True}, "show no building"),
        ],
    )
    def test_refused_in_one_line(self, tmp_path: Path, changed: dict[str, Any], match: str) -> None:
        from affine import Affine

        heights = heights_of(HOUSES)
        if changed.pop("zero", False):
            heights = heights * 0.0
        if changed.pop("turned", False):
            changed["transform"] = (
                Affine.translation(WEST, NORTH) @ Affine.rotation(10) @ Affine.scale(0.5, -0.5)
            )
        if changed.pop("coarse", False):
            changed["transform"] = Affine.translation(WEST, NORTH) @ Affine.scale(30.0, -30.0)
        surface = write_raster(tmp_path / "dsm.tif", heights, **changed)
        with pytest.raises(CityModelError, match=match) as fault:
            read(footprints(tmp_path), surface=str(surface))
        assert fault.value.hint

    def test_a_huge_declared_size(self, tmp_path: Path) -> None:
        import rasterio
        from rasterio.transform import from_origin

        path = tmp_path / "huge.tif"
        profile = {
            "driver": "GTiff", "height": 200_000, "width": 200_000, "count": 1, "dtype": "float32",
            "crs": "EPSG:25832", "transform": from_origin(WEST, NORTH, 0.5, 0.5), "sparse_ok": True,
            "tiled": True, "compress": "deflate", "BIGTIFF": "YES",
        }  # fmt: skip
        with rasterio.open(path, "w", **profile):
            pass
        with pytest.raises(CityModelError, match="200,000 x 200,000 cells"):
            read(footprints(tmp_path), surface=str(path))

    @pytest.mark.parametrize("name", ["nowhere.tif", "damaged.tif"])
    def test_missing_or_damaged(self, tmp_path: Path, name: str) -> None:
        (tmp_path / "damaged.tif").write_bytes(b"II*\0 no raster")
        with pytest.raises(CityModelError, match=name):
            read(footprints(tmp_path), surface=str(tmp_path / name))

    def test_a_terrain_model_of_another_place(self, tmp_path: Path) -> None:
        from rasterio.transform import from_origin

        surface = write_raster(tmp_path / "dsm.tif", heights_of(HOUSES))
        elsewhere = from_origin(WEST + 5000.0, NORTH, CELL_M, CELL_M)
        terrain = write_raster(tmp_path / "dtm.tif", heights_of([]), transform=elsewhere)
        with pytest.raises(CityModelError, match="no height under"):
            read(footprints(tmp_path), surface=str(surface), terrain=str(terrain))


class TestTiles:
    def halves(self, tmp_path: Path, step_m: float = 0.0, off: float = 0.0) -> Path:
        from rasterio.transform import from_origin

        folder = tmp_path / "tiles"
        folder.mkdir(parents=True)
        heights = heights_of(HOUSES)
        write_raster(folder / "west.tif", heights[:, :90])
        place = from_origin(WEST + 45.0 + off, NORTH, CELL_M, CELL_M)
        write_raster(folder / "east.tif", heights[:, 90:] + step_m, transform=place)
        return folder

    def test_a_house_on_two_tiles_is_measured_whole(self, tmp_path: Path) -> None:
        folder = self.halves(tmp_path)
        model = read(footprints(tmp_path), surface=str(folder))
        assert tops(model) == pytest.approx([house[4] for house in HOUSES], abs=0.3)

    def test_a_step_between_tiles_is_a_finding(self, tmp_path: Path) -> None:
        for step_m, is_told in ((0.0, False), (0.8, True)):
            folder = self.halves(tmp_path / str(step_m), step_m)
            found = codes(read(footprints(tmp_path), surface=str(folder)))
            assert ("LB705" in found) == is_told

    def test_tiles_off_the_raster_are_refused(self, tmp_path: Path) -> None:
        with pytest.raises(CityModelError, match="cells off the raster"):
            read(footprints(tmp_path), surface=str(self.halves(tmp_path, off=0.2)))

    def test_tiles_of_two_systems_are_refused(self, tmp_path: Path) -> None:
        folder = self.halves(tmp_path)
        write_raster(folder / "z.tif", heights_of([]), crs="EPSG:25833")
        with pytest.raises(CityModelError, match="different reference systems"):
            read(footprints(tmp_path), surface=str(folder))
