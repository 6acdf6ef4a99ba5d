"""Checkpoints: a training that was read back goes on to the bytes of one that never stopped."""

import pytest

torch = pytest.importorskip("torch", reason="torch is not installed (extra [torch])")

from lodbench.training.nets.checkpoints import load_checkpoint, save_checkpoint  # noqa: E402


def test_a_state_that_was_read_back_and_goes_on_gives_the_same_bytes(tmp_path):
    state = {
        "identity": "x",
        "history": [{"loss": 0.5, "epoch": 1.0}],
        "optimizers": [{"state": torch.arange(3.0)}],
    }
    (tmp_path / "again").mkdir()
    save_checkpoint(state, tmp_path)
    found = load_checkpoint(tmp_path, "x")
    assert found is not None
    assert torch.equal(found["optimizers"][0]["state"], torch.arange(3.0))
    for each, folder in ((state, tmp_path), (found, tmp_path / "again")):
        # The names of the new row are those of the first in one state, and equal to them in the other.
        each["history"].append({"loss": 0.25, "epoch": 2.0})
        save_checkpoint(each, folder)
    first, again = (folder / "checkpoint.pt" for folder in (tmp_path, tmp_path / "again"))
    assert first.read_bytes() == again.read_bytes()
