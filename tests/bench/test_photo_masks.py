"""Masks of real photos: IoU by place counted by hand, empty photos by the share found."""

import cv2
import numpy as np
import pytest

from lodbench.bench.photo_masks import measure_photo_masks
from lodbench.cli import main
from lodbench.cli.bench import BENCHES
from lodbench.segmentation.compact import CompactParams
from lodbench.segmentation.photo_segmenter import PhotoSegmenter


class Reddish(PhotoSegmenter):
    """Finds what is red."""

    weights_digest = "f" * 64

    def logits(self, photo):
        return (photo[..., 0].astype(np.float32) - 128) / 8


def place(root, name, photos):
    """Writes photos of (true box, red box), columns from and to of 30 x 40 pixels."""
    (root / name / "photos").mkdir(parents=True)
    (root / name / "masks").mkdir()
    for number, (truth, red) in enumerate(photos):
        mask, photo = np.zeros((30, 40), np.uint8), np.full((30, 40, 3), 60, np.uint8)
        mask[:, slice(*truth)] = 255
        photo[:, slice(*red)] = (0, 0, 250)
        cv2.imwrite(str(root / name / "photos" / f"{number}.png"), photo)
        cv2.imwrite(str(root / name / "masks" / f"{number}.png"), mask)


@pytest.fixture
def folder(tmp_path):
    place(tmp_path, "town", [((0, 20), (0, 20)), ((0, 20), (0, 10)), ((0, 20), (10, 30))])
    place(tmp_path, "village", [((10, 20), (0, 40))])
    place(tmp_path, "meadow", [((0, 0), (0, 4)), ((0, 0), (0, 0))])
    return tmp_path


def test_ious_and_shares_are_those_counted_by_hand(folder):
    report = measure_photo_masks(Reddish(CompactParams(name="reddish")), folder)
    figures = {f.figure: f.value for f in report.figures()}
    assert report.by_place()["town"] == pytest.approx([1.0, 0.5, 1 / 3])
    assert figures["IoU of village"] == 0.25
    assert figures["IoU, mean over photos"] == pytest.approx((1 + 0.5 + 1 / 3 + 0.25) / 4)
    assert figures["IoU, mean over places"] == pytest.approx(((1 + 0.5 + 1 / 3) / 3 + 0.25) / 2)
    assert figures["share found in photos without buildings"] == pytest.approx(0.05)
    assert "meadow" in report.to_text()
    report.write_pictures(folder / "out")
    picture = cv2.imread(str(folder / "out" / "town" / "2.png"))
    # Right of the true box what was found is orange, in it what was missed violet.
    assert picture[15, 27, 2] > picture[15, 27, 0]
    assert picture[15, 5, 0] > picture[15, 5, 1]
    sheet = cv2.imread(str(folder / "out" / "masks.png"))
    # A strip above, and two rows of four.
    assert sheet.shape == (34 + 2 * (448 * 3 // 4 + 24 + 4), 4 * (448 + 4), 3)


def test_the_folder_of_all_photos_will_do_as_well(tmp_path):
    place(tmp_path / "all" / "labelled", "town", [((0, 20), (0, 20))])
    report = measure_photo_masks(Reddish(CompactParams(name="reddish")), tmp_path / "all")
    assert report.by_place() == {"town": [1.0]}


def test_what_is_refused(folder, capsys):
    (folder / "town" / "masks" / "1.png").unlink()
    for wrong, words in (
        ([str(folder)], "has no mask"),
        ([str(folder / "town")], f"name the folder that holds it, {folder}."),
        ([str(folder), "--views", "3"], "by themselves"),
        ([str(folder), "--instances"], "by themselves"),
        ([str(folder), "--segmenter", "masks"], "looks at no photo alone"),
    ):
        assert main(["bench", "segmentation", "--photos", *wrong]) == 2
        assert words in capsys.readouterr().err


def test_a_single_photo_has_no_interval(folder):
    text = measure_photo_masks(Reddish(CompactParams(name="reddish")), folder).to_text()
    assert ["village", "1", "0.250", "-"] in [line.split() for line in text.splitlines()]


def test_pictures_that_cannot_be_kept_are_told_before_the_work(folder, capsys, monkeypatch):
    asked = []
    fake = BENCHES["segmentation"]._replace(measure=lambda options, steps: asked.append(options))
    monkeypatch.setitem(BENCHES, "segmentation", fake)
    (folder / "file").write_text("")
    words = ["bench", "segmentation", "--photos", str(folder), "--pictures", str(folder / "file")]
    assert main(words) == 2
    assert "file: File exists" in capsys.readouterr().err
    assert asked == []


@pytest.mark.slow
def test_the_command_on_real_photos(shared_data, capsys, tmp_path):
    photos = shared_data / "real_photos" / "labelled"
    if not photos.is_dir():
        pytest.skip("no real photos here")
    assert main(["bench", "segmentation", "--photos", str(photos), "--pictures", str(tmp_path)]) == 0
    assert "thermal" in capsys.readouterr().out
    assert len(list(tmp_path.glob("*/*.png"))) == len(list(photos.glob("*/photos/*")))
