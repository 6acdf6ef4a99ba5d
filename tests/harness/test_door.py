"""Before any work: city, priors, photos and masks of a run belong together, or one line says why not."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from lodbench.cli import main
from lodbench.datasets.folder import sealed_about
from lodbench.datasets.pose_text import format_pose, lines_to_text, read_poses
from tests.town import CAMERA, write_dataset

RUN = ("method=contour_alignment", "executor.threads=1")


def run(capsys, tmp_path: Path, root: Path, city: Path, *words: str) -> tuple[int, str, str]:
    code = main(
        ["run", "dataset=folder", f"dataset.root={root}", f"dataset.city_model={city}",
         f"paths.runs={tmp_path / 'runs'}", *RUN, *words]
    )  # fmt: skip
    told = capsys.readouterr()
    return code, told.out, told.err


def move_priors(root: Path, names: list[str], east_m: float) -> None:
    priors = read_poses(root / "GPS_pose.txt")
    moved = {name: pose.shifted((east_m, 0, 0)) if name in names else pose for name, pose in priors.items()}
    (root / "GPS_pose.txt").write_text(lines_to_text(format_pose(*item) for item in moved.items()))


def test_a_city_of_another_place_is_named_with_its_distance(capsys, tmp_path):
    root, city = write_dataset(tmp_path / "town")
    move_priors(root, list(read_poses(root / "GPS_pose.txt")), 12_000.0)
    code, _, err = run(capsys, tmp_path, root, city)
    assert code == 2
    assert "All priors lie outside the city model" in err
    assert "11.9 km off" in err
    assert not (tmp_path / "runs").exists()


def test_one_prior_elsewhere_is_its_own_query_s_failure(capsys, tmp_path):
    root, city = write_dataset(tmp_path / "town")
    name = next(iter(read_poses(root / "GPS_pose.txt")))
    move_priors(root, [name], 12_000.0)
    code, out, _ = run(capsys, tmp_path, root, city)
    assert code == 0
    assert "1 x the prior lies 11.9 km outside the city model" in out


def test_another_reference_system_than_the_city_s_is_told(capsys, tmp_path, shared_data):
    root, _ = write_dataset(tmp_path / "town")
    (root / "dataset.json").write_text(json.dumps({"crs": "EPSG:25832"}))
    city = shared_data / "city/plateau/53395404_bldg_6697_op.gml"
    code, _, err = run(capsys, tmp_path, root, city)
    assert code == 2
    assert "are in EPSG:25832, the city model" in err
    assert "is in EPSG:6677+6695" in err


@pytest.mark.parametrize(("size", "code"), [((160, 120), 0), ((160, 160), 2)])
def test_masks_of_another_aspect_are_refused_and_of_another_size_told(capsys, caplog, tmp_path, size, code):
    root, city = write_dataset(tmp_path / "town")
    for path in (root / "masks").iterdir():
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path), 0), size))
    found, _, err = run(capsys, tmp_path, root, city)
    assert found == code
    if code:
        assert "None of 3 queries can be used" in err
        assert "the mask is 160 x 160, the photo 320 x 240: another aspect" in err
    else:
        assert "3 of 3 masks are of another size than their cameras and are scaled" in caplog.text


def photos(root: Path, sizes: list[tuple[int, int]]) -> None:
    (root / "Query_image").mkdir()
    for name, (width, height) in zip(read_poses(root / "GPS_pose.txt"), sizes, strict=True):
        picture = np.full((height, width, 3), 90, np.uint8)
        cv2.imwrite(str(root / "Query_image" / name), picture)


WHOLE, LARGER = (CAMERA.width, CAMERA.height), (4 * CAMERA.width, 4 * CAMERA.height)


@pytest.mark.slow
def test_intrinsics_of_other_photos_are_refused(capsys, tmp_path):
    root, city = write_dataset(tmp_path / "town")
    photos(root, [LARGER] * 3)
    code, _, err = run(capsys, tmp_path, root, city, "method=region")
    assert code == 2
    assert "the photo is 1280 x 960, its intrinsics are of 320 x 240" in err
    # Who looks at masks alone is not concerned.
    assert run(capsys, tmp_path, root, city)[0] == 0


def test_an_unreadable_photo_and_one_of_another_size_fail_by_themselves(capsys, tmp_path):
    root, city = write_dataset(tmp_path / "town")
    photos(root, [LARGER, WHOLE, WHOLE])
    last = sorted((root / "Query_image").iterdir())[-1]
    last.write_bytes(b"no picture")
    _, out, _ = run(capsys, tmp_path, root, city, "method=region")
    assert "1 x the photo is 1280 x 960, its intrinsics are of 320 x 240" in out
    assert f"1 x the photo {last.name} cannot be read" in out


def test_dataset_check_finds_the_same(capsys, tmp_path):
    root, city = write_dataset(tmp_path / "town")
    move_priors(root, ["view_01.png"], 12_000.0)
    cv2.imwrite(str(root / "masks/view_00.png"), np.zeros((50, 50), np.uint8))
    assert main(["dataset", "check", str(root), "--city", str(city), "--json"]) == 1
    found = {item["name"]: item for item in json.loads(capsys.readouterr().out)["findings"]}
    assert found["MASK_UNFIT"]["object"] == "data/view_00.png"
    assert found["PRIOR_FAR"]["object"] == "data/view_01.png"


def test_dataset_check_takes_the_city_that_the_dataset_names_and_hints_in_its_own_words(capsys, tmp_path):
    root, city = write_dataset(tmp_path / "town")
    (root / "dataset.json").write_text(json.dumps(sealed_about({"city_model": "../city.obj"})))
    assert main(["dataset", "check", str(root)]) == 0
    assert str(city) in capsys.readouterr().out
    city.rename(tmp_path / "elsewhere.obj")
    assert main(["dataset", "check", str(root)]) == 1
    assert "Set --city FILE." in capsys.readouterr().out
    assert main(["dataset", "check", str(root), "--city", "nowhere.gml"]) == 2
    assert "--city" in capsys.readouterr().err
