"""SAM's weights under the names of transformers, whether Meta, transformers or we named them."""

from __future__ import annotations

import re

from torch import Tensor

# Meta's names (segment_anything/modeling) and those of transformers, in the order they are replaced.
_RENAMED = (
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
    for pattern, replacement in _RENAMED:
        name = re.sub(pattern, replacement, name)
    return name
