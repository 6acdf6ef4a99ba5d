from __future__ import annotations

import pytest

from lodbench.cli import main


@pytest.mark.parametrize(
    ("world", "told", "hint"),
    [
        ("nix=3", "--world nix=3: nix is not a setting", "Known: center, focal, hidden_feet_m"),
        ("focal=9", "--world focal=9: focal=9 is not within", ""),
        ("focal", "--world focal: focal is empty, not a number.", "Write focal=2.5, for instance."),
    ],
)
def test_a_world_that_cannot_be_is_told_as_it_was_typed(capsys, world, told, hint):
    assert main(["bench", "accuracy", "--world", world]) == 2
    said = capsys.readouterr().err
    assert told in said
    assert hint in said
    assert "world." not in said
