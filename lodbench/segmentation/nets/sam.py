"""Networks on the frozen encoders of SAM2 and SAM.

SAM2-UNet (arXiv 2408.08870): a Hiera encoder with adapters, receptive-field blocks, a U-Net decoder, three
heads; parts bear the names of the authors' checkpoints, so that those can be read. SAM1-Adapter, after
SAM-Adapter (arXiv 2304.09148): a ViT with a prompt added before each block, and its mask decoder, trained.
The prompts come from the embedded photo and its high frequencies, through a small layer per block and one
that all blocks share.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lodbench.errors import ConfigError, nearest_names
from lodbench.segmentation.nets.weights import Weights, fill

# Width of the first stage, heads, blocks per stage, blocks of global attention, windows, background.
_SIZES: dict[str, tuple[int, int, list[int], list[int], list[int], int]] = {
    "tiny": (96, 1, [1, 2, 7, 2], [5, 7, 9], [8, 4, 14, 7], 7),
    "small": (96, 1, [1, 2, 11, 2], [7, 10, 13], [8, 4, 14, 7], 7),
    "base_plus": (112, 2, [2, 3, 16, 3], [12, 16, 20], [8, 4, 14, 7], 14),
    "large": (144, 2, [2, 6, 36, 4], [23, 33, 43], [8, 4, 16, 8], 7),
}
# What stands before the encoder's names: Meta's files, transformers' folders, SAM2-UNet's checkpoints.
_PREFIXES = ("image_encoder.trunk.", "vision_encoder.backbone.", "backbone.", "encoder.")
# Meta's names and those of transformers, part by part.
_RENAMED = (
    (r"^patch_embed\.proj\.", "patch_embed.projection."),
    (r"\.norm([12])\.", r".layer_norm\1."),
    (r"\.mlp\.layers\.0\.", ".mlp.proj_in."),
    (r"\.mlp\.layers\.1\.", ".mlp.proj_out."),
)


def channels_of(size: str) -> list[int]:
    """Returns the channels of the four stages: 144, 288, 576, 1152 for ``large``."""
    return [_size(size)[0] << stage for stage in range(4)]


def make_hiera(size: str) -> nn.Module:
    """Returns an encoder with random weights.

    Its ``forward`` returns ``intermediate_hidden_states``: four (B, H / k, W / k, C), k = 4, 8, 16, 32.

    Raises:
        ConfigError: There is no such size.
    """
    from transformers import Sam2HieraDetConfig
    from transformers.models.sam2.modeling_sam2 import Sam2HieraDetModel

    width, heads, blocks, global_blocks, windows, background = _size(size)
    config = Sam2HieraDetConfig(
        hidden_size=width,
        num_attention_heads=heads,
        blocks_per_stage=blocks,
        embed_dim_per_stage=channels_of(size),
        num_attention_heads_per_stage=[heads << stage for stage in range(4)],
        window_size_per_stage=windows,
        global_attention_blocks=global_blocks,
        window_positional_embedding_background_size=[background, background],
    )
    return Sam2HieraDetModel(config)


def _size(size: str) -> tuple[int, int, list[int], list[int], list[int], int]:
    if size not in _SIZES:
        raise ConfigError(f"segmenter.encoder={size} is not known.", nearest_names(size, _SIZES))
    return _SIZES[size]


def encoder_weights(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Returns the encoder's weights under transformers' names, whoever named them; all else is left out."""
    prefix = next((p for p in _PREFIXES if any(name.startswith(p) for name in weights)), "")
    renamed = {}
    for name, value in weights.items():
        if name.startswith(prefix):
            renamed[transformers_name(name.removeprefix(prefix))] = value
    return renamed


def transformers_name(name: str) -> str:
    """Returns an encoder's weight name as transformers has it; its own names stay as they are."""
    for pattern, replacement in _RENAMED:
        name = re.sub(pattern, replacement, name)
    return name


def stages_of(output: Any) -> list[Tensor]:
    """Returns the four feature maps of an encoder's output as (B, C, H, W), finest first."""
    return [features.permute(0, 3, 1, 2) for features in output.intermediate_hidden_states]


# ImageNet's mean and standard deviation, which SAM2 was trained with.
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
STRIDE = 32
_CHANNELS = 64
_BOTTLENECK = 32


class Adapter(nn.Module):
    """A frozen block whose input is corrected by a small trainable bottleneck."""

    def __init__(self, block: nn.Module, dim: int) -> None:
        super().__init__()
        self.block = block
        self.prompt_learn = nn.Sequential(
            nn.Linear(dim, _BOTTLENECK), nn.GELU(), nn.Linear(_BOTTLENECK, dim), nn.GELU()
        )

    def forward(self, features: Tensor, **options: Any) -> Tensor:
        """Returns the block's answer to features (B, H, W, C) plus their correction."""
        answer: Tensor = self.block(features + self.prompt_learn(features), **options)
        return answer


class _Conv(nn.Module):
    """A convolution with batch normalisation and nothing after it."""

    def __init__(
        self, inputs: int, outputs: int, kernel: int | tuple[int, int], padding: Any = 0, dilation: int = 1
    ) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, padding=padding, dilation=dilation, bias=False)
        self.bn = nn.BatchNorm2d(outputs)

    def forward(self, features: Tensor) -> Tensor:
        normalised: Tensor = self.bn(self.conv(features))
        return normalised


class ReceptiveFieldBlock(nn.Module):
    """Four branches that see 1, 3, 5 and 7 pixels, the larger ones dilated, down to 64 channels."""

    def __init__(self, inputs: int, outputs: int = _CHANNELS) -> None:
        super().__init__()
        self.branch0 = nn.Sequential(_Conv(inputs, outputs, 1))
        for number, side in enumerate((3, 5, 7), start=1):
            reach = side // 2
            branch = nn.Sequential(
                _Conv(inputs, outputs, 1),
                _Conv(outputs, outputs, (1, side), padding=(0, reach)),
                _Conv(outputs, outputs, (side, 1), padding=(reach, 0)),
                _Conv(outputs, outputs, 3, padding=side, dilation=side),
            )
            setattr(self, f"branch{number}", branch)
        self.conv_cat = _Conv(4 * outputs, outputs, 3, padding=1)
        self.conv_res = _Conv(inputs, outputs, 1)

    def forward(self, features: Tensor) -> Tensor:
        """Returns features (B, 64, H, W) of features (B, C, H, W)."""
        branches = [getattr(self, f"branch{number}")(features) for number in range(4)]
        return torch.relu(self.conv_cat(torch.cat(branches, dim=1)) + self.conv_res(features))


class _DoubleConv(nn.Module):
    def __init__(self, inputs: int, middle: int, outputs: int) -> None:
        super().__init__()
        self.double_conv = nn.Sequential(
            nn.Conv2d(inputs, middle, 3, padding=1, bias=False),
            nn.BatchNorm2d(middle),
            nn.ReLU(inplace=True),
            nn.Conv2d(middle, outputs, 3, padding=1, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
        )

    def forward(self, features: Tensor) -> Tensor:
        convolved: Tensor = self.double_conv(features)
        return convolved


class Up(nn.Module):
    """Doubles the coarser features, joins the finer ones, convolves twice."""

    def __init__(self) -> None:
        super().__init__()
        self.conv = _DoubleConv(2 * _CHANNELS, _CHANNELS, _CHANNELS)

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        """Returns features at the finer size."""
        doubled = F.interpolate(coarse, scale_factor=2, mode="bilinear", align_corners=True)
        below, right = (fine.shape[axis] - doubled.shape[axis] for axis in (2, 3))
        doubled = F.pad(doubled, (right // 2, right - right // 2, below // 2, below - below // 2))
        joined: Tensor = self.conv(torch.cat([fine, doubled], dim=1))
        return joined


class Sam2UNet(nn.Module):
    """The network of the paper's segmentation; only adapters and decoder are trained.

    Photos come in as (B, 3, H, W) float32 RGB in [0, 1], sides multiples of ``STRIDE``; out come three
    logits (B, 1, H, W), the finest head first.

    Args:
        size: Of the encoder: ``tiny``, ``small``, ``base_plus`` or ``large``.
    """

    def __init__(self, size: str = "large") -> None:
        super().__init__()
        self.register_buffer("mean", torch.tensor(MEAN)[:, None, None], persistent=False)
        self.register_buffer("deviation", torch.tensor(DEVIATION)[:, None, None], persistent=False)
        self.encoder = make_hiera(size)
        for weight in self.encoder.parameters():
            weight.requires_grad_(False)
        self.encoder.blocks = nn.ModuleList(Adapter(block, block.dim) for block in self.encoder.blocks)
        for number, channels in enumerate(channels_of(size), start=1):
            setattr(self, f"rfb{number}", ReceptiveFieldBlock(channels))
        self.up1, self.up2, self.up3 = Up(), Up(), Up()
        self.side1, self.side2, self.head = (nn.Conv2d(_CHANNELS, 1, 1) for _ in range(3))

    def forward(self, photos: Tensor) -> tuple[Tensor, ...]:
        """Returns the logits of the three heads, each at the photos' size."""
        stages = stages_of(self.encoder((photos - self.mean) / self.deviation))
        x1, x2, x3, x4 = (getattr(self, f"rfb{k}")(stage) for k, stage in enumerate(stages, start=1))
        merged = self.up1(x4, x3)
        first = F.interpolate(self.side1(merged), scale_factor=16, mode="bilinear")
        merged = self.up2(merged, x2)
        second = F.interpolate(self.side2(merged), scale_factor=8, mode="bilinear")
        merged = self.up3(merged, x1)
        finest = F.interpolate(self.head(merged), scale_factor=4, mode="bilinear")
        return finest, first, second


def fill_encoder(net: Sam2UNet, weights: Weights, source: str) -> None:
    """Puts SAM2's encoder weights, named by Meta or by transformers, under the adapters.

    Raises:
        ConfigError: They do not fit this size.
    """
    bare = type(net.encoder)(net.encoder.config)
    fill(bare, encoder_weights(weights), source)
    adapted = {_under_adapter(name): value for name, value in bare.state_dict().items()}
    net.encoder.load_state_dict(adapted, strict=False)


def whole_checkpoint(weights: Weights) -> Weights:
    """Returns a SAM2-UNet checkpoint under this module's names: the authors' or its own.

    The authors' ``up4`` is defined but never used, and left out.
    """
    named = {}
    for name, value in weights.items():
        if name.startswith("up4."):
            continue
        prefix, dot, rest = name.partition(".")
        named[f"encoder.{transformers_name(rest)}" if prefix == "encoder" and dot else name] = value
    return named


def _under_adapter(name: str) -> str:
    parts = name.split(".")
    return ".".join([*parts[:2], "block", *parts[2:]]) if parts[0] == "blocks" else name


class OneAgainstRest(nn.Module):
    """Photos (B, 3, H, W) in [0, 1] come in, a tuple of one, logits (B, 1, H, W), out.

    The sigmoid of the logit is the sum of the classes' softmax; the one class of a network that has no other
    is a logit already.

    Args:
        model: Answers with ``logits`` (B, classes, h, w) to normalised pictures.
        classes: Indices of the classes that count.
        mean: Of the pictures, red first.
        deviation: Likewise.
    """

    def __init__(
        self, model: nn.Module, classes: list[int], mean: Sequence[float], deviation: Sequence[float]
    ) -> None:
        super().__init__()
        self.model = model
        self.classes = classes
        self.register_buffer("mean", torch.tensor(mean)[:, None, None], persistent=False)
        self.register_buffer("deviation", torch.tensor(deviation)[:, None, None], persistent=False)

    def forward(self, photos: Tensor) -> tuple[Tensor, ...]:
        """Returns the logits at the photos' size."""
        scores = self.model((photos - self.mean) / self.deviation).logits
        scores = F.interpolate(scores, size=photos.shape[-2:], mode="bilinear")
        if scores.shape[1] == 1:
            return (scores,)
        rest = [k for k in range(scores.shape[1]) if k not in self.classes]
        wanted = scores[:, self.classes].logsumexp(dim=1, keepdim=True)
        return (wanted - scores[:, rest].logsumexp(dim=1, keepdim=True),)


# Meta's names (segment_anything/modeling) and those of transformers, in the order they are replaced.
_SAM1_RENAMED = (
    (r"^image_encoder\.", "vision_encoder."),
    (r"^vision_encoder\.blocks\.", "vision_encoder.layers."),
    (r"\.patch_embed\.proj\.", ".patch_embed.projection."),
    (r"^vision_encoder\.neck\.0\.", "vision_encoder.neck.conv1."),
    (r"^vision_encoder\.neck\.1\.", "vision_encoder.neck.layer_norm1."),
    (r"^vision_encoder\.neck\.2\.", "vision_encoder.neck.conv2."),
    (r"^vision_encoder\.neck\.3\.", "vision_encoder.neck.layer_norm2."),
    (r"\.norm([1-4])\.", r".layer_norm\1."),
    (r"\.norm_final_attn\.", ".layer_norm_final_attn."),
    (r"\.pe_layer\.positional_encoding_gaussian_matrix$", ".shared_embedding.positional_embedding"),
    (r"\.point_embeddings\.", ".point_embed."),
    (r"\.mask_downscaling\.0\.", ".mask_embed.conv1."),
    (r"\.mask_downscaling\.1\.", ".mask_embed.layer_norm1."),
    (r"\.mask_downscaling\.3\.", ".mask_embed.conv2."),
    (r"\.mask_downscaling\.4\.", ".mask_embed.layer_norm2."),
    (r"\.mask_downscaling\.6\.", ".mask_embed.conv3."),
    (r"\.output_upscaling\.0\.", ".upscale_conv1."),
    (r"\.output_upscaling\.1\.", ".upscale_layer_norm."),
    (r"\.output_upscaling\.3\.", ".upscale_conv2."),
)
# Perceptrons of three layers in the decoder: Meta counts them, transformers names the first and the last.
_LAYER = re.compile(
    r"^(mask_decoder\.(?:output_hypernetworks_mlps\.\d|iou_prediction_head))\.layers\.([012])\."
)
_LAYER_NAMES = {"0": "proj_in", "1": "layers.0", "2": "proj_out"}
# One tensor under two names: files hold either or both.
TIED = ("shared_image_embedding.positional_embedding", "prompt_encoder.shared_embedding.positional_embedding")


def transformers_names(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Returns SAM's weights as ``transformers.SamModel`` names them, the tied one under both its names."""
    is_metas = any(name.removeprefix("sam.").startswith("image_encoder.") for name in weights)
    named = {}
    for name, value in weights.items():
        name = name.removeprefix("sam.")
        named[_renamed(name) if is_metas else name] = value
    for there, wanted in (TIED, TIED[::-1]):
        if there in named:
            named.setdefault(wanted, named[there])
    return named


def _renamed(name: str) -> str:
    # Transformers has layers in its perceptrons, too: these first, while names are still Meta's.
    name = _LAYER.sub(lambda found: f"{found[1]}.{_LAYER_NAMES[found[2]]}.", name)
    for pattern, replacement in _SAM1_RENAMED:
        name = re.sub(pattern, replacement, name)
    return name


SAM1_STRIDE = 16
# Width, layers, heads and blocks of global attention of SAM's encoders.
_SAM1_SIZES = {
    "base": (768, 12, 12, (2, 5, 8, 11)),
    "large": (1024, 24, 16, (5, 11, 17, 23)),
    "huge": (1280, 32, 16, (7, 15, 23, 31)),
}
# The prompts are so much narrower than the encoder.
_NARROWING = 32
# Half width of the low frequencies taken out, against the whole spectrum's.
_LOW_SHARE = 0.25


def high_frequencies(photos: Tensor) -> Tensor:
    """Returns photos (B, 3, H, W) without the middle of their spectrum: edges and texture."""
    height, width = photos.shape[-2:]
    spectrum = torch.fft.fftshift(torch.fft.fft2(photos.float()), dim=(-2, -1))
    reach = int((height * width * _LOW_SHARE) ** 0.5 // 2)
    rows = slice(max(0, height // 2 - reach), height // 2 + reach)
    columns = slice(max(0, width // 2 - reach), width // 2 + reach)
    kept = torch.ones(height, width, device=photos.device)
    kept[rows, columns] = 0
    back = torch.fft.ifft2(torch.fft.ifftshift(spectrum * kept, dim=(-2, -1)))
    return back.real.abs()


class Sam1Adapter(nn.Module):
    """Photos (B, 3, S, S) float32 RGB in [0, 1] come in, a tuple of one, logits (B, 1, S, S), out.

    Args:
        size: Of the encoder: ``base``, ``large`` or ``huge``.
        side: S, a multiple of ``SAM1_STRIDE``; position embeddings are of this size.
    """

    def __init__(self, size: str = "huge", side: int = 1024) -> None:
        from transformers import SamConfig, SamModel, SamVisionConfig

        super().__init__()
        if size not in _SAM1_SIZES:
            raise ConfigError(f"segmenter.encoder={size} is not known.", nearest_names(size, _SAM1_SIZES))
        width, layers, heads, global_blocks = _SAM1_SIZES[size]
        vision = SamVisionConfig(
            hidden_size=width,
            num_hidden_layers=layers,
            num_attention_heads=heads,
            global_attn_indexes=list(global_blocks),
            image_size=side,
            mlp_dim=4 * width,
            # SAM is never trained from nothing; the library's own start, all but zero, answers nothing.
            initializer_range=0.02,
        )
        # Prompts at the size of the features; SAM's own are never given.
        config = SamConfig(vision_config=vision, initializer_range=0.02)
        config.prompt_encoder_config.image_size = side
        config.prompt_encoder_config.image_embedding_size = side // SAM1_STRIDE
        self.sam = SamModel(config)
        for weight in self.sam.parameters():
            weight.requires_grad_(False)
        for weight in self.sam.mask_decoder.parameters():
            weight.requires_grad_(True)
        narrow = width // _NARROWING
        self.embed_photo = nn.Linear(width, narrow)
        self.embed_edges = nn.Conv2d(3, narrow, SAM1_STRIDE, stride=SAM1_STRIDE)
        self.tune = nn.ModuleList(nn.Sequential(nn.Linear(narrow, narrow), nn.GELU()) for _ in range(layers))
        self.share = nn.Linear(narrow, width)
        self.register_buffer("mean", torch.tensor(MEAN)[:, None, None], persistent=False)
        self.register_buffer("deviation", torch.tensor(DEVIATION)[:, None, None], persistent=False)

    def forward(self, photos: Tensor) -> tuple[Tensor, ...]:
        """Returns the logits at the photos' size."""
        normalised = (photos - self.mean) / self.deviation
        sam = self.sam
        decoded = sam.mask_decoder(
            image_embeddings=self._embedded(normalised),
            image_positional_embeddings=sam.get_image_wide_positional_embeddings().repeat(
                len(photos), 1, 1, 1
            ),
            sparse_prompt_embeddings=photos.new_zeros(
                len(photos), 1, 0, sam.config.prompt_encoder_config.hidden_size
            ),
            dense_prompt_embeddings=sam.prompt_encoder.no_mask_embed.weight[:, :, None, None].expand(
                len(photos), -1, *sam.prompt_encoder.image_embedding_size
            ),
            multimask_output=False,
        )
        return (F.interpolate(decoded[0][:, 0], size=photos.shape[-2:], mode="bilinear"),)

    def _embedded(self, photos: Tensor) -> Tensor:
        """Returns the encoder's features (B, 256, H / 16, W / 16), its blocks prompted."""
        encoder = self.sam.vision_encoder
        tokens = encoder.patch_embed(photos)
        hints = self.embed_photo(tokens) + self.embed_edges(high_frequencies(photos)).permute(0, 2, 3, 1)
        tokens = tokens + encoder.pos_embed
        for layer, tune in zip(encoder.layers, self.tune, strict=True):
            answer = layer(tokens + self.share(tune(hints)))
            tokens = answer[0] if isinstance(answer, tuple) else answer
        features: Tensor = encoder.neck(tokens)
        return features


def fill_sam(net: Sam1Adapter, weights: Weights, source: str) -> None:
    """Puts SAM's weights, as Meta or transformers names them, below the prompts.

    Raises:
        ConfigError: They do not fit this size; position embeddings are brought to the network's.
    """
    wanted = net.sam.state_dict()
    own = {}
    for name, value in transformers_names(weights).items():
        if name not in wanted:
            own[name] = value
            continue
        if name.endswith("pos_embed") and value.shape[1:3] != wanted[name].shape[1:3]:
            grid = F.interpolate(value.permute(0, 3, 1, 2), size=wanted[name].shape[1:3], mode="bicubic")
            value = grid.permute(0, 2, 3, 1)
        elif ".rel_pos_" in name and value.shape != wanted[name].shape:
            value = F.interpolate(value.T[None], size=len(wanted[name]), mode="linear")[0].T
        own[name] = value
    fill(net.sam, own, source)
