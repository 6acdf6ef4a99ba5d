"""The small network: ONNX through OpenCV equals torch; the cache; faults of its weights."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from lodbench.cli.settings import in_syntax_of
from lodbench.datasets.query import Entry
from lodbench.errors import ConfigError, QueryFault
from lodbench.segmentation.compact import Compact, CompactParams
from lodbench.segmentation.probability import padded_photo, resized_photo, working_size

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


def test_faults_are_told_in_one_line(tmp_path):
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
