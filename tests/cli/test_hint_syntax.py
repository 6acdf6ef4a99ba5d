"""Hints of the demo's priors have the syntax of a run's settings; other hints are in `tests/messages`."""

import pytest

from lodbench.cli import main

OUT = "Leave prior.takeoff_m or prior.heights=sea_level out; prior.heights=takeoff uses prior.takeoff_m."


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("prior.takeoff_m=60 prior.heights=sea_level", OUT),
        ("prior.heights=barometer", "prior.heights=barometer is unknown"),
    ],
)
def test_a_hint_has_the_syntax_that_was_typed(capsys, words, told):
    assert main(["run", "dataset=demo", "prior=sensor", *words.split()]) == 2
    assert told in capsys.readouterr().err
