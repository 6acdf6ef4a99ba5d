"""Masks as polygons: there and back to the pixel, and what other programs make of them."""

import json

import numpy as np
import pytest
from hypothesis import given, strategies
from hypothesis.extra.numpy import arrays

from lodbench.errors import DatasetError
from lodbench.segmentation.masks import mask_of, polygons_of
from lodbench.segmentation.polygon_files import polygon_text, read_polygons


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
    path.write_text(polygon_text(name, drawn(), "photo.jpg"))
    assert np.array_equal(read_polygons(path, "photo.jpg", 40, 60), drawn())
    assert np.array_equal(mask_of(polygons_of(drawn()), 40, 60), drawn())
    with pytest.raises(DatasetError, match=r"photo of 60 x 40, this one has 30 x 20"):
        read_polygons(path, "photo.jpg", 20, 30)


def test_coco_is_as_its_own_readers_expect(tmp_path):
    (tmp_path / "mask.json").write_text(polygon_text("coco", town(), "photo.jpg"))
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
    (tmp_path / "mask.json").write_text(polygon_text("geojson", town(), "photo.jpg"))
    features = json.loads((tmp_path / "mask.json").read_text())["features"]
    outer, yard = features[0]["geometry"]["coordinates"]
    assert outer[0] == outer[-1]
    assert min(y for _, y in outer) == -29.5
    assert max(x for x, _ in yard) == 33.5
    assert len(features) == 3


SQUARE = [[2, 3], [6, 3], [6, 8], [2, 8]]


def labelme(*labels):
    shapes = [{"label": label, "points": SQUARE} for label in labels]
    return {"shapes": shapes, "imageWidth": 60, "imageHeight": 40}


def coco(**changed):
    image = {"id": 1, "file_name": "a/photo.jpg", "width": 60, "height": 40}
    drawn = {"id": 1, "image_id": 1, "category_id": 1, "segmentation": [np.ravel(SQUARE).tolist()]}
    return {"images": [image], "categories": [{"id": 1, "name": "roof"}], "annotations": [drawn]} | changed


def coco_runs(counts):
    drawn = {"image_id": 1, "category_id": 1, "segmentation": {"size": [40, 60], "counts": counts}}
    return coco(annotations=[drawn])


def moved(content, by):
    for shape in content["shapes"]:
        shape["points"] = [[x + by, y] for x, y in shape["points"]]
    return content


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (labelme("Gebäude", "hole"), "shows no building: its labels are Gebäude"),
        (coco(categories=[{"id": 1, "name": "bldg"}]), "shows no building: its labels are bldg"),
        (coco(annotations=[{"image_id": 7, "category_id": 1}]), "none of them of its image 1"),
        (coco(annotations=[{"image_id": 1, "category_id": 1, "segmentation": []}]), "a roof has no outline"),
        (
            coco(images=[*coco()["images"], {"id": 2, "file_name": "b/photo.jpg"}]),
            "2 images called photo.jpg",
        ),
        (
            coco(
                annotations=[
                    {
                        "image_id": 1,
                        "category_id": 1,
                        "segmentation": {"size": [60, 40], "counts": [9, 9, 2382]},
                    }
                ]
            ),
            "do not fill the photo",
        ),
        # Lengths whose sum in 64 bits is that of the photo, and one of more than 64.
        (coco_runs([1 << 62] * 4 + [2400]), "do not fill the photo"),
        (coco_runs([10**19, 1]), "do not fill the photo"),
        (coco_runs([float("inf")]), "cannot be read: OverflowError"),
        (labelme("roof") | {"imageWidth": float("inf")}, "cannot be read: OverflowError"),
        (labelme("roof") | {"imagePath": "..\\day 1\\other.jpg"}, "is of other.jpg, not of photo.jpg"),
        (
            coco(images=[coco()["images"][0] | {"file_name": "other.jpg"}]),
            "is of other.jpg, not of photo.jpg",
        ),
        (coco(annotations=[coco_runs([2400])["annotations"][0]]), "no building inside the photo"),
        (moved(labelme("roof"), 500), "no building inside the photo"),
    ],
)
def test_no_mask_is_made_of_what_holds_no_building(content, words, tmp_path):
    path = tmp_path / "drawn.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(DatasetError, match=words):
        read_polygons(path, "photo.jpg", 40, 60)


@pytest.mark.parametrize(
    "content",
    [
        labelme("Roof ", "car"),
        coco(
            categories=[{"id": "1", "name": "roof"}, {"id": 2, "name": "car"}],
            annotations=[*coco()["annotations"], {"image_id": "1", "category_id": 2}],
        ),
    ],
)
def test_what_is_labelled_as_something_else_is_left_out_aloud(content, tmp_path, caplog):
    path = tmp_path / "drawn.json"
    path.write_text(json.dumps(content))
    assert read_polygons(path, "photo.jpg", 40, 60)[4, 4]
    assert "left out, for they are no buildings: car (1)" in caplog.text


def test_rectangles_have_two_corners_or_four(tmp_path):
    path, found = tmp_path / "drawn.json", []
    for corners in (SQUARE, SQUARE[::2]):
        content = labelme("house")
        content["shapes"][0] |= {"shape_type": "rectangle", "points": corners}
        path.write_text(json.dumps(content))
        found.append(read_polygons(path, "photo.jpg", 40, 60))
    assert found[0].any()
    assert np.array_equal(*found)


def test_files_name_a_photo_by_its_stem_in_any_folder(tmp_path):
    path = tmp_path / "drawn.json"
    for content in (
        labelme("roof") | {"imagePath": "..\\day 1\\Photo.png"},
        coco(images=[coco()["images"][0] | {"file_name": "images/PHOTO.tif"}]),
    ):
        # With the byte order mark that some editors begin files with.
        path.write_text(json.dumps(content), encoding="utf-8-sig")
        assert read_polygons(path, "photo.jpg", 40, 60)[4, 4]


def test_letters_of_macos_are_the_same_letters(tmp_path):
    path = tmp_path / "drawn.json"
    for content in (
        labelme("roof") | {"imagePath": "Geb\u00e4ude.jpg"},
        coco(images=[coco()["images"][0] | {"file_name": "Geb\u00e4ude.jpg"}]),
    ):
        path.write_text(json.dumps(content))
        assert read_polygons(path, "Geba\u0308ude.jpg", 40, 60)[4, 4]


def test_a_photo_without_buildings_has_an_empty_mask(tmp_path):
    path = tmp_path / "drawn.json"
    for content in (labelme(), coco(annotations=[])):
        path.write_text(json.dumps(content))
        assert not read_polygons(path, "photo.jpg", 40, 60).any()


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
        ("{", "is not a JSON file"),
        ("[]", "neither LabelMe"),
        ('{"shapes": [{}], "imageWidth": 60, "imageHeight": 40}', "cannot be read: KeyError"),
        (
            '{"shapes": [{"label": "house", "points": [[1, 1]], "shape_type": "circle"}],'
            ' "imageWidth": 60, "imageHeight": 40}',
            "holds a circle",
        ),
        ('{"images": [], "categories": [], "annotations": []}', "has 0 images"),
        (
            '{"images": [{"id": 1, "file_name": "photo.jpg", "width": 60, "height": 40}],'
            ' "categories": [{"id": 1, "name": "building"}],'
            ' "annotations": [{"image_id": 1, "category_id": 1, "segmentation": {"counts": "abc"}}]}',
            "compressed run lengths",
        ),
    ],
)
def test_broken_files_are_reported_in_one_line(content, words, tmp_path):
    path = tmp_path / "drawn.json"
    path.write_text(content)
    with pytest.raises(DatasetError, match=words):
        read_polygons(path, "photo.jpg", 40, 60)
