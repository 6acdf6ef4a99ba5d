"""SAM2's Hiera encoder from transformers, in its four sizes, with the names of its published weights."""

from __future__ import annotations

import re
from typing import Any

from torch import Tensor, nn

from lodbench.errors import ConfigError, nearest_names

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
    found = {}
    for name, value in weights.items():
        if name.startswith(prefix):
            found[transformers_name(name.removeprefix(prefix))] = value
    return found


def transformers_name(name: str) -> str:
    """Returns an encoder's weight name as transformers has it; its own names stay as they are."""
    for pattern, replacement in _RENAMED:
        name = re.sub(pattern, replacement, name)
    return name


def stages_of(output: Any) -> list[Tensor]:
    """Returns the four feature maps of an encoder's output as (B, C, H, W), finest first."""
    return [features.permute(0, 3, 1, 2) for features in output.intermediate_hidden_states]
