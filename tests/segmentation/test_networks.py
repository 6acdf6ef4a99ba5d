"""The paper's networks with random weights: shapes, names of published weights, faults, memory."""

import pickle

import cv2
import numpy as np
import pytest

from lodbench.errors import ConfigError, QueryFault
from lodbench.segmentation import torch_segmenter
from lodbench.segmentation.probability import MemoryTiles, tiled

torch = pytest.importorskip("torch", reason="torch is not installed (extra [torch])")
pytest.importorskip("transformers", reason="transformers is not installed (extra [models])")

from lodbench.segmentation.nets import sam  # noqa: E402
from lodbench.segmentation.nets.sam import Sam1Adapter, fill_sam, high_frequencies  # noqa: E402
from lodbench.segmentation.nets.weights import fill, read_weights, save_weights  # noqa: E402
from lodbench.segmentation.torch_segmenter import Sam2UNetParams, Sam2UNetSegmenter  # noqa: E402


@pytest.fixture(scope="module")
def small():
    """The network on an encoder of a few thousand weights."""
    sam._SIZES["toy"] = (16, 1, [1, 1, 2, 1], [3], [8, 4, 4, 4], 7)
    torch.manual_seed(0)
    yield sam.Sam2UNet("toy").eval()
    del sam._SIZES["toy"]


def photo_of(height, width):
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


def meta_name(name):
    """Meta's name of an encoder weight that transformers names so."""
    name = name.replace("patch_embed.projection", "patch_embed.proj")
    name = name.replace("layer_norm1", "norm1").replace("layer_norm2", "norm2")
    return name.replace("mlp.proj_in", "mlp.layers.0").replace("mlp.proj_out", "mlp.layers.1")


@pytest.mark.slow
def test_the_large_network_has_the_papers_size():
    with torch.device("meta"):
        net = sam.Sam2UNet("large")
    assert sam.channels_of("large") == [144, 288, 576, 1152]
    assert sum(weight.numel() for weight in net.parameters()) == 216_419_043
    assert sum(weight.numel() for weight in net.parameters() if weight.requires_grad) == 4_269_747


@pytest.mark.slow
def test_three_heads_answer_at_the_photos_size(small):
    with torch.no_grad():
        outputs = small(torch.rand(2, 3, 64, 96))
    assert [tuple(output.shape) for output in outputs] == [(2, 1, 64, 96)] * 3


def test_only_adapters_and_decoder_are_trained(small):
    frozen = {name for name, weight in small.named_parameters() if not weight.requires_grad}
    assert frozen
    assert all(name.startswith("encoder.") and "prompt_learn" not in name for name in frozen)
    trained = {name for name, weight in small.named_parameters() if weight.requires_grad}
    assert not [name for name in trained if name.startswith("encoder.") and "prompt_learn" not in name]


@pytest.mark.parametrize("source", ["meta", "transformers"])
def test_encoder_weights_are_found_whoever_named_them(small, source):
    bare = sam.make_hiera("toy")
    if source == "meta":
        named = {f"image_encoder.trunk.{meta_name(k)}": v for k, v in bare.state_dict().items()}
    else:
        named = {f"vision_encoder.backbone.{k}": v for k, v in bare.state_dict().items()}
    named["mask_decoder.weight"] = torch.zeros(3)
    net = sam.Sam2UNet("toy")
    sam.fill_encoder(net, named, "file")
    filled = net.encoder.blocks[1].block.mlp.proj_in.weight
    assert torch.equal(filled, bare.blocks[1].mlp.proj_in.weight)
    assert torch.equal(net.encoder.pos_embed, bare.pos_embed)


def test_the_authors_checkpoints_can_be_read(small, tmp_path):
    authors = {meta_name(name): value for name, value in small.state_dict().items()}
    assert "encoder.blocks.0.block.norm1.weight" in authors
    assert "encoder.blocks.0.prompt_learn.0.weight" in authors
    assert "rfb1.branch3.3.conv.weight" in authors
    authors["up4.conv.double_conv.0.weight"] = torch.zeros(3)
    torch.save(authors, tmp_path / "SAM2-UNet.pth")
    segmenter = Sam2UNetSegmenter(
        Sam2UNetParams(encoder="toy", size=64, weights=str(tmp_path / "SAM2-UNet.pth"))
    )
    photo = photo_of(40, 60)
    found = segmenter.logits(photo)
    assert found.shape == (43, 64)
    save_weights(small, tmp_path / "own.safetensors")
    again = Sam2UNetSegmenter(
        Sam2UNetParams(encoder="toy", size=64, weights=str(tmp_path / "own.safetensors"))
    )
    assert (again.logits(photo) == found).all()
    assert segmenter.notes() == ()
    assert segmenter.weights_digest != again.weights_digest


def test_random_weights_say_so(small, capsys):
    segmenter = Sam2UNetSegmenter(Sam2UNetParams(encoder="toy", size=64, weights="random"))
    assert segmenter.weights_digest == "random"
    assert "INVALID" in capsys.readouterr().err
    assert "random weights" in segmenter.notes()[0]


def test_no_weights_are_no_random_ones(small):
    with pytest.raises(ConfigError, match="comes without weights") as told:
        _ = Sam2UNetSegmenter(Sam2UNetParams(encoder="toy", size=64)).weights_digest
    assert "segmenter.weights=random" in told.value.hint


def test_a_missing_encoder_is_reported_by_its_own_setting(small):
    segmenter = Sam2UNetSegmenter(Sam2UNetParams(encoder="toy", size=64, encoder_weights="no.pt"))
    with pytest.raises(ConfigError, match=r"no weights no\.pt") as told:
        segmenter.build(None)
    assert "segmenter.encoder_weights=" in told.value.hint


def test_what_does_not_fit_into_memory_is_reported_before_it_is_built(monkeypatch):
    monkeypatch.setattr(torch_segmenter, "free_bytes", lambda: 500 << 20)
    with pytest.raises(ConfigError, match=r"need 0\.8 GiB of memory, 0\.5 GiB are free"):
        Sam2UNetSegmenter(Sam2UNetParams(encoder="large")).build(None)
    monkeypatch.setattr(torch_segmenter, "free_bytes", lambda: None)
    torch_segmenter.require_memory("any", 1 << 60)


def test_wrong_weights_get_a_report_of_shapes(small, tmp_path):
    save_weights(small, tmp_path / "toy.safetensors")
    params = Sam2UNetParams(encoder="tiny", size=64, weights=str(tmp_path / "toy.safetensors"))
    with pytest.raises(ConfigError, match=r"missing: .* shape: encoder\.pos_embed is \[1, 16, 7, 7\]"):
        Sam2UNetSegmenter(params).logits(photo_of(64, 64))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda w: w.to(torch.int8), "of whole numbers: "),
        (lambda w: w * float("nan"), "holds NaN or infinity"),
    ],
)
def test_quantised_and_damaged_weights_are_no_weights(change, said):
    net = torch.nn.Linear(2, 1)
    before = net.weight.clone()
    with pytest.raises(ConfigError, match=said):
        fill(net, {name: change(value.detach()) for name, value in net.state_dict().items()}, "w.pt")
    assert torch.equal(net.weight, before)


def test_weights_of_few_bits_are_weights():
    net = torch.nn.Linear(2, 1)
    stored = {
        name: torch.ones_like(value).to(torch.float8_e4m3fn) for name, value in net.state_dict().items()
    }
    fill(net, stored, "w.pt")
    assert torch.equal(net.weight, torch.ones(1, 2))
    stored["bias"] = torch.full((1,), float("nan")).to(torch.float8_e4m3fn)
    with pytest.raises(ConfigError, match="holds NaN or infinity"):
        fill(net, stored, "w.pt")


@pytest.mark.parametrize("lacking", [torch.zeros(1, 2).to_sparse(), torch.empty(1, 2, device="meta")])
def test_tensors_without_all_of_their_numbers_are_no_weights(lacking, tmp_path):
    torch.save({"weight": lacking}, tmp_path / "w.pt")
    with pytest.raises(ConfigError, match="holds no weights by name"):
        read_weights(tmp_path / "w.pt")


@pytest.mark.filterwarnings("error")
def test_a_pickle_is_refused_without_a_word_of_torch(tmp_path):
    (tmp_path / "w.pt").write_bytes(pickle.dumps({"a": [1]}, protocol=4))
    with pytest.raises(ConfigError, match=r"w\.pt cannot be read as weights \(UnpicklingError\)"):
        read_weights(tmp_path / "w.pt")


def test_missing_hub_access_is_reported_in_one_line():
    params = Sam2UNetParams(weights="facebook/no-such-model")
    with pytest.raises(
        ConfigError, match=r"facebook/no-such-model are not at .*models--facebook--no-such"
    ) as told:
        _ = Sam2UNetSegmenter(params).weights_digest
    assert "licence" in told.value.hint
    assert "hf download facebook/no-such-model" in told.value.hint


@pytest.mark.parametrize("device", ["cuda:99", "gpu"])
def test_a_device_that_is_not_there_is_reported(small, device):
    params = Sam2UNetParams(encoder="toy", size=64, weights="random", device=device)
    with pytest.raises(ConfigError, match=f"segmenter.device={device} is not there") as told:
        Sam2UNetSegmenter(params).logits(photo_of(64, 64))
    assert "segmenter.device=cpu" in told.value.hint


@pytest.mark.slow
def test_out_of_memory_falls_to_tiles(small, capsys):
    segmenter = Sam2UNetSegmenter(Sam2UNetParams(encoder="toy", size=512, normalise="none", weights="random"))
    run, sides = segmenter._run, []

    def short_of_memory(tile):
        sides.append(max(tile.shape[:2]))
        if sides[-1] > 400:
            raise RuntimeError("CUDA out of memory. Tried to allocate 20.00 GiB")
        return run(tile)

    segmenter._run = short_of_memory
    assert segmenter.logits(photo_of(60, 60)).shape == (512, 512)
    assert sides[0] == 512
    assert max(sides[1:]) <= 400
    assert "2 x 2 tiles" in capsys.readouterr().err
    segmenter._run = lambda tile: (_ for _ in ()).throw(MemoryError())
    with pytest.raises(QueryFault, match="runs out of memory"):
        segmenter.logits(photo_of(60, 60))


def test_other_faults_of_the_network_are_not_hidden(small):
    segmenter = Sam2UNetSegmenter(Sam2UNetParams(encoder="toy", size=64))
    segmenter._run = lambda tile: (_ for _ in ()).throw(RuntimeError("a bug"))
    with pytest.raises(RuntimeError, match="a bug"):
        segmenter.logits(photo_of(60, 60))


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("CUDA out of memory"),
        RuntimeError("DefaultCPUAllocator: not enough memory"),
        cv2.error("OpenCV(5.0.0) alloc.cpp:73: error: (-4:Insufficient memory) Failed to allocate 9 bytes"),
    ],
)
def test_memory_has_run_out_whoever_says_so(error):
    sides = []

    def short_of_memory(tile):
        sides.append(len(tile))
        if len(tile) > 128:
            raise error
        return tile[..., 0].astype(np.float32)

    photo = photo_of(128, 224)
    found = MemoryTiles("net", 224, 32).run(np.vstack([photo, photo]), short_of_memory)
    np.testing.assert_allclose(found, np.vstack([photo, photo])[..., 0], rtol=1e-5)
    assert sides[0] == 256


@pytest.mark.parametrize("parts", [1, 2, 4])
def test_tiles_join_without_seams(parts):
    photo = photo_of(320, 448)
    joined = tiled(photo, parts, 32, lambda tile: tile.astype(np.float32).sum(axis=2))
    np.testing.assert_allclose(joined, photo.astype(np.float32).sum(axis=2), rtol=1e-5)


def test_sam1_is_prompted_before_each_block(monkeypatch):

    monkeypatch.setitem(sam._SAM1_SIZES, "toy", (64, 2, 2, (1,)))
    torch.manual_seed(0)
    net = Sam1Adapter("toy", 64).eval()
    photos = torch.rand(2, 3, 64, 64)
    with torch.no_grad():
        (logits,) = net(photos)
        net.tune[1][0].weight.zero_()
        net.tune[1][0].bias.zero_()
        (changed,) = net(photos)
    assert logits.shape == (2, 1, 64, 64)
    assert not torch.equal(logits, changed)
    trained = [name for name, weight in net.named_parameters() if weight.requires_grad]
    assert any("mask_decoder" in name for name in trained)
    assert not any("vision_encoder" in name for name in trained)
    other = Sam1Adapter("toy", 128)
    fill_sam(other, net.sam.state_dict(), "file")
    assert torch.equal(other.sam.vision_encoder.neck.conv1.weight, net.sam.vision_encoder.neck.conv1.weight)


def test_high_frequencies_forget_what_is_even():
    even = torch.full((1, 3, 32, 32), 0.7)
    assert float(high_frequencies(even).max()) < 1e-5
    board = (torch.arange(32)[:, None] + torch.arange(32)) % 2
    assert float(high_frequencies(board.float().expand(1, 3, 32, 32)).mean()) > 0.4
