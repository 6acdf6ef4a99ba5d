"""RoMa: what is told where it cannot run; its matches by its own arithmetic where romatch is installed."""

import hashlib
import sys
from importlib.util import find_spec

import numpy as np
import pytest
from lodbench.baselines.mcloc.features import RomaMap

from lodbench.errors import ConfigError
from lodbench.matching import open_matcher, open_matching
from lodbench.matching.learned_matchers import roma_encoder_file, roma_files

torch = pytest.importorskip("torch")

NAMES = ("roma_outdoor.pth", "dinov2_vitl14_pretrain.pth")
SMALL = {"size": 112, "fine_size": 168, "threshold": 0.0}


@pytest.fixture(scope="module")
def romatch():
    """romatch; beside a torch that torchvision was not built for, with its operators named but not there."""
    if not find_spec("romatch"):
        pytest.skip("romatch is not installed: pip install 'lodbench[roma]' in an environment of its own")
    try:
        import torchvision  # noqa: F401
    except RuntimeError:
        operators = torch.library.Library("torchvision", "FRAGMENT")
        for name in ("roi_align", "ps_roi_align", "roi_pool", "ps_roi_pool", "deform_conv2d"):
            operators.define(f"{name}(Tensor x) -> Tensor")
            operators.define(f"_{name}_backward(Tensor x) -> Tensor")
        for name in ("nms", "qnms", "qroi_align"):
            operators.define(f"{name}(Tensor x) -> Tensor")
    return pytest.importorskip("romatch")


def pictures(*sizes):
    stream = np.random.default_rng(0)
    return [stream.integers(0, 255, (*size, 3), np.uint8) for size in sizes]


def test_without_romatch_a_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "torchvision", sys)
    monkeypatch.setitem(sys.modules, "romatch", None)
    with pytest.raises(ConfigError, match="roma needs romatch, which is not installed") as told:
        open_matching("roma", "random")
    assert "lodbench[roma]" in told.value.hint


def test_a_torchvision_built_for_another_torch_is_told_with_its_cure(monkeypatch, tmp_path):
    (tmp_path / "torchvision.py").write_text(
        "raise RuntimeError('operator torchvision::nms does not exist')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "torchvision", raising=False)
    with pytest.raises(
        ConfigError, match=r"torchvision, which does not work beside this torch \(.*nms"
    ) as told:
        open_matching("roma", "random")
    assert "--index-url" in told.value.hint


def test_weights_that_were_not_fetched_are_told_with_licence_and_size(monkeypatch, tmp_path):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    for look, missing in (
        (roma_files, "RoMa MIT, DINOv2 Apache-2.0; 1664 MB"),
        (roma_encoder_file, "RoMa MIT; 446 MB"),
    ):
        with pytest.raises(ConfigError, match=rf"roma-outdoor are not at .*models--.*\({missing}\)") as told:
            look(None)
        assert "hf download" in told.value.hint


def test_files_of_a_folder_are_taken_if_they_are_those(tmp_path):
    (tmp_path / NAMES[0]).write_bytes(b"matcher")
    assert roma_encoder_file(str(tmp_path)) == tmp_path / NAMES[0]
    with pytest.raises(ConfigError, match=rf"has no {NAMES[1]} \(DINOv2 Apache-2.0; 1218 MB\)"):
        roma_files(str(tmp_path))
    (tmp_path / NAMES[1]).write_bytes(b"dinov2")
    first, second = (hashlib.sha256(content).hexdigest() for content in (b"matcher", b"dinov2"))
    assert roma_files(f"{tmp_path}#sha256={first}+{second}") == [tmp_path / name for name in NAMES]
    with pytest.raises(ConfigError, match=f"{NAMES[1]} have the sha256 {second}, not {first}"):
        roma_files(f"{tmp_path}#sha256={first}+{first}")
    with pytest.raises(ConfigError, match="2 sha256 pin"):
        roma_encoder_file(f"{tmp_path}#sha256={first}+{second}")


@pytest.mark.parametrize("wrong", [{"size": 100}, {"size": 14}, {"fine_size": 8}, {"threshold": 1.0}])
def test_settings_out_of_range_are_refused(wrong):
    with pytest.raises(ConfigError):
        open_matcher("roma", **wrong)


def test_the_encoders_features_are_those_of_its_file(tmp_path):
    shown = np.stack(pictures((32, 48), (32, 48)))
    features = RomaMap("random")
    found = features(shown)
    assert found.shape == (2, 4, 6, 512)
    assert np.linalg.norm(found, axis=3) == pytest.approx(1.0, abs=1e-4)
    stored = {f"encoder.cnn.layers.{key}": value for key, value in features._net.state_dict().items()}
    torch.save({**stored, "decoder.scale": torch.zeros(1)}, tmp_path / NAMES[0])
    torch.manual_seed(1)
    again = RomaMap(str(tmp_path))
    assert again.weight_files() == [tmp_path / NAMES[0]]
    assert np.array_equal(again(shown), found)
    torch.save({"encoder.cnn.layers.0.weight": torch.zeros(64, 3, 5, 5)}, tmp_path / NAMES[0])
    with pytest.raises(ConfigError, match="does not fit the network"):
        RomaMap(str(tmp_path))


@pytest.mark.slow
def test_the_encoder_is_romatchs(romatch):
    from romatch.models.encoders import VGG19

    features = RomaMap("random")
    theirs = VGG19(pretrained=False).eval()
    theirs.layers.load_state_dict(features._net.state_dict())
    (shown,) = pictures((32, 48))
    blob = (shown / 255 - (0.485, 0.456, 0.406)) / (0.229, 0.224, 0.225)
    with torch.inference_mode():
        wanted = theirs(torch.from_numpy(blob.transpose(2, 0, 1)[None]).float())[8]
    wanted = torch.nn.functional.normalize(wanted)[0].permute(1, 2, 0).numpy()
    assert features(shown[None])[0] == pytest.approx(wanted, abs=1e-5)


@pytest.mark.slow
def test_matches_are_romatchs_in_pixels_and_weights_are_read_back(romatch, tmp_path):
    first, second = pictures((90, 120), (100, 150))
    matcher = open_matcher("roma", weights="random", **SMALL, max_matches=200)
    found = matcher.match(first, second)
    assert len(found.first) == 200
    assert np.array_equal(matcher.match(first, second).second, found.second)

    from PIL import Image

    net = matcher._net
    warp, certainty = net.match(Image.fromarray(first), Image.fromarray(second))
    sides = net.to_pixel_coordinates(warp.reshape(-1, 4), 90, 120, 100, 150)
    wanted = np.column_stack([*(side.numpy() for side in sides), certainty.reshape(-1).numpy()])
    ours = np.column_stack([found.first, found.second, found.scores])
    every = {tuple(row) for row in np.round(wanted, 3).tolist()}
    assert sum(tuple(row) in every for row in np.round(ours, 3).tolist()) > 190

    for name, part in zip(NAMES, (net, net.encoder.dinov2_vitl14[0]), strict=True):
        torch.save(part.state_dict(), tmp_path / name)
    stored = open_matcher("roma", weights=str(tmp_path), **SMALL, max_matches=200)
    assert [file.name for file in stored.weight_files()] == list(NAMES)
    torch.manual_seed(1)
    assert np.array_equal(stored.match(first, second).first, found.first)
    torch.save({"encoder.cnn.layers.0.bias": torch.zeros(64)}, tmp_path / NAMES[0])
    with pytest.raises(ConfigError, match="does not fit the network"):
        open_matcher("roma", weights=str(tmp_path), **SMALL).match(first, second)
