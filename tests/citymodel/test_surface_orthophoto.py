"""An orthophoto over a surface model: what is green is no roof, and both are a textured mesh."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lodbench.citymodel import ReadOptions, open_scene, read_city_model
from lodbench.citymodel.mesh.texture_files import open_textured_map
from lodbench.citymodel.surface.orthophoto import read_textured_surface, square_corners
from lodbench.errors import CityModelError, DatasetError
from lodbench.synthesis.surface_survey import orthophoto, seen_from_above

from .surface_case import CELL_M, NORTH, WEST, heights_of, write_raster

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
    found, _ = seen_from_above(points * (1.0, -1.0, 1.0), 0.0, 0.0, 1.0, heights.shape)
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
    mesh = read_textured_surface(path, options)
    _, triangle = seen_from_above(mesh.corners, WEST, NORTH, CELL_M, heights.shape)
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
        read_textured_surface(path, ReadOptions())
    for photo, match in ((tmp_path / "no.tif", "no orthophoto"), (path, "bands of float32")):
        with pytest.raises(CityModelError, match=match):
            read_textured_surface(path, ReadOptions(orthophoto=str(photo)))
