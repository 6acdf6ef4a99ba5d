"""What a step of training keeps, told before it is made."""

import pytest

from lodbench.errors import ConfigError
from lodbench.segmentation import torch_segmenter

torch = pytest.importorskip("torch")


def small_net():
    return torch.nn.Sequential(
        torch.nn.Conv2d(3, 4, 3, padding=1),
        torch.nn.BatchNorm2d(4),
        torch.nn.ReLU(),
        torch.nn.Conv2d(4, 1, 1),
    ).train()


def test_what_is_kept_is_that_of_a_real_step():
    from lodbench.training.nets.run import kept_bytes

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
    from lodbench.training.nets.run import require_room

    net = small_net()
    require_room(net, (2, 3, 16, 24))
    monkeypatch.setattr(torch_segmenter, "free_bytes", lambda: 1 << 30)
    with pytest.raises(
        ConfigError, match=r"steps over 4096 pictures of 1024 x 1024 need [\d.]+ GiB"
    ) as fault:
        require_room(net, (4096, 3, 1024, 1024))
    assert "schedule.batch" in fault.value.hint
