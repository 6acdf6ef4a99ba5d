"""Commands with ``runner=subprocess``: runs, check-method, and wrong settings in one line."""

import sys

import pytest

from lodbench.cli import main
from tests.town import write_dataset


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
    ("words", "told"),
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
def test_a_wrong_runner_is_one_line_before_any_work(words, told, capsys, tmp_path):
    assert main(["run", "dataset=demo", f"paths.runs={tmp_path}", *words]) == 2
    error = capsys.readouterr().err
    assert told in error
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


@pytest.mark.slow
def test_a_method_that_counts_poses_itself_answers_there_too():
    assert main(["check-method", "lodloc", "method.rounds=1", f"runner.python={sys.executable}"]) == 0


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([f"runner.python={sys.executable}", "method.bogus=1"], "method.bogus is not a setting"),
        ([f"runner.python={sys.executable}", "runner.bogus=1"], "runner.bogus is not a setting"),
    ],
)
def test_a_wrong_runner_is_no_fault_of_the_method_checked(words, told, capsys):
    assert main(["check-method", "prior_only", *words]) == 2
    assert f"lodbench: {told}" in capsys.readouterr().err
