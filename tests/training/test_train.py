"""Trainings by command: determinism, exact resume, what is left behind."""

import importlib
import json
import math
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest

from lodbench.errors import ConfigError
from lodbench.segmentation.packaged import Compact, CompactParams
from lodbench.training.samples import TrainParams, find_samples
from lodbench.training.train import train_network
from tests.training.squares import train

torch = pytest.importorskip("torch", reason="torch is not installed (extra [torch])")
pytest.importorskip("onnx", reason="onnx is not installed (extra [torch])")


def stop_after(patch, epoch):
    """Has a training stopped from outside once the checkpoint of an epoch is written."""
    from lodbench.training.nets import loop

    saved = loop.save_checkpoint

    def stops(state, folder):
        saved(state, folder)
        if state["epoch"] == epoch:
            raise KeyboardInterrupt

    patch.setattr(loop, "save_checkpoint", stops)


def test_training_learns_and_leaves_weights_curves_and_a_record(views, tmp_path, capsys):
    assert train(views, tmp_path / "a", "schedule.epochs=6") == 0
    printed = capsys.readouterr().out
    record = json.loads((tmp_path / "a" / "training.json").read_text())
    assert [row["epoch"] for row in record["history"]] == [1, 2, 3, 4, 5, 6]
    assert record["history"][-1]["loss"] < 0.8 * record["history"][0]["loss"]
    assert record["domain"] == "synthetic"
    assert f"{record['history'][-1]['mean_iou']:.4f}" in printed
    assert cv2.imread(str(tmp_path / "a" / "curves.png")) is not None
    # The weights run where there is no torch.
    from lodbench.segmentation.masks import read_photo

    segmenter = Compact(CompactParams(weights=str(tmp_path / "a" / "compact.onnx"), size=96))
    found = segmenter.probability(read_photo(views / "val" / "images" / "0.png"))
    assert found.shape == (64, 96)


@pytest.mark.slow
def test_a_stopped_training_ends_in_the_same_bytes(views, tmp_path, monkeypatch):
    assert train(views, tmp_path / "whole") == 0
    with monkeypatch.context() as patch:
        stop_after(patch, epoch=2)
        assert train(views, tmp_path / "parts") == 130
    assert train(views, tmp_path / "parts") == 0
    for name in ("compact.onnx", "training.json"):
        assert (tmp_path / "parts" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


@pytest.mark.slow
def test_another_training_in_the_same_folder_is_refused(views, tmp_path, capsys):
    assert train(views, tmp_path / "a", "schedule.epochs=1") == 0
    assert train(views, tmp_path / "a", "schedule.epochs=1", "schedule.lr=0.01") == 2
    assert "other settings" in capsys.readouterr().err


TINY = """
from dataclasses import dataclass
from pathlib import Path

import torch

@dataclass(frozen=True)
class Params:
    name: str = "tiny"
    size: int = 64
    normalise: str = "none"
    weights: str | None = None

class Tiny:
    params, stride = Params(), 8

    def build(self, init):
        class Net(torch.nn.Module):
            def __init__(self):
                super().__init__()
                self.convolution = torch.nn.Conv2d(3, 1, 3, padding=1)

            def forward(self, photos):
                return (self.convolution(photos),)

        return Net()

    def store(self, net, folder):
        torch.save(net.state_dict(), Path(folder) / "tiny.pt")
        return Path(folder) / "tiny.pt"
"""


@pytest.mark.slow
def test_a_plug_in_that_was_edited_since_is_another_training(views, tmp_path, monkeypatch):
    module = tmp_path / "site" / "tiny_nets" / "__init__.py"
    module.parent.mkdir(parents=True)
    module.write_text(TINY)
    monkeypatch.syspath_prepend(tmp_path / "site")
    tiny = importlib.import_module("tiny_nets").Tiny()
    params = TrainParams(data=str(views), out=str(tmp_path / "a"), epochs=1, crop=64, size=0)
    train_network(tiny, params)
    assert train_network(tiny, params).started_at == 1
    module.write_text(TINY.replace("return (", "return 2 * ("))
    with pytest.raises(ConfigError, match="other code"):
        train_network(tiny, params)


@pytest.mark.slow
def test_a_mask_that_was_mended_since_is_another_training(views, tmp_path, capsys):
    """Files of the same size: TIFF and BMP, and PNG without compression, are whatever they show."""
    shutil.copytree(views, tmp_path / "set")
    mask, plain = tmp_path / "set" / "train" / "masks" / "0.png", [cv2.IMWRITE_PNG_COMPRESSION, 0]
    cv2.imwrite(str(mask), np.zeros((64, 96), np.uint8), plain)
    size = mask.stat().st_size
    assert train(tmp_path / "set", tmp_path / "a", "schedule.epochs=1") == 0
    cv2.imwrite(str(mask), np.full((64, 96), 255, np.uint8), plain)
    assert mask.stat().st_size == size
    assert train(tmp_path / "set", tmp_path / "a", "schedule.epochs=1") == 2
    assert "other views" in capsys.readouterr().err


@pytest.mark.slow
def test_a_training_that_diverges_stops_and_keeps_its_checkpoint(views, tmp_path, monkeypatch, capsys):
    from lodbench.training.nets import loop

    losses = iter(range(100))
    counted = loop.total_loss
    # Two steps an epoch: the fourth is in the second.
    monkeypatch.setattr(
        loop, "total_loss", lambda *args: counted(*args) * (math.nan if next(losses) == 3 else 1.0)
    )
    assert train(views, tmp_path / "out") == 2
    told = capsys.readouterr().err
    assert "The loss is nan in step 2 of epoch 2" in told
    assert "schedule.lr" in told
    kept = torch.load(tmp_path / "out" / "checkpoint.pt", weights_only=True)
    assert kept["epoch"] == 1
    assert all(torch.isfinite(value.float()).all() for value in kept["net"].values())


@pytest.mark.slow
def test_training_goes_on_from_the_packages_weights(views, tmp_path, capsys):
    """A first epoch at no rate worth the name leaves the shipped network as it was."""
    rates = ["schedule.epochs=1", "schedule.lr=1e-12", "schedule.muon_lr=1e-12", "schedule.lr_end=0"]
    assert train(views, tmp_path / "a", "init=package", *rates) == 0
    kept = json.loads((tmp_path / "a" / "training.json").read_text())
    from lodbench.segmentation.photo_segmenter import packaged_file
    from lodbench.storage import file_digest

    assert kept["init"] == file_digest(packaged_file("compact.onnx"))
    photo = np.random.default_rng(0).integers(0, 256, (64, 96, 3), dtype=np.uint8)
    shipped, again = (
        Compact(CompactParams(weights=file, size=96)).logits(photo)
        for file in (None, str(tmp_path / "a" / "compact.onnx"))
    )
    assert np.corrcoef(shipped.ravel(), again.ravel())[0, 1] > 0.98
    assert train(views, tmp_path / "b", "init=package", "segmenter=sam2_unet") == 2
    assert "package holds no weights" in capsys.readouterr().err
    assert train(views, tmp_path / "b", "init=none.onnx") == 2
    assert "There are no weights none.onnx" in capsys.readouterr().err


@pytest.mark.slow
def test_the_mean_of_two_trainings_is_stored(views, tmp_path, capsys):
    from lodbench.segmentation.nets.unets import CompactNet
    from lodbench.segmentation.nets.weights import load_weights
    from lodbench.segmentation.packaged import Compact
    from lodbench.training.nets.batches import validation_iou
    from lodbench.training.nets.loop import average_into

    assert train(views, tmp_path / "a", "schedule.epochs=1") == 0
    assert train(views, tmp_path / "b", "schedule.epochs=1", "seed=1") == 0
    files = [str(tmp_path / name / "checkpoint.pt") for name in "ab"]
    first, second = (load_weights(CompactNet(), file) for file in files)
    mean = load_weights(CompactNet(), files[0])
    average_into(mean, [tmp_path / "b" / "checkpoint.pt"])
    for name, value in mean.named_parameters():
        expected = (first.get_parameter(name) + second.get_parameter(name)) / 2
        torch.testing.assert_close(value, expected)
    words = ["schedule.epochs=1", f"average=[{files[1]}]"]
    capsys.readouterr()
    assert train(views, tmp_path / "c", *words) == 0
    of_mean = validation_iou(mean, find_samples(views, "val"), 0, False, Compact.stride, torch.device("cpu"))
    assert f"mean per view {of_mean['mean_iou']:.4f}" in capsys.readouterr().out
    record = json.loads((tmp_path / "c" / "training.json").read_text())
    assert record["averaged"]["mean_iou"] == pytest.approx(of_mean["mean_iou"], abs=1e-6)
    assert record["history"][-1]["mean_iou"] != pytest.approx(of_mean["mean_iou"], abs=1e-6)
    alone, both = ((tmp_path / name / "compact.onnx").read_bytes() for name in "ac")
    assert alone != both
    kept = load_weights(CompactNet(), str(tmp_path / "c" / "averaged.safetensors"))
    for name, value in mean.named_parameters():
        torch.testing.assert_close(kept.get_parameter(name), value)
    assert train(views, tmp_path / "d", "average=[none.pt]") == 2
    assert "There are no weights none.pt" in capsys.readouterr().err


@pytest.mark.slow
class TestTwoProcesses:
    """torchrun on a CPU: each process sees half of every batch, gradients are averaged."""

    def torchrun(self, views, out, *words):
        command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
        settings = ["schedule.epochs=3", "schedule.batch=4", "schedule.crop=64", "schedule.val_every=1"]
        words = [f"data={views}", f"out={out}", "threads=1", "device=cpu", *settings, *words]
        done = subprocess.run(
            [*command, "-m", "lodbench", "train", *words], capture_output=True, text=True, timeout=500
        )
        assert done.returncode == 0, done.stderr
        return json.loads((out / "training.json").read_text())

    def test_they_learn_as_one_does(self, views, tmp_path):
        assert train(views, tmp_path / "one", "device=cpu") == 0
        one = json.loads((tmp_path / "one" / "training.json").read_text())
        two = self.torchrun(views, tmp_path / "two")
        assert two["digest"] == one["digest"]
        # Not the same to the digit: each process normalises by the statistics of its own half.
        losses = [[row["loss"] for row in record["history"]] for record in (one, two)]
        assert losses[1] == pytest.approx(losses[0], rel=0.15)
        assert losses[1][2] < 0.8 * losses[1][0]
        assert (tmp_path / "two" / "compact.onnx").is_file()

    def test_they_take_up_a_checkpoint(self, views, tmp_path, monkeypatch):
        with monkeypatch.context() as patch:
            stop_after(patch, epoch=2)
            assert train(views, tmp_path / "a", "device=cpu") == 130
        before = json.loads((tmp_path / "a" / "training.json").read_text())["history"]
        after = self.torchrun(views, tmp_path / "a")["history"]
        # What was there is there as it was; the last epoch is new.
        assert after[: len(before)] == before
        assert [row["epoch"] for row in after] == [1, 2, 3]
        assert after[2]["loss"] < after[0]["loss"]


@pytest.mark.slow
def test_mixed_precision_learns_as_well(views, tmp_path):
    histories = []
    for precision in ("float32", "bfloat16"):
        out = tmp_path / precision
        assert train(views, out, "schedule.epochs=3", f"precision={precision}", "device=cpu") == 0
        histories.append([row["loss"] for row in json.loads((out / "training.json").read_text())["history"]])
    # Rounding leads elsewhere within a few steps; it must not keep the loss from falling as far.
    assert histories[0] != histories[1]
    assert all(losses[-1] < 0.8 * losses[0] for losses in histories)
    assert histories[1] == pytest.approx(histories[0], rel=0.3)


def test_without_tensorboard_it_is_reported_how_to_get_it(views, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    assert train(views, tmp_path / "a", "schedule.epochs=1", "tensorboard=true") == 2
    told = capsys.readouterr().err
    assert "tensorboard=true needs tensorboard, which is not installed" in told
    assert "lodbench[tensorboard]" in told


@pytest.mark.slow
def test_tensorboard_has_the_history(views, tmp_path):
    pytest.importorskip("tensorboard", reason="tensorboard is not installed (extra [tensorboard])")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    assert train(views, tmp_path / "a", "schedule.epochs=1", "tensorboard=true") == 0
    (row,) = json.loads((tmp_path / "a" / "training.json").read_text())["history"]
    board = EventAccumulator(str(tmp_path / "a" / "tensorboard")).Reload()
    for name in ("loss", "mean_iou", "lr"):
        (event,) = board.Scalars(name)
        assert (event.step, event.value) == (1, pytest.approx(row[name], rel=1e-6))
