"""Plug-ins: what check-plugin says of them; broken ones end no run without a word, and no run for ever."""

import json
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lodbench.cli import main
from lodbench.datasets.faults import KEY_TWICE
from lodbench.errors import ConfigError, DatasetError, QueryFault
from lodbench.evaluation.metrics import queries_csv
from lodbench.harness import RunSettings, run_method
from lodbench.harness.conformance.data import export_rules, metric_rules
from lodbench.harness.conformance.pictures import segmenter_rules
from lodbench.harness.conformance.trial import Tried, check_in_order, trial_dataset
from lodbench.harness.dataset_check import check_dataset
from lodbench.harness.runs.gallery import write_overlays
from lodbench.methods import Estimate
from lodbench.plugins import load_plugin, plugin_names
from lodbench.segmentation.masks import MaskFiles, NoMask, NoMaskParams
from lodbench.storage import write_text
from tests.harness.scripted import NAMES, Batched, Flying, Preparing, Scripted, failures, run


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trial")
    return folder, *trial_dataset(folder)


def faults(rules, part, trial, tmp_path):
    _, scene, dataset = trial
    tried = Tried(part, "part", {}, part, tmp_path, scene, dataset, None)
    return [f"{check.name}: {check.detail}" for check in check_in_order(rules(tried)) if check.status != "ok"]


def test_where_a_plug_in_raised_is_kept():
    def rule() -> str:
        raise KeyError("oh")

    (check,) = check_in_order([("rule", rule)])
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

    def test_one_that_exits_is_reported(self, trial, tmp_path):
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


def test_a_metric_that_takes_another_number_s_name_is_reported(trial, tmp_path):
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


pytestmark = pytest.mark.usefixtures("own_cache")


@pytest.mark.parametrize("answer", [ZeroDivisionError("no pixels"), None, "mask", np.ones(7)])
def test_a_picture_without_its_mask_ends_no_run(dataset, tmp_path, answer):
    class Odd(NoMask):
        provides = frozenset({"mask"})

        def segment(self, entry):
            if isinstance(answer, Exception):
                raise answer
            return answer

    class Masked(Scripted):
        requires = frozenset({"mask"})

    settings = RunSettings(tmp_path / "runs", {"method": {"name": "scripted"}}, threads=1, limit=1)
    done = run_method(Masked(), dataset, Odd(NoMaskParams()), settings)
    assert all(failures(done))
    assert [path.suffix for path in write_overlays(done, done.preparation, lambda: done.scorer)] == [".png"]


NAN, FLAT = float("nan"), np.eye(6)


@pytest.mark.parametrize(
    ("odd", "word"),
    [
        ({"probability": NAN}, "the probability is nan"),
        ({"probability": 1.5}, "the probability is 1.5"),
        ({"covariance": np.eye(3)}, "of shape (3, 3)"),
        ({"covariance": FLAT * NAN}, "the covariance is not finite"),
        ({"covariance": FLAT + np.eye(6, k=1)}, "not symmetric"),
        ({"covariance": -FLAT}, "a negative eigenvalue"),
        ({"trace": {"search": (0.5, NAN)}}, "trace holds a number that is not finite"),
        ({"notes": "one text"}, "the notes are no tuple of texts"),
        ({"notes": (1,)}, "the notes are no tuple of texts"),
    ],
)
def test_an_estimate_that_cannot_be_stored_is_its_query_s_fault(dataset, tmp_path, odd, word):
    class Odd(Scripted):
        def localize(self, query, city_map, streams):
            return replace(super().localize(query, city_map, streams), **odd)

    for failure in failures(run(Odd(), dataset, tmp_path, limit=1)):
        assert failure.startswith("ValueError: ")
        assert word in failure


def test_an_alternative_that_is_no_pose_is_its_query_s_fault(dataset, tmp_path):
    class Odd(Scripted):
        def localize(self, query, city_map, streams):
            nowhere = replace(query.prior, translation=np.full(3, NAN))
            return Estimate(query.prior, 1.0, alternatives=(nowhere,))

    assert failures(run(Odd(), dataset, tmp_path, limit=1)) == [
        "A pose matrix has values that are not finite"
    ]


def test_rounding_in_a_covariance_is_no_fault(dataset, tmp_path):
    class Noisy(Scripted):
        def localize(self, query, city_map, streams):
            noisy = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1e-12]) + 1e-12 * np.eye(6, k=1)
            return Estimate(query.prior, 1.0, covariance=noisy, notes=["told"], seconds={"x": np.float32(0)})

    (found,) = run(Noisy(), dataset, tmp_path, limit=1).predictions.values()
    assert (found.failure, len(found.covariance), found.notes) == ("", 21, ("told",))


def test_two_queries_of_one_name_are_reported_before_any_work(dataset, tmp_path):
    double = replace(dataset, entries=(*dataset.entries, dataset.entries[0]))
    key = dataset.entries[0].key
    with pytest.raises(DatasetError, match=f"has several queries {key}"):
        run(Scripted(), double, tmp_path, limit=1)
    assert not (tmp_path / "runs").exists()
    found = check_dataset(double, with_pixels=False).findings
    assert [each.object_id for each in found.items if each.code is KEY_TWICE] == [key]


def test_a_plug_in_that_leaves_the_working_folder_moves_no_run(dataset, tmp_path, monkeypatch):
    class Moving(Preparing):
        def prepare(self, city_map, references, workspace):
            super().prepare(city_map, references, workspace)
            os.chdir("/")

        def localize(self, query, city_map, streams):
            os.chdir("/")
            return super().localize(query, city_map, streams)

    monkeypatch.chdir(tmp_path)
    settings = RunSettings(Path("runs"), {"method": {"name": "scripted"}}, threads=1, limit=1)
    done = run_method(Moving(), dataset, NoMask(NoMaskParams()), settings)
    assert (failures(done), Path.cwd()) == ([""], tmp_path)
    assert (tmp_path / done.folder / "predictions.jsonl").is_file()


def test_a_text_that_is_no_utf_8_is_written_all_the_same(dataset, tmp_path):
    done = run(Scripted({NAMES[0]: OSError("gone: \udcff")}), dataset, tmp_path)
    assert failures(done) == ["OSError: gone: \\udcff", "", ""]
    assert "\\udcff" in queries_csv(done.queries)
    (kept,) = (done.folder / "tracebacks").iterdir()
    assert "OSError: gone: \\udcff" in kept.read_text(encoding="utf-8")


def test_a_reason_with_a_carriage_return_leaves_a_run_that_can_be_read(dataset, tmp_path):
    """Progress bars and other systems' programs write them; to a reader of CSV they end a row."""
    done = run(Scripted({NAMES[0]: OSError("10 %\rgone")}), dataset, tmp_path)
    (tmp_path / "queries.csv").write_text(queries_csv(done.queries), newline="")
    read = pd.read_csv(tmp_path / "queries.csv", keep_default_na=False)
    assert list(read["failure"]) == list(done.queries["failure"]) == ["OSError: 10 %\ngone", "", ""]


@pytest.mark.parametrize("kind", [Scripted, Batched])
def test_a_plug_in_that_exits_ends_no_run(dataset, tmp_path, kind):
    done = run(kind({NAMES[1]: SystemExit(0)}), dataset, tmp_path)
    assert failures(done) == ["", "SystemExit: 0", ""]


def test_a_flight_that_exits_is_its_photos_fault(dataset, tmp_path):
    class Leaving(Flying):
        def localize_flight(self, queries, city_map, streams):
            raise SystemExit

    assert failures(run(Leaving(), dataset, tmp_path)) == ["SystemExit"] * 3


def test_a_preparation_that_exits_is_reported(dataset, tmp_path):
    class Leaving(Preparing):
        def prepare(self, city_map, references, workspace):
            raise SystemExit(3)

    with pytest.raises(ConfigError, match="cannot prepare: SystemExit: 3"):
        run(Leaving(), dataset, tmp_path)


@pytest.mark.parametrize("findings", [{"heights": np.ones(3)}, {1: 0, "one": 1}])
def test_findings_that_are_no_json_are_their_flight_s_fault(dataset, tmp_path, findings):
    class Odd(Flying):
        def localize_flight(self, queries, city_map, streams):
            return replace(super().localize_flight(queries, city_map, streams), findings=findings)

    done = run(Odd(), dataset, tmp_path)
    assert {failure[:47] for failure in failures(done)} == {"TypeError: findings of a flight are no JSON val"}
    assert list((done.folder / "tracebacks").iterdir())
    assert not (done.folder / "flights").exists()
