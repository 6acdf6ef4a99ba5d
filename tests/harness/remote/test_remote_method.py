"""Methods in another process: the same bytes as in this one; their map, their commands, wrong settings."""

import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lodbench.cli import main
from lodbench.errors import ConfigError, LodbenchError, QueryFault
from lodbench.geometry import Camera
from lodbench.harness.conformance.trial import streams_of
from lodbench.harness.remote import child as child_module
from lodbench.harness.remote.child import RemoteMap
from lodbench.harness.remote.method import RemoteMethod, RunnerParams, answered
from lodbench.harness.remote.process import KINDS, packed
from lodbench.methods import Estimate
from lodbench.methods.localize import localize_query
from lodbench.methods.protocol import Workspace
from lodbench.methods.registry import make_method
from lodbench.rendering import IouFit
from tests.town import write_dataset


def remote(elsewhere: str, **settings) -> RemoteMethod:
    return RemoteMethod({"name": "shake", **settings}, RunnerParams("subprocess", elsewhere))


def bytes_of(estimate: Estimate) -> tuple:
    return (
        estimate.pose.cam_from_world.tobytes(),
        estimate.score,
        estimate.trace,
        estimate.probability,
        None if estimate.covariance is None else estimate.covariance.tobytes(),
        estimate.notes,
        [pose.cam_from_world.tobytes() for pose in estimate.alternatives],
        estimate.hypotheses,
    )


@pytest.mark.parametrize(
    "settings",
    [
        {"name": "lodlocv2", "steps": 3, "coarse_size": [80, 60], "fine_size": [160, 120]},
        pytest.param({"name": "contour_alignment"}, marks=pytest.mark.slow),
    ],
    ids=["lodlocv2", "contour_alignment"],
)
def test_the_answers_are_those_of_this_process_to_the_byte(settings, trial, elsewhere):
    own = make_method(**settings)
    other = RemoteMethod(settings, RunnerParams("subprocess", elsewhere))
    assert (other.name, other.requires) == (own.name, frozenset(own.requires))
    for query in trial.queries[:2]:
        found = [localize_query(m, query, trial.city_map, streams_of(query)) for m in (own, other)]
        assert bytes_of(found[0]) == bytes_of(found[1])
    other.close()


def test_a_method_that_only_the_other_python_has_draws_here(elsewhere, trial):
    method, query = remote(elsewhere, tries=5), trial.queries[1]
    found = localize_query(method, query, trial.city_map, streams_of(query))
    # Five silhouettes, and one view's edges: counted by the map here.
    assert found.hypotheses == 6
    moves = streams_of(query)("moves", 0).normal(scale=3.0, size=(5, 3))
    assert any(np.array_equal(found.pose.center, query.prior.shifted(m).center) for m in moves)
    edges, buildings = found.trace["edges"]
    assert edges > 10
    assert buildings == 7
    nowhere = replace(query, building_probability=None)
    with pytest.raises(QueryFault, match=r"^there is no mask$"):
        method.localize(nowhere, trial.city_map, streams_of(query))


def test_a_query_that_nothing_fits_is_a_fault_of_that_query_alone(elsewhere, trial):
    """A class of its own came back as a fault of anything, which ended the run."""
    query = trial.queries[1]
    with pytest.raises(QueryFault, match="no view fits") as fault:
        remote(elsewhere, mood="lost").localize(query, trial.city_map, streams_of(query))
    assert "lodbench city info" in fault.value.hint


def test_linear_algebra_has_one_thread_there_too(elsewhere, trial, tmp_path):
    method, query = remote(elsewhere), trial.queries[0]
    method.prepare(trial.city_map, (), Workspace(tmp_path))
    assert method.localize(query, trial.city_map, streams_of(query)).trace["blas"] == (1.0,)
    assert (tmp_path / "blas").read_text() == "1"


def test_the_folder_it_is_started_in_is_no_place_to_import_from(elsewhere, tmp_path, monkeypatch):
    (tmp_path / "numpy.py").write_text("raise SystemExit('a stranger')")
    monkeypatch.chdir(tmp_path)
    assert remote(elsewhere).name == "shake"


def test_a_process_that_could_not_prepare_is_asked_to_again(elsewhere, trial, tmp_path):
    method, query = remote(elsewhere, mood="unready"), trial.queries[0]
    with pytest.raises(QueryFault, match="not yet"):
        method.prepare(trial.city_map, (), Workspace(tmp_path))
    with pytest.raises(QueryFault, match="not yet"):
        method.localize(query, trial.city_map, streams_of(query))
    (tmp_path / "ready").touch()
    assert isinstance(method.localize(query, trial.city_map, streams_of(query)), Estimate)


@pytest.mark.slow
def test_preparing_has_a_time_of_its_own(elsewhere, trial, tmp_path):
    settings = {"name": "shake", "mood": "slow"}
    patient = RemoteMethod(settings, RunnerParams("subprocess", elsewhere, timeout_s=0.8))
    patient.prepare(trial.city_map, (), Workspace(tmp_path))
    hasty = RemoteMethod(settings, RunnerParams("subprocess", elsewhere, prepare_timeout_s=0.5))
    with pytest.raises(ConfigError, match=r"shake cannot prepare: .* no answer in 0\.5 s"):
        hasty.prepare(trial.city_map, (), Workspace(tmp_path))


@pytest.mark.slow
def test_nothing_of_this_pythons_environment_goes_along(elsewhere, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.devnull)
    method = remote(elsewhere)
    assert method.params == {"name": "shake", "tries": 8, "mood": "fine"}
    method.close()
    with pytest.raises(ConfigError, match="tires"):
        remote(elsewhere, tires=3)


@pytest.mark.slow
def test_a_plug_in_there_that_a_setting_names_is_part_of_the_code(elsewhere, tmp_path):
    (tmp_path / "wobble_fit.py").write_text("OFF = 1\n")
    info = tmp_path / "wobble-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: wobble\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[lodbench.fits]\nwobble = wobble_fit:Wobble\n")
    python = tmp_path / "python"
    python.write_text(Path(elsewhere).read_text().replace('PYTHONPATH="', f'PYTHONPATH="{tmp_path}:'))
    python.chmod(0o755)

    def codes() -> list[list[str]]:
        methods = [remote(str(python), mood=mood) for mood in ("fine", "wobble")]
        for method in methods:
            method.close()
        return [method.remote_code for method in methods]

    before = codes()
    (tmp_path / "wobble_fit.py").write_text("OFF = 100\n")
    after = codes()
    assert after[0] == before[0]
    assert after[1] != before[1]


class Here:
    """Stands for the pipe: what is asked is answered in this process, and noted."""

    def __init__(self, city_map) -> None:
        self.city_map, self.asked = city_map, []

    def ask(self, *words):
        self.asked.append(words)
        return answered(list(words), None, self.city_map, None)


FAR = {"name": "", "threads": 1, "is_textured": False}


@pytest.mark.parametrize("kind", [*sorted(KINDS - {"render"}), "fit"])
def test_many_poses_are_asked_for_some_at_a_time(kind, trial, monkeypatch):
    camera, city_map = trial.queries[0].camera.scaled(80, 60), trial.city_map
    poses = [query.prior for query in trial.queries] * 2
    asked = np.stack([p.rotation for p in poses]), np.stack([p.center for p in poses])
    mask = np.zeros((60, 80), bool)
    mask[20:40, 30:60] = True
    more = {"counts": [mask], "fit": [IouFit(mask)]}.get(kind, [])
    city_map.usage.take()
    monkeypatch.setattr(child_module, "_PORTION_BYTES", 40 if kind == "counts" else 1)
    pipe = Here(city_map)
    found = getattr(RemoteMap(pipe, FAR), kind)(camera, *asked, *more)
    assert len(pipe.asked) == (3 if kind == "counts" else 6)
    assert city_map.usage.total == 6
    assert packed(found) == packed(getattr(city_map, kind)(camera, *asked, *more))
    nothing = getattr(RemoteMap(pipe, FAR), kind)(camera, asked[0][:0], asked[1][:0], *more)
    assert packed(nothing) == packed(getattr(city_map, kind)(camera, asked[0][:0], asked[1][:0], *more))


def test_a_grid_of_any_size_is_drawn(trial, monkeypatch):
    """200,000 poses, 6.9 GB of silhouettes: more than goes over the pipe at a time."""
    largest = 0

    def silhouettes(camera, rotations, centers):
        nonlocal largest
        largest = max(largest, len(centers))
        return np.zeros((len(centers), 1, 1), np.uint64)

    monkeypatch.setattr(trial.city_map.scorer, "silhouettes", silhouettes)
    method_map = RemoteMap(Here(trial.city_map), FAR)
    count, camera = 200_000, trial.queries[0].camera.scaled(602, 448)
    rotations = np.broadcast_to(np.eye(3), (count, 3, 3))
    scores = method_map.fit(camera, rotations, np.zeros((count, 3)), lambda words: np.zeros(len(words)))
    assert len(scores) == count
    assert 0 < largest * 448 * 80 <= 1 << 26


def test_what_a_method_counts_itself_is_counted_here(trial):
    trial.city_map.usage.take()
    RemoteMap(Here(trial.city_map), FAR).usage.add("wires", 7)
    assert trial.city_map.usage.take() == {"wires": 7}
    with pytest.raises(LodbenchError):
        answered(["count", "wires", -7], None, trial.city_map, None)


def test_only_what_is_offered_is_drawn_and_never_too_much(trial):
    camera, many = Camera(8000, 8000, 9e3, 9e3, 4e3, 4e3), (np.zeros((10**6, 3, 3)), np.zeros((10**6, 3)))
    for words, reason in (
        (["draw", "depth", {}, camera, *many], "too many at a time"),
        (["draw", "depth", {}, 7, *many], "with a camera and poses"),
        (["draw", "usage", {}], "no 'draw'"),
        (["true_pixels", many[1]], "no 'true_pixels'"),
        ([], "no ''"),
    ):
        with pytest.raises(LodbenchError, match=reason):
            answered(words, trial.queries[0], trial.city_map, streams_of(trial.queries[0]))


@pytest.mark.slow
def test_a_run_over_pipes_counts_a_crash_and_goes_on(elsewhere, tmp_path, capsys):
    root, city = write_dataset(tmp_path / "town", count=2)
    words = ["run", "method=shake", "dataset=folder", f"root={root}", f"city={city}"]
    words += ["runner=subprocess", f"runner.python={elsewhere}", f"paths.runs={tmp_path / 'runs'}"]
    assert main([*words, "method.mood=dies"]) == 0
    printed = capsys.readouterr().out
    assert "1 x ProcessFault: the method's process ended with exit code 1: RuntimeError: no more" in printed
    (config,) = (tmp_path / "runs").rglob("config.yaml")
    assert "runner: subprocess" in config.read_text()
    assert elsewhere not in config.read_text()


@pytest.mark.parametrize(
    ("words", "reported"),
    [
        (
            ["runner=subprocess", f"runner.python={sys.executable}", "runner.timeout_s=0"],
            "runner.timeout_s=0 is not in",
        ),
        pytest.param(
            ["runner=subprocess", f"runner.python={sys.executable}", "method=shake"],
            "shake",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            ["runner=subprocess", f"runner.python={sys.executable}", "method=flight"],
            "whole flights",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_wrong_runner_is_one_line_before_any_work(words, reported, capsys, tmp_path):
    assert main(["run", "dataset=demo", f"paths.runs={tmp_path}", *words]) == 2
    error = capsys.readouterr().err
    assert reported in error
    assert error.startswith("lodbench: ")
    assert len(error.splitlines()) <= 2
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_check_method_asks_it_there(elsewhere, capsys):
    assert main(["check-method", "shake", f"runner.python={elsewhere}", "method.tries=6"]) == 0
    assert "conforms to the protocol" in capsys.readouterr().out
    assert main(["check-method", "shake", f"runner.python={sys.executable}"]) == 1
    assert "shake" in capsys.readouterr().out


@pytest.mark.slow
def test_check_method_there_takes_the_settings_that_a_method_has_for_the_trial(capsys):
    """Of a matcher that finds nothing on plain blocks all but the matcher is judged, and that is said."""
    assert main(["check-method", "cadloc", f"runner.python={sys.executable}"]) == 0
    printed = capsys.readouterr().out
    assert "matcher=oracle instead of sift_nn" in printed
    assert "cadloc conforms to the protocol" in printed


@pytest.mark.nightly
def test_a_method_that_counts_poses_itself_answers_there_too():
    assert main(["check-method", "lodloc", "method.rounds=1", f"runner.python={sys.executable}"]) == 0


@pytest.mark.parametrize(
    ("words", "reported"),
    [
        ([f"runner.python={sys.executable}", "method.bogus=1"], "method.bogus is not a setting"),
        ([f"runner.python={sys.executable}", "runner.bogus=1"], "runner.bogus is not a setting"),
    ],
)
def test_a_wrong_runner_is_no_fault_of_the_method_checked(words, reported, capsys):
    assert main(["check-method", "prior_only", *words]) == 2
    assert f"lodbench: {reported}" in capsys.readouterr().err
