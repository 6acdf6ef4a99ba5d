"""Before any work: what a run lacks, and what does not belong together, is said in one line."""

import csv
import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from lodbench.cli import main
from lodbench.datasets.folder import FolderParams, open_folder, sealed_about
from lodbench.datasets.inputs import Input
from lodbench.datasets.pose_text import format_pose, lines_to_text, read_poses
from lodbench.errors import ConfigError, DatasetError
from lodbench.harness import RunSettings, run_method
from lodbench.harness.runs.requirements import needs_segmenter, require_run_inputs
from lodbench.methods import Estimate
from lodbench.segmentation.masks import MaskFiles, MasksParams, NoMask, NoMaskParams
from lodbench.segmentation.oracle import NoisyOracle, NoisyOracleParams, Oracle, OracleParams
from lodbench.segmentation.protocol import masks_digest
from tests.town import CAMERA, write_dataset

MASKS, NONE = MaskFiles(MasksParams()), NoMask(NoMaskParams())


@dataclass
class Asking:
    requires: object
    name: str = "asking"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> tuple[Path, Path]:
    return write_dataset(tmp_path_factory.mktemp("town"), count=1)


@pytest.fixture(scope="module")
def dataset(folder):
    return open_folder(FolderParams(str(folder[0]), str(folder[1])))


@pytest.mark.parametrize(
    ("requires", "word"),
    [
        ({"image"}, "method=asking needs photos, and the dataset has none"),
        ({"references"}, "needs posed pictures of the place"),
        ({"textured_map", "references"}, "posed pictures of the place and a textured map"),
        ({"instances"}, "needs a mask of each building, and segmenter=masks makes none"),
    ],
)
def test_what_is_missing_is_reported(dataset, requires, word):
    with pytest.raises(DatasetError, match=word) as caught:
        require_run_inputs(Asking(requires), MASKS, dataset, dataset.entries)
    assert caught.value.hint


@pytest.mark.parametrize("requires", [set(), {"mask"}, {"tilt", "height", "map"}, {Input.MASK, Input.TILT}])
def test_what_is_there_is_enough(dataset, requires):
    require_run_inputs(Asking(requires), MASKS, dataset, dataset.entries)


@pytest.mark.parametrize("part", ["tilt", "height"])
def test_an_assumed_prior_is_not_a_measured_one(dataset, part):
    assumed = replace(dataset, assumed=frozenset({part}))
    with pytest.raises(DatasetError, match=f"a measured .*{'roll' if part == 'tilt' else 'height'}"):
        require_run_inputs(Asking({part}), MASKS, assumed, dataset.entries)
    require_run_inputs(Asking({"mask"}), MASKS, assumed, dataset.entries)


def test_a_method_without_masks_has_no_use_for_a_segmenter(dataset):
    bare = replace(dataset, entries=tuple(replace(entry, mask=None) for entry in dataset.entries))
    require_run_inputs(Asking(()), MASKS, bare, bare.entries)
    require_run_inputs(Asking(()), NONE, bare, bare.entries)
    for segmenter, word in ((MASKS, "segmenter=masks needs masks"), (NONE, "segmenter=none makes none")):
        with pytest.raises(DatasetError, match=word):
            require_run_inputs(Asking({"mask"}), segmenter, bare, bare.entries)


def test_one_that_declares_nothing_looks_at_masks():
    assert needs_segmenter(object())


def test_an_input_nobody_knows(dataset):
    with pytest.raises(ConfigError, match="asking says requires 'masks', which is no input") as caught:
        require_run_inputs(Asking({"masks"}), MASKS, dataset, dataset.entries)
    assert "mask" in caught.value.hint


def words(root: Path, city: Path, runs: Path, *more: str) -> list[str]:
    place = [f"dataset.root={root}", f"dataset.city_model={city}", f"paths.runs={runs}"]
    return ["run", "dataset=folder", *place, *more]


def test_the_prior_alone_needs_no_masks(folder, tmp_path, capsys):
    root = tmp_path / "data"
    shutil.copytree(folder[0], root)
    shutil.rmtree(root / "masks")
    assert main(words(root, folder[1], tmp_path / "runs", "method=prior_only")) == 0
    reported = capsys.readouterr().out
    # No word of what makes masks, but in the title, which is the protocol.
    assert reported.count("segmenter=") == 1
    (table,) = (tmp_path / "runs").rglob("queries.csv")
    assert [row["failure"] for row in csv.DictReader(table.open())] == [""]
    assert main(words(root, folder[1], tmp_path / "runs", "method=lodlocv2", "segmenter=none")) == 2
    assert "method=lodlocv2 needs masks, and segmenter=none makes none" in capsys.readouterr().err


@pytest.mark.parametrize("setting", ["tilt=sideways", "renderer=crayon", "segmenter=compact"])
def test_nothing_is_read_before_the_settings_are_known_to_be_right(folder, tmp_path, capsys, setting):
    torn = tmp_path / "torn.obj"
    torn.write_text("f 1 2 3\n")
    assert main(words(folder[0], torn, tmp_path / "runs", setting)) == 2
    reported = capsys.readouterr().err
    assert setting.split("=")[1] in reported
    assert "torn.obj" not in reported
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("requires", "segmenter", "is_reported"),
    [
        ({"true_pixels"}, NONE, True),
        ({"mask"}, type("Mine", (Oracle,), {})(OracleParams("mine")), True),
        (set(), Oracle(OracleParams()), False),
        ({"mask"}, MASKS, False),
    ],
)
def test_a_run_says_that_its_method_was_shown_the_truth(dataset, tmp_path, requires, segmenter, is_reported):
    method = Looking()
    method.requires = frozenset(requires)
    done = run_method(method, dataset, segmenter, RunSettings(tmp_path, {"method": {"name": "looking"}}))
    assert ("truth" in done.inputs) == is_reported


class Looking:
    name = "looking"

    def localize(self, query, city_map, streams):
        return Estimate(query.prior)


@dataclass(frozen=True)
class BrightParams:
    name: str = "bright"
    threshold: int = 128
    weights: str | None = None


class Bright(MaskFiles):
    def fingerprint(self, entries):
        return "the photos"


def test_masks_of_other_settings_are_other_masks(dataset):
    def reported(segmenter):
        return masks_digest(segmenter, dataset.entries)

    first = reported(Bright(BrightParams()))
    assert first not in (reported(Bright(BrightParams(threshold=64))), "the photos")
    assert first == reported(Bright(BrightParams(weights="elsewhere")))
    assert reported(NoisyOracle(NoisyOracleParams())) != reported(NoisyOracle(NoisyOracleParams(iou=0.54)))
    # What says it all stays as it is in the runs and the leaderboard that there are.
    assert reported(MASKS) == MASKS.fingerprint(dataset.entries)
    assert reported(NONE) == ""


RUN = ("method=contour_alignment", "executor.threads=1")


def run(capsys, tmp_path: Path, root: Path, city: Path, *words: str) -> tuple[int, str, str]:
    code = main(
        ["run", "dataset=folder", f"dataset.root={root}", f"dataset.city_model={city}",
         f"paths.runs={tmp_path / 'runs'}", *RUN, *words]
    )  # fmt: skip
    reported = capsys.readouterr()
    return code, reported.out, reported.err


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


def test_another_reference_system_than_the_city_s_is_reported(capsys, tmp_path, shared_data):
    root, _ = write_dataset(tmp_path / "town")
    (root / "dataset.json").write_text(json.dumps({"crs": "EPSG:25832"}))
    city = shared_data / "city/plateau/53395404_bldg_6697_op.gml"
    code, _, err = run(capsys, tmp_path, root, city)
    assert code == 2
    assert "are in EPSG:25832, the city model" in err
    assert "is in EPSG:6677+6695" in err


@pytest.mark.parametrize(("size", "code"), [((160, 120), 0), ((160, 160), 2)])
def test_masks_of_another_aspect_are_refused_and_of_another_size_reported(
    capsys, caplog, tmp_path, size, code
):
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
