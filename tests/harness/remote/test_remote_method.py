"""Methods over pipes: the same bytes as in this process."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lodbench.errors import ConfigError, QueryFault
from lodbench.harness.remote import RemoteMethod, RunnerParams
from lodbench.methods import Estimate
from lodbench.methods.conformance.trial import streams_of
from lodbench.methods.localize import localize_query
from lodbench.methods.protocol import Workspace
from lodbench.methods.registry import make_method


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
