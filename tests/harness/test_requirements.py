"""What a run lacks is told in one line before any work; what it does not need is not asked for."""

import csv
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from lodbench.cli import main
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.inputs import Input
from lodbench.errors import ConfigError, DatasetError
from lodbench.harness import RunSettings, run_method
from lodbench.harness.runs.requirements import needs_segmenter, require_run_inputs
from lodbench.methods import Estimate
from lodbench.segmentation.masks import MaskFiles, MasksParams, NoMask, NoMaskParams
from lodbench.segmentation.oracle import NoisyOracle, NoisyOracleParams, Oracle, OracleParams
from lodbench.segmentation.protocol import masks_digest
from tests.town import write_dataset

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
def test_what_is_missing_is_told(dataset, requires, word):
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
    told = capsys.readouterr().out
    # No word of what makes masks, but in the title, which is the protocol.
    assert told.count("segmenter=") == 1
    (table,) = (tmp_path / "runs").rglob("queries.csv")
    assert [row["failure"] for row in csv.DictReader(table.open())] == [""]
    assert main(words(root, folder[1], tmp_path / "runs", "method=lodlocv2", "segmenter=none")) == 2
    assert "method=lodlocv2 needs masks, and segmenter=none makes none" in capsys.readouterr().err


@pytest.mark.parametrize("setting", ["tilt=sideways", "renderer=crayon", "segmenter=compact"])
def test_nothing_is_read_before_the_settings_are_known_to_be_right(folder, tmp_path, capsys, setting):
    torn = tmp_path / "torn.obj"
    torn.write_text("f 1 2 3\n")
    assert main(words(folder[0], torn, tmp_path / "runs", setting)) == 2
    told = capsys.readouterr().err
    assert setting.split("=")[1] in told
    assert "torn.obj" not in told
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("requires", "segmenter", "is_told"),
    [
        ({"true_pixels"}, NONE, True),
        ({"mask"}, type("Mine", (Oracle,), {})(OracleParams("mine")), True),
        (set(), Oracle(OracleParams()), False),
        ({"mask"}, MASKS, False),
    ],
)
def test_a_run_says_that_its_method_was_shown_the_truth(dataset, tmp_path, requires, segmenter, is_told):
    method = Looking()
    method.requires = frozenset(requires)
    done = run_method(method, dataset, segmenter, RunSettings(tmp_path, {"method": {"name": "looking"}}))
    assert ("truth" in done.inputs) == is_told


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
    def told(segmenter):
        return masks_digest(segmenter, dataset.entries)

    first = told(Bright(BrightParams()))
    assert first not in (told(Bright(BrightParams(threshold=64))), "the photos")
    assert first == told(Bright(BrightParams(weights="elsewhere")))
    assert told(NoisyOracle(NoisyOracleParams())) != told(NoisyOracle(NoisyOracleParams(iou=0.54)))
    # What says it all stays as it is in the runs and the leaderboard that there are.
    assert told(MASKS) == MASKS.fingerprint(dataset.entries)
    assert told(NONE) == ""
