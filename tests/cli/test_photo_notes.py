"""What reads places and heights from photos says how far to believe them, in every command alike."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from lodbench.cli import main
from tests.fault_commands import CRS, prepare_inputs
from tests.flight import stated
from tests.photos.dji_photo import exif_of, write_photo, xmp_packet
from tests.town import CAMERA, true_poses

# Without a height system no height above the ellipsoid can be converted.
NO_HEIGHTS, ELLIPSOID = "EPSG:25832", ("--heights", "ellipsoid")
SAID = "note: --geoid was not used"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A town, a model of three views over it, and photos that state where they were taken."""
    made = prepare_inputs(tmp_path_factory.mktemp("notes"))
    (made / "photos").mkdir()
    for name, pose in true_poses(3).items():
        pixels = np.full((CAMERA.height, CAMERA.width), 90, np.uint8)
        write_photo(made / "photos" / name, pixels, exif_of(), xmp_packet(stated(pose, CAMERA, CRS)))
    return made


CASES = {
    "init": "dataset init {out} --images {in}/photos",
    "import": "dataset import colmap {in}/model {out} --images {in}/photos",
    "georeference": "georeference {in}/model --images {in}/photos --masks {in}/three/data/masks --out {out}",
    "track": "track {in}/photos --masks {in}/three/data/masks --out {out}",
}


@pytest.mark.parametrize("words", CASES.values(), ids=CASES)
def test_a_geoid_that_was_not_used_is_told(folder, capsys, tmp_path, words):
    given = f"{words} --city {{in}}/three/city.obj --crs {CRS} --geoid 46"
    code = main([word.format(**{"in": folder, "out": tmp_path / "out"}) for word in given.split()])
    told = capsys.readouterr()
    assert code in (0, 3), told.err
    assert SAID in told.out


def test_photos_that_state_no_rough_pose_are_told(folder, capsys, tmp_path):
    words = ["dataset", "import", "colmap", str(folder / "model"), str(tmp_path / "own")]
    words += [
        "--images",
        str(folder / "photos"),
        "--city",
        str(folder / "three/city.obj"),
        "--crs",
        NO_HEIGHTS,
    ]
    assert main([*words, "--heights", "ellipsoid"]) == 0
    (note,) = [line for line in capsys.readouterr().out.splitlines() if "note:" in line]
    assert "3 of 3 photos state no rough pose; the first, view_00.png: Heights above the ellipsoid" in note


def test_a_model_is_not_placed_for_the_reason_that_its_photos_have(folder, capsys, tmp_path):
    words = [
        "georeference",
        str(folder / "model"),
        "--images",
        str(folder / "photos"),
        "--heights",
        "ellipsoid",
    ]
    words += ["--city", str(folder / "three/city.obj"), "--crs", NO_HEIGHTS, "--out", str(tmp_path / "out")]
    assert main([*words, "--masks", str(folder / "three/data/masks")]) == 2
    said, hint = capsys.readouterr().err.splitlines()
    assert "0 of the model's 3 cameras have a rough place" in said
    assert "Heights above the ellipsoid" in said
    assert "--geoid" in hint


@pytest.mark.attack
def test_what_libjpeg_says_of_a_damaged_photo_does_not_reach_the_terminal(
    folder, lodbench_process, tmp_path, capfd
):
    content = bytearray((folder / "flight" / "DJI_00.JPG").read_bytes())
    content[-300:-290] = bytes(10)
    (tmp_path / "DJI_00.JPG").write_bytes(content)
    assert cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR) is not None
    assert "Corrupt JPEG data" in capfd.readouterr().err
    mask, city = folder / "flight_masks" / "DJI_00.png", folder / "town" / "city.obj"
    done = lodbench_process(
        *("localize", "DJI_00.JPG", "--mask", str(mask), "--city", str(city), "--crs", CRS)
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert (tmp_path / "localized" / "DJI_00_overlay.png").is_file()
    assert "cannot be decoded" not in done.stdout
