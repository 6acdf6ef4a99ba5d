"""Maps made of traced masks: the true pose shows the mask again, a wrong map is wrong by what was asked."""

import json

import cv2
import numpy as np
import pytest

from lodbench.bench.photo_masks import TracedOptions, open_traced_photos
from lodbench.citymap import CityMap
from lodbench.cli.bench import main
from lodbench.errors import DatasetError
from lodbench.segmentation.masks import read_mask


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """Two places: blocks with a court on grass, and a photo of nothing."""
    root = tmp_path_factory.mktemp("traced")
    for place, boxes in (
        ("town", [(40, 30, 130, 100), (180, 60, 260, 190), (20, 140, 90, 200)]),
        ("field", []),
    ):
        mask = np.zeros((240, 320), np.uint8)
        for left, top, right, bottom in boxes:
            mask[top:bottom, left:right] = 255
        mask[60:80, 60:100] = 0
        noise = np.random.default_rng(1).integers(0, 25, (240, 320, 3), dtype=np.uint8)
        picture = np.where(mask[..., None] > 0, (60, 70, 150), (60, 120, 70)).astype(np.uint8) + noise
        for folder, image in (("photos", picture), ("masks", mask)):
            (root / place / folder).mkdir(parents=True)
            cv2.imwrite(str(root / place / folder / "a.png"), image)
    return root


def test_the_true_pose_shows_the_traced_mask(photos):
    dataset, scene = open_traced_photos(photos, TracedOptions(0.0))
    (entry,) = dataset.entries
    assert (entry.key, scene.num_buildings) == ("town/a.png", 3)
    drawn = CityMap(scene).render(entry.camera, dataset.truth[entry.key])
    traced = read_mask(photos / "town" / "masks" / "a.png") >= 0.5
    # The court is kept; borders of pixels may fall to either side.
    assert (drawn & traced).sum() / (drawn | traced).sum() > 0.99


def test_roofs_go_on_beyond_the_photo(tmp_path):
    """So that a camera too high sees as much of a roof at the photo's edge as of any other."""
    mask = np.zeros((240, 320), np.uint8)
    mask[:, :100] = 255
    for folder in ("photos", "masks"):
        (tmp_path / "town" / folder).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / "town" / folder / "a.png"), mask)
    dataset, scene = open_traced_photos(tmp_path, TracedOptions(0.0))
    (entry,) = dataset.entries
    higher = dataset.truth[entry.key].shifted([0.0, 0.0, 5.0])
    drawn = CityMap(scene).render(entry.camera, higher)
    assert drawn[:, :95].all()
    assert not drawn[:, 105:].any()


def test_a_wrong_map_is_wrong_by_about_what_was_asked(photos):
    dataset, scene = open_traced_photos(photos, TracedOptions(1.0, seed=3))
    other, _ = open_traced_photos(photos, TracedOptions(1.0, seed=3))
    assert other.truth.keys() == dataset.truth.keys()
    (entry,) = dataset.entries
    drawn = CityMap(scene).render(entry.camera, dataset.truth[entry.key])
    traced = read_mask(photos / "town" / "masks" / "a.png") >= 0.5
    assert 0.5 < (drawn & traced).sum() / (drawn | traced).sum() < 0.99


def test_photos_without_buildings_are_no_queries(photos, tmp_path):
    (tmp_path / "field").symlink_to(photos / "field")
    with pytest.raises(DatasetError, match="shows a building"):
        open_traced_photos(tmp_path, TracedOptions())


def test_the_command_finds_poses_from_pixels(photos, capsys):
    assert (
        main(["real", "--photos", str(photos), "--priors", "2", "--method", "prior_only,region", "--json"])
        == 0
    )
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines() if line.startswith("{")]
    figures = {line["figure"]: line["value"] for line in lines}
    assert figures["region: priors"] == 2
    assert figures["region: median translation"] < 0.3 * figures["prior_only: median translation"]


def test_traced_masks_are_perfect_masks(photos, capsys):
    words = ["--priors", "2", "--method", "contour_alignment", "--segmenter", "masks", "--json"]
    assert main(["real", "--photos", str(photos), *words]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines() if line.startswith("{")]
    figures = {line["figure"]: line["value"] for line in lines}
    assert figures["contour_alignment: median translation"] < 2.0
