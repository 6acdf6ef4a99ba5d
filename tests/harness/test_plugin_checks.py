"""What check-plugin says of segmenters and export formats: sound ones pass, each broken rule is named."""

import json
import sys
from dataclasses import dataclass

import numpy as np
import pytest

from lodbench.cli import main
from lodbench.errors import QueryFault
from lodbench.harness.conformance.data import export_rules, metric_rules
from lodbench.harness.conformance.pictures import segmenter_rules
from lodbench.harness.conformance.trial import Tried, check_rules, trial_dataset
from lodbench.plugins import load_plugin, plugin_names
from lodbench.segmentation.masks import MaskFiles
from lodbench.storage import write_text


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trial")
    return folder, *trial_dataset(folder)


def faults(rules, part, trial, tmp_path):
    _, scene, dataset = trial
    tried = Tried(part, "part", {}, part, tmp_path, scene, dataset, None)
    return [f"{check.name}: {check.detail}" for check in check_rules(rules(tried)) if check.status != "ok"]


def test_where_a_plug_in_raised_is_kept():
    def rule() -> str:
        raise KeyError("oh")

    (check,) = check_rules([("rule", rule)])
    assert (check.detail, check.hint) == ("KeyError: 'oh'", "Its traceback is below.")
    assert 'raise KeyError("oh")' in check.traceback


class Halves:
    """Takes both halves of a photo for a building each."""

    name = "halves"
    provides = frozenset({"instances"})

    def segment_instances(self, entry):
        if entry.image is None:
            raise QueryFault("no photo")
        masks = np.zeros((2, 115, 155), bool)
        masks[0, :, :77], masks[1, :, 77:] = True, True
        return masks

    def fingerprint(self, entries):
        return "halves"


class Guided:
    """Returns the map's silhouette at the pose it is asked from."""

    name = "guided"
    requires = frozenset({"map"})

    def segment_from(self, entry, pose, city_map):
        return city_map.render(entry.camera, pose).astype(np.float32)

    def segment(self, entry):
        raise QueryFault("guided by the map only")

    def fingerprint(self, entries):
        return "guided"


class TestSegmenters:
    @pytest.mark.parametrize("part", [Halves, Guided])
    def test_sound_ones_pass(self, part, trial, tmp_path):
        assert faults(segmenter_rules, part, trial, tmp_path) == []

    def test_one_that_exits_is_told(self, trial, tmp_path):
        class Leaving(Halves):
            def segment_instances(self, entry):
                raise SystemExit(0)

        (fault,) = faults(segmenter_rules, Leaving, trial, tmp_path)
        assert "SystemExit: 0" in fault

    def test_each_output_has_its_member(self, trial, tmp_path):
        class Silent(Halves):
            provides = frozenset({"mask"})

        (fault,) = faults(segmenter_rules, Silent, trial, tmp_path)
        assert "mask declared, but there is no segment" in fault

        class Photos(Halves):
            provides = frozenset({"image"})

        (fault,) = faults(segmenter_rules, Photos, trial, tmp_path)
        assert "which no segmenter makes" in fault

    def test_instances_are_bool_and_of_the_photos_aspect(self, trial, tmp_path):
        class Counts(Halves):
            def segment_instances(self, entry):
                return super().segment_instances(entry).astype(np.int32)

        (fault,) = faults(segmenter_rules, Counts, trial, tmp_path)
        assert "int32" in fault

        class Square(Halves):
            def segment_instances(self, entry):
                return np.zeros((1, 50, 50), bool)

        (fault,) = faults(segmenter_rules, Square, trial, tmp_path)
        assert "another aspect" in fault

    def test_instances_come_out_the_same_again(self, trial, tmp_path):
        class Dice(Halves):
            made = np.random.default_rng(0)

            def segment_instances(self, entry):
                return self.made.random((1, 115, 155)) < 0.5

        (fault,) = faults(segmenter_rules, Dice, trial, tmp_path)
        assert fault.startswith("same again")


@dataclass
class Names:
    """Writes the names of the poses."""

    file_name: str = "names.txt"
    requires: tuple[str, ...] = ()

    def write(self, export, path):
        write_text(path, "\n".join(each.name for each in export.poses()))


class TestExportFormats:
    # A submission is what a benchmark of its own takes: the trial's dataset has none.
    @pytest.mark.parametrize(
        "name", sorted({*plugin_names("export_formats")} - {"rerun", "parquet", "submission"})
    )
    def test_ours_pass(self, name, trial, tmp_path):
        assert faults(export_rules, load_plugin("export_formats", name), trial, tmp_path) == []

    def test_what_is_broken_is_named(self, trial, tmp_path):
        class Elsewhere(Names):
            def write(self, export, path):
                write_text(path.with_name("other.txt"), "")

        class Counting(Names):
            count = 0

            def write(self, export, path):
                Counting.count += 1
                write_text(path, str(Counting.count))

        class Greedy(Names):
            requires = ("weather",)

            def __init__(self):
                pass

        for part, words in (
            (Elsewhere, "nothing was written"),
            (Counting, "other bytes"),
            (Greedy, "requires weather"),
        ):
            (fault,) = faults(export_rules, part, trial, tmp_path / part.__name__)
            assert words in fault
        assert faults(export_rules, Names, trial, tmp_path / "sound") == []


def test_a_metric_that_takes_another_number_s_name_is_told(trial, tmp_path):
    (fault,) = faults(metric_rules, lambda queries: {"2m-2deg": 100.0}, trial, tmp_path)
    assert "2m-2deg" in fault


class TestCommand:
    def test_what_a_plug_in_prints_is_no_line_of_the_report(self, capsys, monkeypatch):
        segment = MaskFiles.segment

        def talking(self, entry):
            sys.stdout.write("hello\n")
            return segment(self, entry)

        monkeypatch.setattr(MaskFiles, "segment", talking)
        assert main(["check-plugin", "segmenter", "masks", "--json"]) == 0
        printed = capsys.readouterr()
        assert all(json.loads(line)["status"] == "ok" for line in printed.out.splitlines())
        assert "hello" in printed.err
