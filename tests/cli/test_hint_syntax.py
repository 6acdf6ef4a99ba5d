"""Hints have the syntax of the command that was typed, whichever library they come from."""

from __future__ import annotations

import pytest

from lodbench.cli import main

CASES = [
    ("run dataset=folder method=region", "Add dataset.root=VALUE."),
    ("run --dataset folder --method region", "Add --root VALUE."),
    ("run dataset=folder dataset.root=nowhere", "Set dataset.root=FOLDER."),
    ("run --dataset folder --root nowhere", "Set --root FOLDER."),
    ("run --dataset folder dataset.root=nowhere", "Set dataset.root=FOLDER."),
    ("run --retry-failed dataset=folder dataset.root=nowhere", "Set dataset.root=FOLDER."),
    ("run dataset=demo prior=sensor prior.takeoff_m=60 prior.heights=sea_level",
     "Leave prior.takeoff_m or prior.heights=sea_level out; prior.heights=takeoff uses prior.takeoff_m."),
    ("dataset prior . --kind sensor --set takeoff_m=60 --set heights=sea_level --out p.txt",
     "Leave --set takeoff_m or --set heights=sea_level out; --set heights=takeoff uses --set takeoff_m."),
]  # fmt: skip


@pytest.mark.parametrize(("words", "hint"), CASES, ids=[words for words, _ in CASES])
def test_a_hint_has_the_syntax_that_was_typed(capsys, tmp_path, monkeypatch, words, hint):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "GPS_pose.txt").write_text("")
    assert main(words.split()) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) <= 2
    assert hint in lines[-1]


def test_heights_of_photos_are_settings_in_a_run(capsys):
    assert main(["run", "dataset=demo", "prior=sensor", "prior.heights=barometer"]) == 2
    assert "prior.heights=barometer is unknown" in capsys.readouterr().err
