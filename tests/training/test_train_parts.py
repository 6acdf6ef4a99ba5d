"""Losses by hand, optimizers, schedules, settings, checkpoints and the memory of a training."""

import copy
import math

import numpy as np
import pytest

from lodbench.errors import ConfigError
from lodbench.segmentation import torch_segmenter
from lodbench.training.nets.batches import load_checkpoint, save_checkpoint
from lodbench.training.samples import TrainParams

torch = pytest.importorskip("torch", reason="torch is not installed (extra [torch])")
pytest.importorskip("onnx", reason="onnx is not installed (extra [torch])")


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
    from lodbench.training.nets.loop import total_loss

    generator = np.random.default_rng(0)
    logits, truth = generator.normal(0, 2, (40, 50)), (generator.random((40, 50)) < 0.3) * 1.0
    expected = structure_loss_by_hand(logits, truth, weighting)
    pair = [torch.tensor(a, dtype=torch.float32)[None, None] for a in (logits, truth)]
    assert float(total_loss((pair[0],), pair[1], weighting)) == pytest.approx(expected, rel=1e-5)
    assert float(total_loss((pair[0],) * 3, pair[1], weighting)) == pytest.approx(3 * expected, rel=1e-5)


def test_the_learning_rate_rises_and_falls_along_a_cosine():
    from lodbench.training.nets.loop import learning_rate

    params = TrainParams("d", lr=1.0, lr_end=0.0, warmup=0.1)
    rates = [learning_rate(params, step, 100) for step in range(100)]
    assert rates[0] == pytest.approx(0.1)
    assert rates[10] == pytest.approx(1.0)
    assert rates[55] == pytest.approx(0.5)
    assert rates[99] < 0.001
    assert max(rates) <= 1.0


@pytest.mark.parametrize("steps", [1, 3, 30, 51, 99])
def test_a_short_warm_up_never_passes_the_highest_rate(steps):
    from lodbench.training.nets.loop import learning_rate

    params = TrainParams("d", lr=0.5, lr_end=0.0, warmup=0.02)
    assert max(learning_rate(params, step, steps) for step in range(steps)) <= 0.5


@pytest.mark.parametrize("wrong", [{"weighting": "fair"}, {"batch": 0}, {"lr": math.nan}, {"size": 0}])
def test_settings_out_of_range_are_named(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        TrainParams("d", **wrong)


@pytest.mark.parametrize("shape", [(24, 16, 3, 3), (160, 16, 1, 1)])
@pytest.mark.parametrize("memory", [torch.contiguous_format, torch.channels_last])
def test_muon_moves_a_kernel_as_torch_moves_the_matrix_it_is(shape, memory):
    from torch import nn

    from lodbench.training.nets.loop import KernelMuon

    torch.manual_seed(0)
    values = torch.randn(shape)
    plain, kernel = nn.Parameter(values.flatten(1).clone()), nn.Parameter(values.clone(memory_format=memory))
    torchs = torch.optim.Muon([plain], lr=0.1, weight_decay=0.01, momentum=0.9, ns_steps=4)
    ours = KernelMuon([kernel], lr=0.1, weight_decay=0.01)
    for _ in range(3):
        gradient = torch.randn(shape)
        plain.grad, kernel.grad = gradient.flatten(1).clone(), gradient.clone(memory_format=memory)
        torchs.step()
        ours.step()
    assert (kernel - values).abs().max() > 0.05
    # torch's iterates in half precision.
    torch.testing.assert_close(kernel.detach(), plain.detach().view_as(kernel), rtol=0, atol=2e-3)


def test_a_training_that_torch_s_muon_had_begun_goes_on():
    from torch import nn

    from lodbench.training.nets.loop import KernelMuon

    torch.manual_seed(0)
    values = torch.randn(24, 16, 3, 3)
    plain = nn.Parameter(values.flatten(1).clone())
    torchs = torch.optim.Muon([plain], lr=0.1, weight_decay=0.01, momentum=0.9, ns_steps=4)
    plain.grad = torch.randn(24, 144)
    torchs.step()
    kernel = nn.Parameter(plain.detach().clone().view_as(values))
    ours = KernelMuon([kernel], lr=0.3, weight_decay=0.5)
    # A copy, as from a file: optimizers take over the very tensors.
    ours.load_state_dict(copy.deepcopy(torchs.state_dict()))
    plain.grad = torch.randn(24, 144)
    kernel.grad = plain.grad.clone().view_as(values)
    torchs.step()
    ours.step()
    assert (kernel.detach().flatten(1) - values.flatten(1)).abs().max() > 0.02
    torch.testing.assert_close(kernel.detach(), plain.detach().view_as(kernel), rtol=0, atol=2e-3)


def test_given_weights_answer_the_same_while_training():
    from lodbench.segmentation.nets.unets import CompactNet
    from lodbench.training.nets.loop import adapt_norms

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


def test_a_frozen_encoder_stays_and_a_slow_one_moves_less():
    from lodbench.segmentation.nets.unets import EfficientUnetNet
    from lodbench.training.nets.loop import make_optimizers, set_rate

    net = EfficientUnetNet()
    (alone,) = make_optimizers(net, TrainParams("d", encoder_rate=0.0))
    assert not any(weight.requires_grad for weight in net.encoder.parameters())
    decoder = sum(weight.numel() for name, weight in net.named_parameters() if not name.startswith("encoder"))
    assert sum(w.numel() for group in alone.param_groups for w in group["params"]) == decoder
    (slow,) = make_optimizers(EfficientUnetNet(), TrainParams("d", lr=0.01, encoder_rate=0.1))
    set_rate([slow], 0.5)
    assert [group["lr"] for group in slow.param_groups] == pytest.approx([0.005, 0.0005])


def test_every_weight_has_one_optimizer_and_the_paper_has_adamw_alone():
    from lodbench.segmentation.nets.unets import CompactNet
    from lodbench.training.nets.loop import make_optimizers

    net = CompactNet()
    (alone,) = make_optimizers(net, TrainParams("d"))
    assert isinstance(alone, torch.optim.AdamW)
    adamw, muon = make_optimizers(net, TrainParams("d", optimizer="muon"))
    counts = [sum(w.numel() for group in o.param_groups for w in group["params"]) for o in (adamw, muon)]
    assert sum(counts) == sum(w.numel() for w in net.parameters())
    assert counts[1] > 0.9 * sum(counts)


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


def small_net():
    return torch.nn.Sequential(
        torch.nn.Conv2d(3, 4, 3, padding=1),
        torch.nn.BatchNorm2d(4),
        torch.nn.ReLU(),
        torch.nn.Conv2d(4, 1, 1),
    ).train()


def test_what_is_kept_is_that_of_a_real_step():
    from lodbench.training.nets.loop import kept_bytes

    net, shape, kept = small_net(), (2, 3, 16, 24), {}
    before = {key: value.clone() for key, value in net.state_dict().items()}
    own = {weight.data_ptr() for weight in net.parameters()}
    told = kept_bytes(net, shape)
    # Neither weights nor averages nor chance were touched.
    assert all(torch.equal(value, net.state_dict()[key]) for key, value in before.items())
    torch.manual_seed(3)
    wanted = torch.rand(4)
    torch.manual_seed(3)
    kept_bytes(net, shape)
    assert torch.equal(torch.rand(4), wanted)

    def keep(tensor):
        kept[tensor.data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        output = net(torch.rand(shape))
    real = sum(size for place, size in kept.items() if place not in own)
    assert output.shape == (2, 1, 16, 24)
    assert told == pytest.approx(real, rel=0.02)
    assert kept_bytes(net, (4, 3, 16, 24)) == pytest.approx(2 * told, rel=0.02)


def test_a_step_that_does_not_fit_is_refused_before_it_is_made(monkeypatch):
    from lodbench.training.nets.loop import require_room

    net = small_net()
    require_room(net, (2, 3, 16, 24))
    monkeypatch.setattr(torch_segmenter, "free_bytes", lambda: 1 << 30)
    with pytest.raises(
        ConfigError, match=r"steps over 4096 pictures of 1024 x 1024 need [\d.]+ GiB"
    ) as fault:
        require_room(net, (4096, 3, 1024, 1024))
    assert "schedule.batch" in fault.value.hint
