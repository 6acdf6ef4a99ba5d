"""A method's life in a run: prepared once, alone or in batches; faults retried; finished runs kept."""

import os
import re
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from lodbench.cli import main
from lodbench.cli.run import _failure_lines
from lodbench.datasets.query import Query
from lodbench.errors import ConfigError, LodbenchError, QueryFault
from lodbench.execution.executor import ExecutorParams
from lodbench.harness import RunSettings, run_method
from lodbench.harness.runs import gallery, predict
from lodbench.harness.runs.gallery import write_overlays
from lodbench.harness.runs.predict import _open_here
from lodbench.methods import Estimate
from lodbench.methods.protocol import FlightEstimate
from lodbench.segmentation import notes_of
from lodbench.segmentation.masks import MaskFiles, MasksParams
from tests.harness.scripted import NAMES, Batched, Flying, Preparing, Scripted, failures, run
from tests.town import write_dataset

pytestmark = pytest.mark.usefixtures("own_cache")


def test_the_map_counts_and_the_clock_is_the_harness_s(dataset, tmp_path):
    rows = run(Scripted(), dataset, tmp_path).predictions.values()
    assert [row.hypotheses for row in rows] == [1, 1, 1]
    assert all(set(row.seconds) == {"prepare", "localize"} for row in rows)


def test_a_fault_of_the_code_is_its_query_s(dataset, tmp_path):
    done = run(Scripted({NAMES[1]: ZeroDivisionError("no pixels")}), dataset, tmp_path)
    assert failures(done) == ["", "ZeroDivisionError: no pixels", ""]
    (kept,) = (done.folder / "tracebacks").iterdir()
    assert NAMES[1] in kept.name
    assert "in localize" in kept.read_text()
    # It is on the screen too, once for each reason.
    reported = "\n".join(_failure_lines(done))
    assert f"1 x ZeroDivisionError: no pixels: {done.queries.index[1]}" in reported
    assert reported.count("Traceback (most recent call last)") == 1
    assert "in localize" in reported


@pytest.mark.parametrize(
    ("odd", "word"),
    [(Estimate(None, 1.0), "AttributeError"), (7, "TypeError: localize returned int instead of an Estimate")],
)
def test_an_odd_answer_is_no_answer(dataset, tmp_path, odd, word):
    class Odd(Scripted):
        def localize(self, query, city_map, streams):
            return odd if query.name == NAMES[0] else super().localize(query, city_map, streams)

    first, *others = failures(run(Odd(), dataset, tmp_path))
    assert first.startswith(word)
    assert others == ["", ""]


def test_wrong_settings_end_the_run_and_leave_nothing(dataset, tmp_path):
    with pytest.raises(ConfigError, match="no such layer"):
        run(Scripted({NAMES[0]: ConfigError("no such layer")}), dataset, tmp_path)
    assert not list((tmp_path / "runs").rglob("*.jsonl"))
    assert not (tmp_path / "runs" / "folder").exists()


def test_only_failed_queries_are_retried(dataset, tmp_path):
    run(Scripted({NAMES[1]: QueryFault("no luck")}), dataset, tmp_path)
    again, retried = Scripted(), Scripted()
    assert failures(run(again, dataset, tmp_path)) == ["", "no luck", ""]
    assert again.asked == []
    assert failures(run(retried, dataset, tmp_path, retries_failed=True)) == ["", "", ""]
    assert retried.asked == [NAMES[1]]
    assert failures(run(again, dataset, tmp_path)) == ["", "", ""]


class TestBatches:
    def test_answers_are_those_of_single_queries(self, dataset, tmp_path):
        method = Batched({NAMES[1]: QueryFault("no luck")})
        done = run(method, dataset, tmp_path)
        assert method.batches == [NAMES[:2]]
        assert method.asked == NAMES
        assert failures(done) == ["", "no luck", ""]
        assert [row.hypotheses for row in done.predictions.values()] == [0, 0, 1]

    def test_a_fault_is_found_one_by_one(self, dataset, tmp_path):
        done = run(Batched({NAMES[0]: KeyError("oh")}), dataset, tmp_path)
        assert failures(done) == ["KeyError: 'oh'", "", ""]


class TestPreparation:
    def test_is_made_once_and_handed_on(self, dataset, tmp_path):
        first, second = Preparing(), Preparing()
        assert [row.score for row in run(first, dataset, tmp_path).predictions.values()] == [40.0] * 3
        run(second, dataset, tmp_path, limit=1, seed=1)
        assert (first.made, second.made) == ([".npy"], [])
        assert second.top_m == 40.0

    def test_other_weights_are_another_run_and_prepared_anew(self, dataset, tmp_path):
        folders, made = set(), []
        for content in ("one", "two", "one"):
            weights = tmp_path / "net.onnx"
            weights.write_text(content)
            method = Preparing(weights=weights)
            folders.add(run(method, dataset, tmp_path).folder)
            made.append(len(method.made))
        assert len(folders) == 2
        assert made == [1, 1, 0]

    def test_missing_weights_are_reported_before_any_work(self, dataset, tmp_path):
        with pytest.raises(ConfigError, match=r"no weights .*gone\.onnx"):
            run(Preparing(weights=tmp_path / "gone.onnx"), dataset, tmp_path)
        assert not (tmp_path / "runs").exists()

    def test_a_fault_ends_the_run_with_its_traceback(self, dataset, tmp_path):
        class Torn(Preparing):
            def prepare(self, city_map, references, workspace):
                raise IndexError("out of views")

        with pytest.raises(ConfigError, match="cannot prepare: IndexError: out of views") as caught:
            run(Torn(), dataset, tmp_path)
        file = Path(caught.value.hint.removeprefix("See ").rstrip("."))
        assert "raise IndexError" in file.read_text()


class Guided:
    """Shows the map's silhouette from wherever it is asked to look."""

    name, requires = "guided", frozenset({"map"})

    def segment(self, entry):
        raise AssertionError("runs ask segment_from")

    def segment_from(self, entry, pose, city_map):
        return city_map.render(entry.camera, pose).astype(np.float32)

    def segment_instances(self, entry):
        masks = np.zeros((2, entry.camera.height, entry.camera.width), bool)
        masks[0, :10] = masks[1, 10:] = True
        return masks

    def fingerprint(self, entries):
        return ""


class Looking(Scripted):
    """Looks at the mask from the prior, and again from a pose a metre away."""

    requires = frozenset({"mask"})

    def localize(self, query, city_map, streams):
        moved = query.prior.shifted([1.0, 0.0, 0.0])
        first, second = city_map.render(query.camera, query.prior), city_map.render(query.camera, moved)
        assert np.array_equal(query.mask, first)
        assert np.array_equal(query.segment(moved), second)
        assert not np.array_equal(first, second)
        return Estimate(moved, 1.0)


class TestSegmenters:
    def settings(self, method, tmp_path):
        return RunSettings(tmp_path / "runs", {"method": {"name": method.name}}, threads=1)

    def test_a_mask_is_asked_for_again_from_a_better_pose(self, dataset, tmp_path):
        done = run_method(Looking(), dataset, Guided(), self.settings(Looking(), tmp_path))
        assert failures(done) == ["", "", ""]
        # Two of the method's own, one of the segmenter within localize; that of the prior's mask is free.
        assert [row.hypotheses for row in done.predictions.values()] == [3, 3, 3]
        assert notes_of(done.preparation.segmenter) == ("segmenter guided: guided by the map from the prior",)

    def test_others_are_not_offered_another_look(self, dataset, tmp_path):
        class Once(Looking):
            def localize(self, query, city_map, streams):
                assert query.segment is None
                return Estimate(query.prior, 1.0)

        done = run_method(Once(), dataset, MaskFiles(MasksParams()), self.settings(Once(), tmp_path))
        assert failures(done) == ["", "", ""]

    def test_instances_are_for_who_requires_them(self, dataset, tmp_path):
        class Counting(Scripted):
            requires = frozenset({"instances"})

            def localize(self, query, city_map, streams):
                assert query.building_probability is None
                return Estimate(query.prior, float(len(query.instances)))

        Guided.provides = frozenset({"mask", "instances"})
        done = run_method(Counting(), dataset, Guided(), self.settings(Counting(), tmp_path))
        assert [row.score for row in done.predictions.values()] == [2.0, 2.0, 2.0]

    def test_an_oracle_has_one_renderer(self, dataset, tmp_path, monkeypatch):
        from lodbench.harness.runs import queries
        from lodbench.segmentation.oracle import NoisyOracle, NoisyOracleParams

        made = []

        class Noted(queries.SilhouetteRenderer):
            def __init__(self, *args, **settings):
                made.append(1)
                super().__init__(*args, **settings)

        monkeypatch.setattr(queries, "SilhouetteRenderer", Noted)
        oracle, settings = NoisyOracle(NoisyOracleParams()), self.settings(Looking(), tmp_path)
        Once = type("Once", (Scripted,), {"requires": frozenset({"mask"})})
        Once.localize = lambda self, query, city_map, streams: Estimate(query.prior, query.mask.mean())
        done = run_method(Once(), dataset, oracle, settings)
        assert failures(done) == ["", "", ""]
        assert made == [1]


def test_no_picture_of_an_answer_s_earlier_place_is_left(dataset, tmp_path):
    first = run(Scripted(), dataset, tmp_path / "before").queries["translation_error_m"].idxmin()
    failing = Scripted({first.rpartition("/")[2]: QueryFault("not yet")})
    for more, method in (({}, failing), ({"retries_failed": True}, Scripted())):
        done = run(method, dataset, tmp_path, **more)
        written = write_overlays(done, done.preparation, lambda done=done: done.scorer)
        assert sorted((done.folder / "overlays").iterdir()) == sorted(written)
    assert len(written) == 3


def test_the_command_tells_that_nothing_was_found(dataset, tmp_path, capsys):
    root, city = write_dataset(tmp_path / "bare", count=2)
    (root / "GPS_pose.txt").write_text("# none\n")
    place = [f"dataset.root={root}", f"dataset.city_model={city}", f"paths.runs={tmp_path / 'runs'}"]
    assert main(["run", "dataset=folder", *place, "method=prior_only"]) == 1
    assert "2 x no prior pose" in capsys.readouterr().out


def test_the_command_retries(dataset, tmp_path, capsys):
    place = [f"dataset.root={dataset.root}", f"dataset.city_model={dataset.city_model}"]
    words = ["run", "dataset=folder", *place, f"paths.runs={tmp_path / 'runs'}", "method=prior_only"]
    assert main(words) == 0
    assert main([*words, "--retry-failed"]) == 0
    assert "(3 queries were there already)" in capsys.readouterr().out


def test_a_query_without_a_mask_says_so_to_whom_it_concerns(dataset):
    entry = dataset.entries[0]
    with pytest.raises(QueryFault, match="there is no mask"):
        _ = Query(entry.name, "all", entry.camera, entry.prior).mask


def test_flights_are_asked_whole_and_what_they_say_is_kept(dataset, tmp_path):
    entries = tuple(
        replace(entry, sequence="../west" if entry.name == NAMES[0] else "east") for entry in dataset.entries
    )
    flown = replace(dataset, entries=entries)
    method = Flying()
    done = run(method, flown, tmp_path)
    assert method.flights == [[NAMES[0]], NAMES[1:]]
    assert [found.pose is not None for found in done.predictions.values()] == [True] * 3
    reported = sorted(path.name for path in (done.folder / "flights").iterdir())
    assert reported == [f"{entries[0].split}-..%2Fwest.json", f"{entries[0].split}-east.json"]
    # One photo's line is lost: its whole flight is asked again, the other is not.
    ledger = done.folder / "predictions.jsonl"
    lines = ledger.read_text().splitlines(keepends=True)
    ledger.write_text("".join(line for line in lines if NAMES[2] not in line))
    again = Flying()
    resumed = run(again, flown, tmp_path)
    assert again.flights == [NAMES[1:]]
    assert resumed.predictions.keys() == done.predictions.keys()
    assert len(ledger.read_text().splitlines()) == 3


def test_a_flight_that_breaks_is_each_photo_s_failure(dataset, tmp_path):
    class Breaking(Flying):
        def localize_flight(self, queries, city_map, streams):
            return FlightEstimate([])

    done = run(Breaking(), dataset, tmp_path)
    assert all("FlightEstimate of 3 photos" in reason for reason in failures(done))
    # Where code raised is stated once.
    reported = "\n".join(_failure_lines(done))
    assert reported.count("Traceback") == 1
    assert "FlightEstimate of 3 photos" in reported.splitlines()[-1]


@pytest.mark.attack
def test_a_worker_of_other_code_cannot_begin(dataset, tmp_path, monkeypatch):
    """Its answers would be another version's, under the name of this one's run."""
    sent = []

    @contextmanager
    def here(executor, prepare, prepare_with):
        sent.extend(prepare_with)
        prepare(*prepare_with)
        yield SimpleNamespace(count=1, map=map)

    monkeypatch.setattr("lodbench.harness.runs.predict.open_workers", here)
    assert failures(run(Scripted(), dataset, tmp_path, executor=ExecutorParams("dask"))) == ["", "", ""]
    with pytest.raises(LodbenchError, match="is not the command's"):
        _open_here(replace(sent[0], code=sent[0].code[::-1]))


@pytest.fixture
def words(tmp_path):
    root, city = write_dataset(tmp_path / "data", count=2)
    place = [f"dataset.root={root}", f"dataset.city_model={city}", f"paths.runs={tmp_path / 'runs'}"]
    return ["run", "dataset=folder", *place, "method=prior_only"]


@pytest.fixture
def drawn(monkeypatch):
    """The pictures that are drawn, by name, and how often renderers were warmed up."""
    names, real, warm = [], gallery.overlays.write_picture, predict._warm_up

    def write_picture(path, picture):
        names.append(path.name)
        real(path, picture)

    def warm_up(city_map):
        names.append("warm-up")
        warm(city_map)

    monkeypatch.setattr(gallery.overlays, "write_picture", write_picture)
    monkeypatch.setattr(predict, "_warm_up", warm_up)
    return names


def files_of(folder):
    # Times and provenance are of each command.
    apart = ("provenance.json", "timings.csv")
    kept = [path for path in folder.rglob("*") if path.is_file() and path.name not in apart]
    return {path.relative_to(folder): path.read_bytes() for path in kept}


def test_a_second_time_draws_nothing_and_leaves_the_same_files(words, drawn, tmp_path, capsys):
    assert main(words) == 0
    assert drawn.count("warm-up") == 1
    pictures = sorted(set(drawn) - {"warm-up"})
    assert len(pictures) == 2
    before = files_of(tmp_path / "runs")
    drawn.clear()
    first = capsys.readouterr().out
    assert main(words) == 0
    assert drawn == []
    assert files_of(tmp_path / "runs") == before
    second = re.sub(r" \(\d queries were there already\)", "", capsys.readouterr().out)
    assert second == first


def test_a_picture_that_is_gone_or_older_than_its_photo_or_answers_is_drawn_again(words, drawn, tmp_path):
    assert main(words) == 0
    first, second = sorted((tmp_path / "runs").rglob("overlays/*.png"))
    before = files_of(tmp_path / "runs")
    drawn.clear()
    first.unlink()
    assert main(words) == 0
    assert drawn == [first.name]
    drawn.clear()
    os.utime(second, ns=(1, 1))
    assert main(words) == 0
    assert drawn == [second.name]
    assert files_of(tmp_path / "runs") == before


def test_pictures_are_drawn_again_where_the_rows_differ(words, drawn, tmp_path):
    assert main(words) == 0
    (rows,) = (tmp_path / "runs").rglob("queries.csv")
    rows.write_text(rows.read_text().replace("prior_only", "x").replace("0", "1", 1))
    drawn.clear()
    assert main(words) == 0
    assert len(drawn) == 2
