"""Layouts of published checkpoints, name by name after their authors' code: each loads, or says why."""

import pytest

torch = pytest.importorskip("torch", reason="torch is not installed (extra [torch])")
pytest.importorskip("transformers", reason="transformers is not installed (extra [models])")

from lodbench.errors import ConfigError  # noqa: E402
from lodbench.segmentation.nets import sam  # noqa: E402
from lodbench.segmentation.nets.sam import TIED, Sam1Adapter, fill_sam, transformers_names  # noqa: E402
from lodbench.segmentation.nets.weights import fill  # noqa: E402

# Meta's sam2_hiera_*.yaml: width, heads, blocks of the stages, windows, background of the position embedding.
HIERAS = {
    "tiny": (96, 1, (1, 2, 7, 2), 8, 7),
    "small": (96, 1, (1, 2, 11, 2), 8, 7),
    "base_plus": (112, 2, (2, 3, 16, 3), 8, 14),
    "large": (144, 2, (2, 6, 36, 4), 8, 7),
}
# Meta's build_sam.py: width, depth, heads, blocks of global attention.
VITS = {
    "base": (768, 12, 12, (2, 5, 8, 11)),
    "large": (1024, 24, 16, (5, 11, 17, 23)),
    "huge": (1280, 32, 16, (7, 15, 23, 31)),
}


def both(name, *shape):
    """A layer's weight of a shape, and its bias."""
    return {f"{name}.weight": shape, f"{name}.bias": shape[:1]}


def hiera_layout(size):
    """Names and shapes of SAM2's image encoder in Meta's files, without their prefix."""
    width, _, stages, window, background = HIERAS[size]
    layout = {"pos_embed": (1, width, background, background), "pos_embed_window": (1, width, window, window)}
    layout |= both("patch_embed.proj", width, 3, 7, 7)
    number, inner = 0, width
    for stage, blocks in enumerate(stages):
        for block in range(blocks):
            outer, name = width << stage, f"blocks.{number}"
            layout |= both(f"{name}.norm1", inner)
            layout |= both(f"{name}.attn.qkv", 3 * outer, inner)
            layout |= both(f"{name}.attn.proj", outer, outer)
            layout |= both(f"{name}.norm2", outer)
            layout |= both(f"{name}.mlp.layers.0", 4 * outer, outer)
            layout |= both(f"{name}.mlp.layers.1", outer, 4 * outer)
            if stage and not block:
                layout |= both(f"{name}.proj", outer, inner)
            inner, number = outer, number + 1
    return layout


def normalised(name, *shape):
    """A convolution without bias and its batch normalisation."""
    norm = {f"{name}.bn.{part}": shape[:1] for part in ("weight", "bias", "running_mean", "running_var")}
    return {f"{name}.conv.weight": shape, **norm, f"{name}.bn.num_batches_tracked": ()}


def sam2_unet_layout():
    """Names and shapes of SAM2-UNet-*.pth (WZH0120/SAM2-UNet), which are of the large encoder alone."""
    layout = {}
    for name, shape in hiera_layout("large").items():
        head, _, rest = name.partition(".")
        if head == "blocks":
            number, _, rest = rest.partition(".")
            layout[f"encoder.blocks.{number}.block.{rest}"] = shape
        else:
            layout[f"encoder.{name}"] = shape
    for number, stage in enumerate(stage for stage, count in enumerate((2, 6, 36, 4)) for _ in range(count)):
        # The adapter sees what comes in: the first block of a stage still has the channels of the one before.
        dim = layout[f"encoder.blocks.{number}.block.norm1.weight"][0]
        assert dim in (144 << stage, 72 << stage)
        layout |= both(f"encoder.blocks.{number}.prompt_learn.0", 32, dim)
        layout |= both(f"encoder.blocks.{number}.prompt_learn.2", dim, 32)
    for level, channels in enumerate((144, 288, 576, 1152), start=1):
        rfb = f"rfb{level}"
        layout |= normalised(f"{rfb}.branch0.0", 64, channels, 1, 1)
        for branch, side in enumerate((3, 5, 7), start=1):
            layout |= normalised(f"{rfb}.branch{branch}.0", 64, channels, 1, 1)
            layout |= normalised(f"{rfb}.branch{branch}.1", 64, 64, 1, side)
            layout |= normalised(f"{rfb}.branch{branch}.2", 64, 64, side, 1)
            layout |= normalised(f"{rfb}.branch{branch}.3", 64, 64, 3, 3)
        layout |= normalised(f"{rfb}.conv_cat", 64, 256, 3, 3)
        layout |= normalised(f"{rfb}.conv_res", 64, channels, 1, 1)
    for up in (f"up{number}.conv.double_conv" for number in (1, 2, 3, 4)):
        for first, inputs in ((0, 128), (3, 64)):
            layout[f"{up}.{first}.weight"] = (64, inputs, 3, 3)
            norm = f"{up}.{first + 1}"
            layout |= {f"{norm}.{part}": (64,) for part in ("weight", "bias", "running_mean", "running_var")}
            layout[f"{norm}.num_batches_tracked"] = ()
    for head in ("side1", "side2", "head"):
        layout |= both(head, 1, 64, 1, 1)
    return layout


def sam_layout(size):
    """Names and shapes of sam_vit_*.pth (facebookresearch/segment-anything)."""
    width, depth, heads, global_blocks = VITS[size]
    encoder = "image_encoder"
    layout = {
        f"{encoder}.pos_embed": (1, 64, 64, width),
        **both(f"{encoder}.patch_embed.proj", width, 3, 16, 16),
    }
    for number in range(depth):
        name, side = f"{encoder}.blocks.{number}", 64 if number in global_blocks else 14
        layout |= both(f"{name}.norm1", width) | both(f"{name}.norm2", width)
        layout |= {f"{name}.attn.rel_pos_{axis}": (2 * side - 1, width // heads) for axis in "hw"}
        layout |= both(f"{name}.attn.qkv", 3 * width, width) | both(f"{name}.attn.proj", width, width)
        layout |= both(f"{name}.mlp.lin1", 4 * width, width) | both(f"{name}.mlp.lin2", width, 4 * width)
    layout |= {f"{encoder}.neck.0.weight": (256, width, 1, 1), f"{encoder}.neck.2.weight": (256, 256, 3, 3)}
    layout |= both(f"{encoder}.neck.1", 256) | both(f"{encoder}.neck.3", 256)
    prompt = "prompt_encoder"
    layout[f"{prompt}.pe_layer.positional_encoding_gaussian_matrix"] = (2, 128)
    layout |= {f"{prompt}.point_embeddings.{k}.weight": (1, 256) for k in range(4)}
    layout |= {f"{prompt}.{name}.weight": (1, 256) for name in ("not_a_point_embed", "no_mask_embed")}
    layout |= both(f"{prompt}.mask_downscaling.0", 4, 1, 2, 2) | both(f"{prompt}.mask_downscaling.1", 4)
    layout |= both(f"{prompt}.mask_downscaling.3", 16, 4, 2, 2) | both(f"{prompt}.mask_downscaling.4", 16)
    layout |= both(f"{prompt}.mask_downscaling.6", 256, 16, 1, 1)
    decoder = "mask_decoder"
    layout |= {f"{decoder}.iou_token.weight": (1, 256), f"{decoder}.mask_tokens.weight": (4, 256)}
    layout |= both(f"{decoder}.output_upscaling.1", 64)
    for name, shape in (("0", (256, 64, 2, 2)), ("3", (64, 32, 2, 2))):
        layout[f"{decoder}.output_upscaling.{name}.weight"] = shape
        layout[f"{decoder}.output_upscaling.{name}.bias"] = shape[1:2]
    for name, last in [
        *((f"output_hypernetworks_mlps.{k}", 32) for k in range(4)),
        ("iou_prediction_head", 4),
    ]:
        for layer, outputs in enumerate((256, 256, last)):
            layout |= both(f"{decoder}.{name}.layers.{layer}", outputs, 256)
    blocks = [f"{decoder}.transformer.layers.{k}" for k in range(2)]
    attentions = [(f"{block}.self_attn", 256) for block in blocks]
    attentions += [
        (f"{b}.cross_attn_{way}", 128) for b in blocks for way in ("token_to_image", "image_to_token")
    ]
    attentions.append((f"{decoder}.transformer.final_attn_token_to_image", 128))
    for name, inner in attentions:
        for part in ("q_proj", "k_proj", "v_proj"):
            layout |= both(f"{name}.{part}", inner, 256)
        layout |= both(f"{name}.out_proj", 256, inner)
    for block in blocks:
        layout |= both(f"{block}.mlp.lin1", 2048, 256) | both(f"{block}.mlp.lin2", 256, 2048)
        for norm in range(1, 5):
            layout |= both(f"{block}.norm{norm}", 256)
    return layout | both(f"{decoder}.transformer.norm_final_attn", 256)


def weights_of(layout, prefix=""):
    """Weights without memory: only their names and shapes matter."""
    return {prefix + name: torch.empty(shape, device="meta") for name, shape in layout.items()}


@pytest.mark.parametrize("size", list(HIERAS))
def test_metas_sam2_encoder_fits_name_by_name(size):
    with torch.device("meta"):
        net = sam.make_hiera(size)
    published = weights_of(hiera_layout(size), "image_encoder.trunk.")
    published["image_encoder.neck.convs.0.conv.weight"] = torch.empty(256, 1, 1, 1, device="meta")
    published["sam_mask_decoder.iou_token.weight"] = torch.empty(1, 256, device="meta")
    found = sam.encoder_weights(published)
    assert {name: value.shape for name, value in found.items()} == {
        name: value.shape for name, value in net.state_dict().items()
    }


def test_the_sam2_encoder_of_another_size_is_distinguished():
    with torch.device("meta"):
        net = sam.make_hiera("tiny")
    with pytest.raises(ConfigError, match=r"does not fit the network: .*missing"):
        fill(net, sam.encoder_weights(weights_of(hiera_layout("base_plus"), "image_encoder.trunk.")), "file")


def test_the_authors_sam2_unet_fits_name_by_name():
    with torch.device("meta"):
        net = sam.Sam2UNet("large")
    found = sam.whole_checkpoint(weights_of(sam2_unet_layout()))
    assert {name: tuple(value.shape) for name, value in found.items()} == {
        name: tuple(value.shape) for name, value in net.state_dict().items()
    }


@pytest.mark.parametrize("size", list(VITS))
def test_metas_sam_fits_name_by_name(size):
    with torch.device("meta"):
        net = Sam1Adapter(size, 1024)
    found = transformers_names(weights_of(sam_layout(size)))
    assert {name: tuple(value.shape) for name, value in found.items()} == {
        name: tuple(value.shape) for name, value in net.sam.state_dict().items()
    }


def test_metas_sam_is_brought_to_another_side(monkeypatch):

    monkeypatch.setitem(VITS, "toy", (32, 2, 2, (1,)))
    monkeypatch.setitem(sam._SAM1_SIZES, "toy", (32, 2, 2, (1,)))
    net = Sam1Adapter("toy", 256)
    generator = torch.Generator().manual_seed(0)
    published = {name: torch.randn(shape, generator=generator) for name, shape in sam_layout("toy").items()}
    fill_sam(net, published, "sam_vit_toy.pth")
    own = net.sam.state_dict()
    assert torch.equal(
        own["vision_encoder.layers.0.attn.qkv.weight"], published["image_encoder.blocks.0.attn.qkv.weight"]
    )
    assert own["vision_encoder.pos_embed"].shape == (1, 16, 16, 32)
    matrix = published["prompt_encoder.pe_layer.positional_encoding_gaussian_matrix"]
    assert all(torch.equal(own[name], matrix) for name in TIED)
    head = "mask_decoder.iou_prediction_head"
    assert torch.equal(own[f"{head}.proj_out.weight"], published[f"{head}.layers.2.weight"])
    with torch.no_grad():
        assert net.eval()(torch.rand(1, 3, 256, 256))[0].shape == (1, 1, 256, 256)


def test_transformers_sam_folder_holds_its_tied_weight_once(tmp_path, monkeypatch):
    """What ``save_pretrained`` writes, and so what the hub holds, has one of the two names."""
    from safetensors.torch import load_file

    monkeypatch.setitem(sam._SAM1_SIZES, "toy", (32, 2, 2, (1,)))
    given, net = Sam1Adapter("toy", 64), Sam1Adapter("toy", 64)
    given.sam.save_pretrained(tmp_path)
    stored = load_file(tmp_path / "model.safetensors")
    assert sum(name in stored for name in TIED) == 1
    fill_sam(net, stored, "folder")
    assert torch.equal(net.sam.state_dict()[TIED[1]], given.sam.state_dict()[TIED[0]])
