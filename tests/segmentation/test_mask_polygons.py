"""Masks as polygons: there and back to the pixel, and what other programs make of them."""

import json

import numpy as np
import pytest
from hypothesis import given, strategies
from hypothesis.extra.numpy import arrays

from lodbench.errors import DatasetError
from lodbench.segmentation.mask_polygons import WRITERS, mask_of, polygons_of, read_polygons


def town():
    """A block with a yard, a shed in the yard, and a house at the border."""
    mask = np.zeros((40, 60), bool)
    mask[5:30, 8:40] = True
    mask[10:25, 14:34] = False
    mask[15:19, 20:26] = True
    mask[33:, 50:] = True
    return mask


@given(arrays(bool, strategies.tuples(strategies.integers(1, 14), strategies.integers(1, 14))))
def test_any_mask_comes_back_to_the_pixel(mask):
    assert np.array_equal(mask_of(polygons_of(mask), *mask.shape), mask)


def wall_round_a_block():
    """A wall of fewer pixels than the block in its court."""
    mask = np.ones((40, 60), bool)
    mask[1:-1, 1:-1] = False
    mask[3:-3, 3:-3] = True
    return mask


def court_that_closes_but_for_a_corner():
    """A block whose court runs round a shed that touches the block at one corner."""
    mask = np.ones((40, 60), bool)
    mask[10:30, 10:40] = False
    mask[14:20, 14:20] = True
    mask[10:14, 10:14] = True
    return mask


@pytest.mark.parametrize("name", ["labelme", "coco"])
@pytest.mark.parametrize("drawn", [town, wall_round_a_block, court_that_closes_but_for_a_corner])
def test_files_come_back_to_the_pixel(drawn, name, tmp_path):
    path = tmp_path / "mask.json"
    WRITERS[name](drawn(), tmp_path / "photo.jpg", path)
    assert np.array_equal(read_polygons(path, "photo.jpg", 40, 60), drawn())
    assert np.array_equal(mask_of(polygons_of(drawn()), 40, 60), drawn())
    with pytest.raises(DatasetError, match=r"photo of 60 x 40, this one has 30 x 20"):
        read_polygons(path, "photo.jpg", 20, 30)


def test_coco_is_as_its_own_readers_expect(tmp_path):
    WRITERS["coco"](town(), tmp_path / "photo.jpg", tmp_path / "mask.json")
    stored = json.loads((tmp_path / "mask.json").read_text())
    block, house, shed = stored["annotations"]
    assert block["bbox"] == [8, 5, 32, 25]
    assert block["area"] == 25 * 32 - 15 * 20
    assert block["iscrowd"] == 1
    # Columns first, zeros first: eight empty columns and five rows before the first building pixel.
    assert block["segmentation"]["counts"][:2] == [8 * 40 + 5, 25]
    assert sum(block["segmentation"]["counts"]) == 40 * 60
    assert house["iscrowd"] == shed["iscrowd"] == 0
    assert shed["area"] == 24
    assert stored["images"] == [{"id": 1, "file_name": "photo.jpg", "width": 60, "height": 40}]


def test_geojson_counts_rows_downwards_and_keeps_yards(tmp_path):
    WRITERS["geojson"](town(), tmp_path / "photo.jpg", tmp_path / "mask.json")
    features = json.loads((tmp_path / "mask.json").read_text())["features"]
    outer, yard = features[0]["geometry"]["coordinates"]
    assert outer[0] == outer[-1]
    assert min(y for _, y in outer) == -29.5
    assert max(x for x, _ in yard) == 33.5
    assert len(features) == 3


def test_polygons_drawn_by_others_count_pixels_whose_centres_they_hold(tmp_path):
    square = {"label": "House", "points": [[2, 3], [6, 3], [6, 8], [2, 8]], "shape_type": "polygon"}
    car = {"label": "car", "points": [[0, 0], [9, 0], [9, 9]], "shape_type": "polygon"}
    path = tmp_path / "drawn.json"
    path.write_text(json.dumps({"shapes": [square, car], "imageWidth": 12, "imageHeight": 10}))
    found = read_polygons(path, "photo.jpg", 10, 12)
    expected = np.zeros((10, 12), bool)
    expected[3:8, 2:6] = True
    # OpenCV counts pixels on the outline, too: half a pixel at most.
    assert (found & expected).sum() == expected.sum()
    assert found.sum() <= 30


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "is no JSON file"),
        ("[]", "neither LabelMe"),
        ('{"shapes": [{}], "imageWidth": 60, "imageHeight": 40}', "cannot be read: KeyError"),
        (
            '{"shapes": [{"label": "house", "points": [[1, 1]], "shape_type": "circle"}],'
            ' "imageWidth": 60, "imageHeight": 40}',
            "holds a circle",
        ),
        ('{"images": [], "categories": [], "annotations": []}', "has 0 images"),
        (
            '{"images": [{"id": 1, "file_name": "p", "width": 60, "height": 40}],'
            ' "categories": [{"id": 1, "name": "building"}],'
            ' "annotations": [{"image_id": 1, "category_id": 1, "segmentation": {"counts": "abc"}}]}',
            "compressed run lengths",
        ),
    ],
)
def test_broken_files_are_told_in_one_line(content, words, tmp_path):
    path = tmp_path / "drawn.json"
    path.write_text(content)
    with pytest.raises(DatasetError, match=words):
        read_polygons(path, "photo.jpg", 40, 60)
