"""Training networks: the losses by hand, determinism, exact resume, what is left behind."""

import copy
import json
import math
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest

from lodbench.cli import main
from lodbench.errors import ConfigError, DatasetError
from lodbench.segmentation.compact import Compact, CompactParams
from lodbench.segmentation.compact_instances import CompactInstances, CompactInstancesParams
from lodbench.storage import random_stream
from lodbench.training.augment import flipped, random_crop, relit
from lodbench.training.samples import find_samples, split_samples
from lodbench.training.train_params import TrainParams

torch = pytest.importorskip("torch", reason="torch is not installed (extra [torch])")
pytest.importorskip("onnx", reason="onnx is not installed (extra [torch])")


@pytest.fixture(scope="module")
def views(tmp_path_factory):
    """Twelve pictures of red squares on green ground: something a network learns in seconds."""
    root = tmp_path_factory.mktemp("views")
    for split, count in (("train", 10), ("val", 2)):
        for kind in ("images", "masks"):
            (root / split / kind).mkdir(parents=True)
        for number in range(count):
            generator = random_stream(1, split, number)
            picture = generator.integers(0, 60, (64, 96, 3), dtype=np.uint8)
            picture[..., 1] += 100
            mask = np.zeros((64, 96), np.uint8)
            top, left = int(generator.integers(4, 30)), int(generator.integers(4, 60))
            mask[top : top + 28, left : left + 30] = 255
            picture[mask > 0] = picture[mask > 0] // 2 + np.array([0, 0, 180], np.uint8)
            cv2.imwrite(str(root / split / "images" / f"{number}.png"), picture)
            cv2.imwrite(str(root / split / "masks" / f"{number}.png"), mask)
    return root


def train(views, out, *words):
    schedule = ["schedule.batch=4", "schedule.crop=64", "schedule.val_every=1", "threads=1"]
    return main(["train", f"data={views}", f"out={out}", "schedule.epochs=3", *schedule, *words])


def stop_after(patch, epoch):
    """Has a training stopped from outside once the checkpoint of an epoch is written."""
    from lodbench.training.nets import loop

    saved = loop.save_checkpoint

    def stops(state, folder):
        saved(state, folder)
        if state["epoch"] == epoch:
            raise KeyboardInterrupt

    patch.setattr(loop, "save_checkpoint", stops)


def structure_loss_by_hand(logits, truth, weighting):
    height, width = truth.shape
    padded = np.pad(truth, 15)
    mean = np.array(
        [[padded[r : r + 31, c : c + 31].sum() / 961 for c in range(width)] for r in range(height)]
    )
    weights = 1 + 5 * abs(mean - truth)
    p = 1 / (1 + np.exp(-logits))
    each = -(truth * np.log(p) + (1 - truth) * np.log(1 - p))
    entropy = (weights * each).sum() / weights.sum() if weighting == "paper" else each.mean()
    shared, both = (p * truth * weights).sum(), ((p + truth) * weights).sum()
    return entropy + 1 - (shared + 1) / (both - shared + 1)


@pytest.mark.parametrize("weighting", ["paper", "released"])
def test_the_loss_is_the_papers(weighting):
    from lodbench.training.nets.losses import total_loss

    generator = np.random.default_rng(0)
    logits, truth = generator.normal(0, 2, (40, 50)), (generator.random((40, 50)) < 0.3) * 1.0
    expected = structure_loss_by_hand(logits, truth, weighting)
    pair = [torch.tensor(a, dtype=torch.float32)[None, None] for a in (logits, truth)]
    assert float(total_loss((pair[0],), pair[1], weighting)) == pytest.approx(expected, rel=1e-5)
    assert float(total_loss((pair[0],) * 3, pair[1], weighting)) == pytest.approx(3 * expected, rel=1e-5)


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
    from lodbench.segmentation.photos import read_photo

    segmenter = Compact(CompactParams(weights=str(tmp_path / "a" / "compact.onnx"), size=96))
    found = segmenter.probability(read_photo(views / "val" / "images" / "0.png"))
    assert found.shape == (64, 96)


def test_a_stopped_training_ends_in_the_same_bytes(views, tmp_path, monkeypatch):
    assert train(views, tmp_path / "whole") == 0
    with monkeypatch.context() as patch:
        stop_after(patch, epoch=2)
        assert train(views, tmp_path / "parts") == 130
    assert train(views, tmp_path / "parts") == 0
    for name in ("compact.onnx", "training.json"):
        assert (tmp_path / "parts" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_interiors_of_labelled_buildings_are_learnt(views, tmp_path, capsys):
    from lodbench.segmentation.nets.compact import CompactNet

    learnt = "segmenter=compact_instances"
    assert train(views, tmp_path / "a", learnt, "schedule.epochs=1") == 2
    told = capsys.readouterr().err
    assert "have no label" in told
    assert "labels=true" in told
    labelled = tmp_path / "labelled"
    shutil.copytree(views, labelled)
    for mask in labelled.rglob("masks/*.png"):
        labels = (cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE) > 0).astype(np.uint16)
        labels[:, np.flatnonzero(labels.any(axis=0))[15:]] *= 2
        (mask.parent.parent / "labels").mkdir(exist_ok=True)
        cv2.imwrite(str(mask.parent.parent / "labels" / mask.name), labels)
    _, target = find_samples(labelled, "train", "interiors")[0].read(0, square=False)
    # Two halves of 15 by 28 pixels, each two pixels smaller on every side.
    assert target.sum() == 2 * 11 * 24
    assert train(labelled, tmp_path / "a", learnt, "schedule.epochs=1") == 0
    weights = tmp_path / "a" / "compact_instances.onnx"
    photo = np.zeros((64, 96, 3), np.uint8)
    assert CompactInstances(CompactInstancesParams(weights=str(weights))).interior(photo).any()
    # The same layers as those of compact, to which they would be masks.
    with pytest.raises(ConfigError, match=r"has learnt interiors of buildings, not masks"):
        Compact(CompactParams(weights=str(weights))).probability(photo)
    masks = Compact(CompactParams()).store(CompactNet(), tmp_path)
    instances = CompactInstances(CompactInstancesParams(weights=str(masks)))
    with pytest.raises(ConfigError, match=r"has learnt masks of buildings, not interiors"):
        instances.interior(photo)
    assert train(labelled, tmp_path / "b", learnt, f"negatives=[{views}]") == 2
    assert "negatives has masks only" in capsys.readouterr().err


def test_another_training_in_the_same_folder_is_refused(views, tmp_path, capsys):
    assert train(views, tmp_path / "a", "schedule.epochs=1") == 0
    assert train(views, tmp_path / "a", "schedule.epochs=1", "schedule.lr=0.01") == 2
    assert "other settings" in capsys.readouterr().err


@pytest.mark.parametrize("sides", ["schedule.crop=50", "schedule.size=70"])
def test_sides_that_are_no_multiples_of_the_stride_are_padded(views, tmp_path, capsys, sides):
    more = () if "crop" in sides else ("schedule.crop=0",)
    assert train(views, tmp_path / "a", "schedule.epochs=1", "init=package", sides, *more) == 0
    assert (tmp_path / "a" / "compact.onnx").is_file()


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


def test_faults_of_the_data(views, tmp_path, capsys):
    assert main(["train", f"data={tmp_path / 'none'}"]) == 2
    assert "There is no folder" in capsys.readouterr().err
    (tmp_path / "train" / "images").mkdir(parents=True)
    assert main(["train", f"data={tmp_path}"]) == 2
    assert "no views to train on" in capsys.readouterr().err
    cv2.imwrite(str(tmp_path / "train" / "images" / "1.png"), np.zeros((9, 9, 3), np.uint8))
    with pytest.raises(DatasetError, match=r"1 pictures in .* have no mask"):
        find_samples(tmp_path, "train")
    assert main(["train", f"data={views}", "segmenter=masks"]) == 2
    told = capsys.readouterr().err
    assert "no network to train" in told
    assert "Trainable: compact, compact_instances, efficient_unet, sam2_unet, sam1_adapter." in told


def test_a_mask_of_another_aspect_is_refused_before_training(views, tmp_path):
    shutil.copytree(views, tmp_path / "set")
    samples = find_samples(tmp_path / "set", "train")
    cv2.imwrite(str(samples[3].mask), np.zeros((96, 64), np.uint8))
    with pytest.raises(DatasetError, match="the mask is 64 x 96, the photo 96 x 64: another aspect"):
        find_samples(tmp_path / "set", "train")
    with pytest.raises(DatasetError, match="another aspect"):
        samples[3].read(64, square=True)


def test_pictures_that_would_share_a_mask_are_refused(views, tmp_path):
    shutil.copytree(views, tmp_path / "set")
    photo = find_samples(tmp_path / "set", "train")[0].photo
    cv2.imwrite(str(photo.with_suffix(".tif")), cv2.imread(str(photo)))
    with pytest.raises(DatasetError, match="share a name"):
        find_samples(tmp_path / "set", "train")


def test_views_that_are_trained_on_do_not_validate(views, tmp_path, capsys):
    assert train(views, tmp_path / "out", f"val_data={views}") == 2
    assert "10 of the 12 views of val_data are trained on" in capsys.readouterr().err


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


def test_views_are_held_out_where_there_are_none_to_validate_on(views):
    train_views, val_views, source = split_samples(
        find_samples(views, "train"), find_samples(views, "val"), None
    )
    assert (len(train_views), len(val_views)) == (10, 2)
    train_views, val_views, source = split_samples(find_samples(views, "train"), [], None)
    assert (len(train_views), len(val_views)) == (9, 1)
    assert "held out" in source
    assert not {s.key for s in train_views} & {s.key for s in val_views}


def test_pictures_and_masks_change_together():
    generator = np.random.default_rng(0)
    mask = (cv2.GaussianBlur(generator.random((90, 120)), (0, 0), 6) > 0.5).astype(np.float32)
    photo = np.repeat((255 * mask[..., None]).astype(np.uint8), 3, axis=2)
    for draw in range(5):
        stream = np.random.default_rng(draw)
        picture, truth = random_crop(*flipped(photo, mask, stream, (1, 0)), 64, (0.8, 1.5), stream)
        assert truth.shape == (64, 64)
        assert abs(picture[..., 0] / 255.0 - truth).max() < 0.02  # bytes, and their coarser interpolation
        again = relit(picture, np.random.default_rng(draw))
        assert 0 <= again.min() <= again.max() <= 1
        assert (again == relit(picture, np.random.default_rng(draw))).all()


def test_a_share_of_pictures_loses_its_colours():
    photo = np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8)
    for draw in range(8):
        colours = relit(photo, np.random.default_rng(draw))
        band = relit(photo, np.random.default_rng(draw), one_band=1.0)
        assert 0 <= band.min() <= band.max() <= 1
        assert band.std() > 0.1
        # Noise, where it is drawn, differs by channel.
        assert np.median(np.ptp(band, axis=2)) < 0.1 < np.median(np.ptp(colours, axis=2))


def test_the_learning_rate_rises_and_falls_along_a_cosine():
    from lodbench.training.nets.loop import learning_rate

    params = TrainParams("d", lr=1.0, lr_end=0.0, warmup=0.1)
    rates = [learning_rate(params, step, 100) for step in range(100)]
    assert rates[0] == pytest.approx(0.1)
    assert rates[10] == pytest.approx(1.0)
    assert rates[55] == pytest.approx(0.5)
    assert rates[99] < 0.001
    assert max(rates) <= 1.0


@pytest.mark.parametrize("wrong", [{"weighting": "fair"}, {"batch": 0}, {"lr": math.nan}, {"size": 0}])
def test_settings_out_of_range_are_named(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        TrainParams("d", **wrong)


def test_muon_moves_a_kernel_as_it_moves_the_matrix_it_is():
    from torch import nn

    from lodbench.training.nets.optimizers import KernelMuon

    torch.manual_seed(0)
    values, gradient = torch.randn(24, 16, 3, 3), torch.randn(24, 16, 3, 3)
    plain = nn.Parameter(values.flatten(1).clone())
    plain.grad = gradient.flatten(1).clone()
    torch.optim.Muon([plain], lr=0.1, weight_decay=0.01, momentum=0.9, ns_steps=4).step()
    for memory in (torch.contiguous_format, torch.channels_last):
        kernel = nn.Parameter(values.clone(memory_format=memory))
        kernel.grad = gradient.clone()
        KernelMuon([kernel], lr=0.1, weight_decay=0.01).step()
        assert not torch.equal(kernel, values)
        # Half precision within Muon: the order of a matrix's columns changes the last digits.
        torch.testing.assert_close(kernel.detach(), plain.detach().view_as(kernel), rtol=0, atol=2e-3)


def test_given_weights_answer_the_same_while_training():
    from lodbench.segmentation.nets.compact import CompactNet
    from lodbench.training.nets.warm_start import adapt_norms

    torch.manual_seed(2)
    net, images = CompactNet(), torch.rand(4, 3, 64, 64)
    net.unused = torch.nn.BatchNorm2d(3)  # what no answer passes through stays as it is
    for norm in net.modules():  # statistics that these pictures do not have
        if isinstance(norm, torch.nn.BatchNorm2d):
            norm.running_mean.normal_(0, 0.3)
            norm.running_var.uniform_(0.5, 2.0)
            norm.bias.data.normal_(0, 0.3)
    with torch.no_grad():
        before = net.eval()(images)[0]
        assert (before - copy.deepcopy(net).train()(images)[0]).abs().max() > 0.01
        adapt_norms(net, [images[:2], images[2:]])
        torch.testing.assert_close(net.eval()(images)[0], before, rtol=0, atol=1e-4)
        torch.testing.assert_close(net.train()(images)[0], before, rtol=0, atol=1e-3)
    assert torch.isfinite(net.unused.weight).all()


def test_training_goes_on_from_the_packages_weights(views, tmp_path, capsys):
    """A first epoch at no rate worth the name leaves the shipped network as it was."""
    rates = ["schedule.epochs=1", "schedule.lr=1e-12", "schedule.muon_lr=1e-12", "schedule.lr_end=0"]
    assert train(views, tmp_path / "a", "init=package", *rates) == 0
    kept = json.loads((tmp_path / "a" / "training.json").read_text())
    from lodbench.segmentation.packaged_network import packaged_file
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
    from lodbench.segmentation.compact import Compact
    from lodbench.segmentation.nets.compact import CompactNet
    from lodbench.segmentation.nets.weights import load_own
    from lodbench.training.nets.average import average_into
    from lodbench.training.nets.validate import validation_iou

    assert train(views, tmp_path / "a", "schedule.epochs=1") == 0
    assert train(views, tmp_path / "b", "schedule.epochs=1", "seed=1") == 0
    files = [str(tmp_path / name / "checkpoint.pt") for name in "ab"]
    first, second = (load_own(CompactNet(), file) for file in files)
    mean = load_own(CompactNet(), files[0])
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
    kept = load_own(CompactNet(), str(tmp_path / "c" / "averaged.safetensors"))
    for name, value in mean.named_parameters():
        torch.testing.assert_close(kept.get_parameter(name), value)
    assert train(views, tmp_path / "d", "average=[none.pt]") == 2
    assert "There are no weights none.pt" in capsys.readouterr().err


def test_a_frozen_encoder_stays_and_a_slow_one_moves_less():
    from lodbench.segmentation.nets.efficient_unet import EfficientUnetNet
    from lodbench.training.nets.optimizers import make_optimizers, set_rate

    net = EfficientUnetNet()
    (alone,) = make_optimizers(net, TrainParams("d", encoder_rate=0.0))
    assert not any(weight.requires_grad for weight in net.encoder.parameters())
    decoder = sum(weight.numel() for name, weight in net.named_parameters() if not name.startswith("encoder"))
    assert sum(w.numel() for group in alone.param_groups for w in group["params"]) == decoder
    (slow,) = make_optimizers(EfficientUnetNet(), TrainParams("d", lr=0.01, encoder_rate=0.1))
    set_rate([slow], 0.5)
    assert [group["lr"] for group in slow.param_groups] == pytest.approx([0.005, 0.0005])


def test_every_weight_has_one_optimizer_and_the_paper_has_adamw_alone():
    from lodbench.segmentation.nets.compact import CompactNet
    from lodbench.training.nets.optimizers import make_optimizers

    net = CompactNet()
    (alone,) = make_optimizers(net, TrainParams("d"))
    assert isinstance(alone, torch.optim.AdamW)
    adamw, muon = make_optimizers(net, TrainParams("d", optimizer="muon"))
    counts = [sum(w.numel() for group in o.param_groups for w in group["params"]) for o in (adamw, muon)]
    assert sum(counts) == sum(w.numel() for w in net.parameters())
    assert counts[1] > 0.9 * sum(counts)


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
        assert train(views, out, "schedule.epochs=2", f"precision={precision}", "device=cpu") == 0
        histories.append([row["loss"] for row in json.loads((out / "training.json").read_text())["history"]])
    # Rounding leads elsewhere within a few steps; it must not keep the loss from falling as far.
    assert histories[0] != histories[1]
    assert all(last < 0.8 * first for first, last in histories)
    assert histories[1] == pytest.approx(histories[0], rel=0.3)


def test_without_tensorboard_it_is_told_how_to_get_it(views, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    assert train(views, tmp_path / "a", "schedule.epochs=1", "tensorboard=true") == 2
    told = capsys.readouterr().err
    assert "tensorboard=true needs tensorboard, which is not installed" in told
    assert "lodbench[tensorboard]" in told


def test_tensorboard_has_the_history(views, tmp_path):
    pytest.importorskip("tensorboard", reason="tensorboard is not installed (extra [tensorboard])")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    assert train(views, tmp_path / "a", "schedule.epochs=1", "tensorboard=true") == 0
    (row,) = json.loads((tmp_path / "a" / "training.json").read_text())["history"]
    board = EventAccumulator(str(tmp_path / "a" / "tensorboard")).Reload()
    for name in ("loss", "mean_iou", "lr"):
        (event,) = board.Scalars(name)
        assert (event.step, event.value) == (1, pytest.approx(row[name], rel=1e-6))
