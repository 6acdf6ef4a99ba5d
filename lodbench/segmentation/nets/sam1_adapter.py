"""SAM1-Adapter: SAM's frozen ViT with a prompt added before each block, and its mask decoder, trained.

After SAM-Adapter (arXiv 2304.09148): the prompts come from the embedded photo and its high
frequencies, through a small layer per block and one that all blocks share.
"""

from __future__ import annotations

import re

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lodbench.errors import ConfigError, nearest_names
from lodbench.segmentation.nets.sam2_unet import DEVIATION, MEAN
from lodbench.segmentation.nets.weights import Weights, fill

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


STRIDE = 16
# Width, layers, heads and blocks of global attention of SAM's encoders.
_SIZES = {
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
        side: S, a multiple of ``STRIDE``; position embeddings are of this size.
    """

    def __init__(self, size: str = "huge", side: int = 1024) -> None:
        from transformers import SamConfig, SamModel, SamVisionConfig

        super().__init__()
        if size not in _SIZES:
            raise ConfigError(f"segmenter.encoder={size} is not known.", nearest_names(size, _SIZES))
        width, layers, heads, global_blocks = _SIZES[size]
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
        config.prompt_encoder_config.image_embedding_size = side // STRIDE
        self.sam = SamModel(config)
        for weight in self.sam.parameters():
            weight.requires_grad_(False)
        for weight in self.sam.mask_decoder.parameters():
            weight.requires_grad_(True)
        narrow = width // _NARROWING
        self.embed_photo = nn.Linear(width, narrow)
        self.embed_edges = nn.Conv2d(3, narrow, STRIDE, stride=STRIDE)
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
