"""A surface model as a city: houses with walls and plane roofs, no trees, whatever the blocks and source."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lodbench.citymodel import ReadOptions, mesh_model, open_scene, read_city_model
from lodbench.citymodel.model import CityModel, SurfaceKind
from lodbench.errors import CityModelError
from lodbench.synthesis.surveys import viewed_from_above

from .gml_text import codes
from .surface_case import CELL_M, NORTH, WEST, ground_m, heights_of, write_raster

pytest.importorskip("rasterio")

HOUSES = [(10.0, 10.0, 22.0, 20.0, 6.0), (40.0, 12.0, 48.0, 30.0, 9.5), (60.0, 60.0, 90.0, 80.0, 3.2)]


def read(path: Path, **options: Any) -> CityModel:
    return read_city_model(path, options=ReadOptions(**options))


def tree(heights: np.ndarray, east: float, south: float, radius: float = 4.0, height: float = 9.0) -> None:
    """Puts a crown onto heights, rough by half a metre."""
    middles = (np.arange(heights.shape[0]) + 0.5) * CELL_M
    x, y = np.meshgrid(middles, middles)
    away = np.hypot(x - east, y - south)
    crown = height - 0.35 * away**2 / radius + np.random.default_rng(3).uniform(-0.7, 0.7, heights.shape)
    inside = away < radius
    heights[inside] = np.maximum(heights, ground_m(x, y) + crown)[inside]


def from_above(model: CityModel, shape: tuple[int, int]) -> np.ndarray:
    """Returns the highest point of a model over each cell of the test's rasters, NaN for none."""
    scene = mesh_model(model, "2").scene
    corners = scene.vertices[scene.triangles].astype(np.float64) + scene.origin
    return viewed_from_above(corners, WEST, NORTH, CELL_M, shape)[0]


@pytest.mark.parametrize("pitch", [0.0, 0.6])
def test_roofs_are_drawn_where_and_as_high_as_they_are(tmp_path: Path, pitch: float) -> None:
    heights = heights_of(HOUSES, pitch=pitch)
    noisy = heights + np.random.default_rng(0).normal(scale=0.04, size=heights.shape)
    model = read(write_raster(tmp_path / "dsm.tif", noisy))
    found = from_above(model, heights.shape)
    is_house = heights - heights_of([]) > 2.0
    both = is_house & np.isfinite(found)
    assert both.sum() / (is_house | np.isfinite(found)).sum() > 0.97
    assert np.abs(found - heights)[both].max() < 0.5
    assert np.abs(found - heights)[both].mean() < 0.06
    assert len(model.building_ids) == len(HOUSES)
    roofs = int((model.polygons.kind == SurfaceKind.ROOF).sum())
    assert roofs == len(HOUSES) * (1 if pitch == 0 else 2)


def test_walls_reach_the_ground_and_close_every_gap(tmp_path: Path) -> None:
    """Seen from any side nothing shines through: each edge of a roof has a wall, or another roof."""
    heights = heights_of(HOUSES, pitch=0.6)
    heights[24:34, 24:36] += 4.0  # a tower on the first house
    scene = open_scene(write_raster(tmp_path / "dsm.tif", heights))
    corners = scene.vertices.astype(np.float64)[scene.triangles]
    # All walls and roofs, projected onto a plane, cover as much from one side as from the other.
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(axis=0)
    assert np.abs(area[:2]).max() < 1e-2 * np.abs(area[2])
    lowest = scene.vertices[:, 2].min() + scene.origin[2]
    assert lowest == pytest.approx(heights.min(), abs=1.0)


def test_trees_are_left_out_and_told(tmp_path: Path) -> None:
    heights = heights_of(HOUSES[:2])
    tree(heights, 70.0, 70.0)
    tree(heights, 24.0, 15.0)  # over the eaves of the first house
    model = read(write_raster(tmp_path / "dsm.tif", heights))
    found = np.isfinite(from_above(model, heights.shape))
    assert not found[120:160, 120:160].any()
    is_house = heights_of(HOUSES[:2]) - heights_of([]) > 2.0
    assert (found & is_house).sum() > 0.85 * is_house.sum()
    assert "LB707" in codes(model)


def test_level_1_is_derived_as_of_any_city(tmp_path: Path) -> None:
    path = write_raster(tmp_path / "dsm.tif", heights_of(HOUSES, pitch=0.5))
    scene = open_scene(path, lod="1", roof_height="median")
    assert scene.num_buildings == 3
    rises = [
        float(np.ptp(scene.vertices[a:b, 2]))
        for a, b in zip(scene.vertex_starts, scene.vertex_starts[1:], strict=False)
    ]
    expected = [house[4] + 0.125 * (house[3] - house[1]) for house in HOUSES]
    assert sorted(rises) == pytest.approx(sorted(expected), abs=0.6)


def test_what_is_drawn_does_not_depend_on_blocks(tmp_path: Path, monkeypatch: Any) -> None:
    path = write_raster(tmp_path / "dsm.tif", heights_of(HOUSES, pitch=0.4))
    whole = read(path)
    for module in ("grid", "ground", "regions"):
        monkeypatch.setattr(f"lodbench.citymodel.surface.{module}.BLOCK", 64)
    cut = read(path)
    assert sorted(cut.building_ids) == sorted(whole.building_ids)
    first, second = (from_above(model, (200, 200)) for model in (whole, cut))
    np.testing.assert_allclose(first, second, atol=1e-3)
    assert not any("cut where" in item.detail for item in cut.findings.items)


def test_long_regions_are_cut_where_blocks_end(tmp_path: Path, monkeypatch: Any) -> None:
    heights = heights_of([(5.0, 40.0, 95.0, 52.0, 7.0)])
    path = write_raster(tmp_path / "dsm.tif", heights)
    monkeypatch.setattr("lodbench.citymodel.surface.regions.BLOCK", 64)
    monkeypatch.setattr("lodbench.citymodel.surface.regions._HALO_M", 16.0)
    model = read(path)
    assert any("long regions are cut" in item.detail for item in model.findings.items)
    found = np.isfinite(from_above(model, heights.shape))
    is_house = heights - heights_of([]) > 2.0
    assert (found & is_house).sum() == pytest.approx(is_house.sum(), rel=0.03)


def test_the_datum_of_a_compound_system_is_kept_and_a_missing_one_told(tmp_path: Path) -> None:
    heights = heights_of(HOUSES)
    named = read(write_raster(tmp_path / "a.tif", heights, crs="EPSG:25832+7837"))
    assert (named.crs, "LB702" in codes(named)) == ("EPSG:25832+7837", False)
    plain = read(write_raster(tmp_path / "b.tif", heights))
    assert (plain.crs, "LB702" in codes(plain)) == ("EPSG:25832", True)
    told = next(item for item in plain.findings.items if item.code.code == "LB708")
    assert "cells within 0.25 m of their plane" in told.detail


def test_feet_become_metres(tmp_path: Path) -> None:
    from rasterio.transform import from_origin

    foot = 1200 / 3937
    place = from_origin(985000.0, 200000.0, CELL_M / foot, CELL_M / foot)
    path = write_raster(tmp_path / "dsm.tif", heights_of(HOUSES) / foot, crs="EPSG:2263", transform=place)
    low, high = open_scene(path).extent_m
    assert high - low == pytest.approx([80.0, 70.0, 11.0], abs=1.5)


def test_a_folder_of_tiles_is_one_city(tmp_path: Path) -> None:
    from rasterio.transform import from_origin

    heights = heights_of(HOUSES)
    folder = tmp_path / "tiles"
    folder.mkdir()
    write_raster(folder / "a.tif", heights[:, :90])
    write_raster(folder / "b.tif", heights[:, 90:], transform=from_origin(WEST + 45.0, NORTH, CELL_M, CELL_M))
    assert len(read(folder).building_ids) == 3


def test_gaps_of_two_cells_are_filled_and_larger_ones_stay(tmp_path: Path) -> None:
    heights = heights_of(HOUSES)
    heights[30, 30] = -9999.0
    heights[130:150, 130:150] = -9999.0
    found = from_above(read(write_raster(tmp_path / "dsm.tif", heights)), heights.shape)
    assert np.isfinite(found[30, 30])
    assert not np.isfinite(found[135:145, 135:145]).any()


def test_flat_land_is_no_city(tmp_path: Path) -> None:
    with pytest.raises(CityModelError, match="rises 2 m above the ground"):
        read(write_raster(tmp_path / "dtm.tif", heights_of([])))


class TestLaserPoints:
    @pytest.fixture(autouse=True)
    def _needs_laspy(self) -> None:
        pytest.importorskip("laspy")
        pytest.importorskip("lazrs")

    def write(self, path: Path, heights: np.ndarray, kinds: np.ndarray) -> Path:
        import laspy
        from pyproj import CRS

        header = laspy.LasHeader(point_format=6, version="1.4")
        header.offsets, header.scales = [WEST, NORTH, 0.0], [0.01, 0.01, 0.01]
        header.add_crs(CRS.from_epsg(25832))
        points = laspy.LasData(header)
        rows, columns = (each.reshape(-1) for each in np.indices(heights.shape))
        spots = np.random.default_rng(1).uniform(0.1, 0.9, (2, 3, len(rows)))
        points.x = np.concatenate(WEST + (columns + spots[0]) * CELL_M)
        points.y = np.concatenate(NORTH - (rows + spots[1]) * CELL_M)
        points.z = np.tile(heights.reshape(-1), 3)
        points.classification = np.tile(kinds.reshape(-1), 3)
        points.write(path)
        return path

    def test_houses_ground_and_plants_by_their_classes(self, tmp_path: Path) -> None:
        heights = heights_of(HOUSES)
        kinds = np.where(heights - heights_of([]) > 2.0, 6, 2).astype(np.uint8)
        kinds[120:160, 120:180] = 5  # the third house is a hedge, as flat as a roof
        heights[5, 5], kinds[5, 5] = 400.0, 18
        path = self.write(tmp_path / "points.laz", heights, kinds)
        model = read(path)
        assert model.crs == "EPSG:25832"
        assert "LB703" not in codes(model)
        found = np.isfinite(from_above(model, heights.shape))
        is_house = kinds == 6
        assert not found[120:160, 120:180].any()
        assert (found & is_house).sum() / (found | is_house).sum() > 0.9

    def test_a_damaged_file_is_refused(self, tmp_path: Path) -> None:
        path = tmp_path / "points.laz"
        path.write_bytes(b"LASF" + bytes(400))
        with pytest.raises(CityModelError, match=r"points\.laz"):
            read(path)
