"""Orthophotos under a map: where each colour ends up, by coordinates; what is refused."""

import numpy as np
import pytest

from lodbench.citymodel.imagery import open_imagery
from lodbench.citymodel.scene import build_scene
from lodbench.errors import CityModelError, ConfigError

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
