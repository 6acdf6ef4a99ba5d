"""Orthophotos under a map: where each colour ends up, by coordinates; what is refused."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lodbench.citymodel import ReadOptions, open_scene, read_city_model
from lodbench.citymodel.scene import build_scene
from lodbench.citymodel.surface.orthophoto import open_imagery, square_corners
from lodbench.citymodel.textured_map import open_textured_map, read_textured
from lodbench.errors import CityModelError, ConfigError, DatasetError
from lodbench.synthesis.surveys import orthophoto, viewed_from_above

from .surface_case import CELL_M, NORTH, WEST, heights_of, write_raster

rasterio = pytest.importorskip("rasterio")
from_origin = rasterio.transform.from_origin

UTM, LOW = "EPSG:25832", np.array([500_000.0, 5_700_000.0])


def beside(east, north):
    """Returns a place so far from the south-western corner of the picture, metres."""
    return LOW + np.array([east, north], float)


def city(crs=UTM, low=LOW):
    corners = np.array([[0, 0, 0], [100, 0, 0], [100, 100, 0], [0, 100, 0]], float)
    vertices = corners + np.array([*low, 0.0])
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return build_scene(vertices, triangles, np.zeros(2, np.int32), ["a"], crs=crs)


def quarters(dtype=np.uint8, bands=3):
    """100 x 100 cells of a metre: north-west red, north-east green, south-west blue, south-east grey."""
    picture = np.zeros((bands, 100, 100), dtype)
    top = np.iinfo(dtype).max
    picture[0, :50, :50] = picture[1, :50, 50:] = picture[2, 50:, :50] = top
    picture[:, 50:, 50:] = top // 2
    return picture


def write(path, picture, crs=UTM, low=LOW, **more):
    profile = {
        "driver": "GTiff",
        "crs": crs,
        "transform": from_origin(low[0], low[1] + 100.0, 1.0, 1.0),
    } | more
    count, height, width = picture.shape
    with rasterio.open(
        path, "w", count=count, height=height, width=width, dtype=picture.dtype, **profile
    ) as out:
        out.write(picture)
    return path


def at(seen, low, high, place):
    """Returns the pixel (blue, green, red, alpha) of a place."""
    height, width = seen.shape[:2]
    column, row = (place - low) / (high - low) * np.array([width, -height]) + np.array([0, height])
    return seen[int(row), int(column)].tolist()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_colours_lie_where_the_file_has_them_and_nothing_beyond_it(tmp_path, dtype):
    imagery = open_imagery(write(tmp_path / "dop.tif", quarters(dtype)), city())
    low, high = LOW - 50.0, beside(150.0, 110.0)
    seen = imagery.within(low, high)
    assert seen.shape == (1280, 1600, 4)
    assert at(seen, low, high, beside(25, 75)) == [0, 0, 255, 255]
    assert at(seen, low, high, beside(75, 75)) == [0, 255, 0, 255]
    assert at(seen, low, high, beside(25, 25)) == [255, 0, 0, 255]
    assert at(seen, low, high, beside(75, 25))[3] == 255
    for outside in ((-20, 50), (120, 50), (50, -20), (50, 105)):
        assert at(seen, low, high, beside(*outside))[3] == 0
    # A border lies within a pixel of where it is.
    column = seen[at_row(seen, low, high, LOW[1] + 75.0), :, 1] > 127
    assert np.flatnonzero(column)[0] == pytest.approx(100.0 / 200.0 * 1600, abs=1)


def at_row(seen, low, high, north):
    return int((high[1] - north) / (high[1] - low[1]) * len(seen))


def test_another_reference_system_is_projected(tmp_path):
    from pyproj import Transformer

    to = Transformer.from_crs(UTM, "EPSG:25833", always_xy=True)
    other = np.array(to.transform(*(LOW + 50.0))) - 50.0
    imagery = open_imagery(write(tmp_path / "dop.tif", quarters(), "EPSG:25833", other), city())
    low, high = LOW - 60.0, LOW + 160.0
    seen = imagery.within(low, high)
    # A cell of the file, as pyproj has it in the city's plane.
    back = Transformer.from_crs("EPSG:25833", UTM, always_xy=True)
    for offset, colour in (
        ([20, 80], [0, 0, 255, 255]),
        ([80, 80], [0, 255, 0, 255]),
        ([20, 20], [255, 0, 0, 255]),
    ):
        assert at(seen, low, high, np.array(back.transform(*(other + offset)))) == colour


def test_one_band_is_grey_and_a_palette_has_its_colours(tmp_path):
    grey = open_imagery(write(tmp_path / "grey.tif", quarters(bands=3)[:1]), city()).within(LOW, LOW + 100.0)
    assert at(grey, LOW, LOW + 100.0, beside(25, 75)) == [255, 255, 255, 255]
    path = tmp_path / "palette.tif"
    numbers = np.full((1, 100, 100), 7, np.uint8)
    with rasterio.open(
        path, "w", driver="GTiff", width=100, height=100, count=1, dtype="uint8", crs=UTM,
        transform=from_origin(LOW[0], LOW[1] + 100.0, 1.0, 1.0), photometric="palette",
    ) as out:  # fmt: skip
        out.write(numbers)
        out.write_colormap(1, {7: (10, 20, 30, 255)})
    seen = open_imagery(path, city()).within(LOW, LOW + 100.0)
    assert at(seen, LOW, LOW + 100.0, LOW + 50.0) == [30, 20, 10, 255]


def test_a_file_without_a_system_is_in_the_city_s(tmp_path):
    imagery = open_imagery(write(tmp_path / "dop.tif", quarters(), crs=None), city(crs=None))
    seen = imagery.within(LOW, LOW + 100.0)
    assert at(seen, LOW, LOW + 100.0, beside(25, 75)) == [0, 0, 255, 255]


def test_what_cannot_lie_under_the_city_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="There is no imagery"):
        open_imagery(tmp_path / "none.tif", city())
    (tmp_path / "a.png").write_bytes(b"x")
    with pytest.raises(ConfigError, match="no orthophoto by its ending"):
        open_imagery(tmp_path / "a.png", city())
    (tmp_path / "b.tif").write_bytes(b"II*\0nothing")
    with pytest.raises(CityModelError, match="cannot be read as a raster"):
        open_imagery(tmp_path / "b.tif", city())
    far = write(tmp_path / "far.tif", quarters(), low=beside(5_100.0, 0.0))
    with pytest.raises(CityModelError, match=r"lies 5\.0 km outside"):
        open_imagery(far, city())
    placed = write(tmp_path / "dop.tif", quarters())
    with pytest.raises(CityModelError, match="the city model has none"):
        open_imagery(placed, city(crs=None))
    bare = write(tmp_path / "bare.tif", quarters(), crs=None, transform=rasterio.Affine.identity())
    with pytest.raises(CityModelError, match="does not say where it lies"):
        open_imagery(bare, city())


pytest.importorskip("rasterio")

HOUSE = (10.0, 10.0, 26.0, 24.0, 6.0)
GREY, GREEN, RED = (120, 118, 116), (70, 120, 60), (180, 40, 40)


def colours(heights: np.ndarray, colour: tuple[int, ...] = GREY) -> np.ndarray:
    """Returns (3, rows, columns) of one colour, twice as fine as the heights."""
    rows, columns = heights.shape
    return np.broadcast_to(np.array(colour, np.uint8)[:, None, None], (3, 2 * rows, 2 * columns)).copy()


def write_colours(path: Path, picture: np.ndarray, **changed: Any) -> Path:
    import rasterio
    from rasterio.transform import from_origin

    profile = {
        "driver": "GTiff", "height": picture.shape[1], "width": picture.shape[2], "count": len(picture),
        "dtype": picture.dtype, "crs": "EPSG:25832",
        "transform": from_origin(WEST, NORTH, CELL_M / 2, CELL_M / 2),
    } | changed  # fmt: skip
    with rasterio.open(path, "w", **profile) as raster:
        raster.write(picture)
    return path


def dome(heights: np.ndarray) -> None:
    """Puts a dome of 8 m onto a square of 10 m whose middle is 60 m to the east and south."""
    middles = (np.arange(len(heights)) + 0.5) * CELL_M
    x, y = np.meshgrid(middles, middles)
    inside = np.hypot(x - 60, y - 60) < 5
    heights[inside] += (8.0 - 0.2 * ((x - 60) ** 2 + (y - 60) ** 2))[inside]


@pytest.mark.parametrize(("colour", "count"), [(None, 1), (GREEN, 1), (GREY, 2)])
def test_colour_tells_a_dome_from_a_tree(tmp_path: Path, colour: Any, count: int) -> None:
    heights = heights_of([HOUSE])
    dome(heights)
    path = write_raster(tmp_path / "dsm.tif", heights)
    picture = colours(heights)
    if colour is not None:
        picture[:, 200:280, 200:280] = np.array(colour)[:, None, None]
    photo = write_colours(tmp_path / "dop.tif", picture)
    options = ReadOptions(orthophoto=None if colour is None else str(photo))
    model = read_city_model(path, options=options)
    scene = open_scene(path, options=options)
    spans = pairwise(scene.vertex_starts)
    middles = np.array([scene.vertices[first:last, :2].mean(axis=0) for first, last in spans])
    places = middles + scene.origin[:2] - (WEST, NORTH)
    assert model.format == "surface model"
    assert bool((np.abs(places - (60, -60)) < 6).all(axis=1).any()) == (count == 2)


def test_squares_follow_the_heights_within_the_tolerance() -> None:
    heights = heights_of([HOUSE], pitch=0.5).astype(np.float32)
    heights[150:, 150:] = np.nan
    corners = square_corners(heights, 0.25)
    points = np.concatenate(
        [corners[..., ::-1] + 0.5, heights[corners[..., 0], corners[..., 1]][..., None]], axis=2
    )
    # Cells' middles are the corners, so heights are compared half a cell further.
    found, _ = viewed_from_above(points * (1.0, -1.0, 1.0), 0.0, 0.0, 1.0, heights.shape)
    both = np.isfinite(found) & np.isfinite(heights)
    assert np.abs(found - heights)[both].max() <= 0.26
    assert both[:-1, :-1].sum() >= np.isfinite(heights[:-1, :-1]).sum() - 150
    assert not np.isfinite(found[155:, 155:]).any()
    assert len(corners) < 0.2 * 2 * heights.size


def test_level_ground_is_two_triangles_a_square():
    corners = square_corners(np.zeros((33, 33), np.float32), 0.25)
    np.testing.assert_array_equal(corners, [[[0, 0], [32, 0], [32, 32]], [[0, 0], [32, 32], [0, 32]]])


def test_the_mesh_has_the_colours_of_their_places(tmp_path: Path) -> None:
    heights = heights_of([HOUSE])
    picture = colours(heights)
    picture[:, 40:96, 40:104] = np.array(RED)[:, None, None]
    path = write_raster(tmp_path / "dsm.tif", heights)
    options = ReadOptions(orthophoto=str(write_colours(tmp_path / "dop.tif", picture)))
    mesh = read_textured(path, options=options)
    _, triangle = viewed_from_above(mesh.corners, WEST, NORTH, CELL_M, heights.shape)
    seen = orthophoto(mesh, WEST, NORTH, CELL_M, triangle)
    assert (seen[24:44, 24:48] == RED).all()
    assert (seen[100:180, 100:180] == GREY).all()
    scene = open_scene(path, options=options)
    moved = open_textured_map(path, scene, options)
    np.testing.assert_allclose(moved.corners + scene.origin, mesh.corners, atol=1e-6)


def test_what_is_no_orthophoto_is_refused(tmp_path: Path) -> None:
    heights = heights_of([HOUSE])
    path = write_raster(tmp_path / "dsm.tif", heights)
    with pytest.raises(DatasetError, match="heights alone"):
        read_textured(path, options=ReadOptions())
    for photo, match in ((tmp_path / "no.tif", "no orthophoto"), (path, "bands of float32")):
        with pytest.raises(CityModelError, match=match):
            read_textured(path, options=ReadOptions(orthophoto=str(photo)))
