"""Checkpoints of strangers: classes by name, what they say of photos, and what they lack."""

import json
import shutil

import numpy as np
import pytest

from lodbench.errors import ConfigError

torch = pytest.importorskip("torch", reason="torch is not installed (extra [torch])")
pytest.importorskip("transformers", reason="transformers is not installed (extra [models])")

from lodbench.segmentation.semantic import Semantic, SemanticParams  # noqa: E402


def photo_of(height, width):
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


def config_of(labels):
    from transformers import SegformerConfig

    return SegformerConfig(
        depths=[1, 1, 1, 1], hidden_sizes=[8, 16, 16, 16], decoder_hidden_size=16, num_labels=len(labels),
        id2label=dict(enumerate(labels)), num_attention_heads=[1, 1, 1, 1],
    )  # fmt: skip


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    from transformers import SegformerForSemanticSegmentation

    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("segformer")
    SegformerForSemanticSegmentation(config_of(["road", "building", "house", "sky"])).save_pretrained(folder)
    return folder


def test_classes_by_name_sum_their_probabilities(checkpoint):
    photo = photo_of(48, 64)
    one, two, both = (
        Semantic(SemanticParams(str(checkpoint), classes=names, size=64)).probability(photo)
        for names in (["building"], ["house"], ["building", "house"])
    )
    assert both.shape == (48, 64)
    np.testing.assert_allclose(one + two, both, atol=1e-5)
    assert both.std() > 1e-5


def test_an_unknown_class_or_folder_is_reported(checkpoint, tmp_path):
    with pytest.raises(ConfigError, match="no class 'bulding'") as told:
        Semantic(SemanticParams(str(checkpoint), classes=["bulding"])).logits(photo_of(32, 32))
    assert "building" in told.value.hint
    with pytest.raises(ConfigError, match="no semantic segmentation network"):
        Semantic(SemanticParams(str(tmp_path))).logits(photo_of(32, 32))
    file = tmp_path / "net.onnx"
    file.write_bytes(b"")
    # Neither is taken for a repository of the hub.
    for weights, said in ((str(file), "is not a folder"), ("nets/net.onnx", "There is no folder")):
        with pytest.raises(ConfigError, match=said) as told:
            Semantic(SemanticParams(weights))
        assert "huggingface" not in told.value.hint


def probability(folder, *classes, size=64):
    return Semantic(SemanticParams(str(folder), classes=list(classes), size=size)).probability(
        photo_of(48, 64)
    )


def test_the_only_class_is_no_certainty_and_all_classes_are_refused(checkpoint, tmp_path):
    from transformers import SegformerForSemanticSegmentation

    torch.manual_seed(0)
    network = SegformerForSemanticSegmentation(config_of(["building"])).eval()
    network.save_pretrained(tmp_path)
    found = probability(tmp_path, "building")
    assert 0.05 < found.min() < found.max() < 0.95
    with pytest.raises(ConfigError, match="names all classes"):
        probability(checkpoint, "road", "building", "house", "sky")


def test_classes_of_one_name_count_together(checkpoint, tmp_path):
    shutil.copytree(checkpoint, tmp_path, dirs_exist_ok=True)
    config = json.loads((tmp_path / "config.json").read_text())
    config["id2label"]["2"] = "building"
    (tmp_path / "config.json").write_text(json.dumps(config))
    np.testing.assert_allclose(
        probability(tmp_path, "building"), probability(checkpoint, "building", "house"), atol=1e-6
    )


def test_a_backbone_alone_is_no_network(tmp_path, capfd):
    from transformers import SegformerModel

    SegformerModel(config_of(["road", "building"])).save_pretrained(tmp_path)
    capfd.readouterr()
    with pytest.raises(ConfigError, match=r"lacks \d+ weights of the network: decode_head"):
        probability(tmp_path, "building")
    assert capfd.readouterr().err == ""


def test_a_file_that_was_cut_off_is_reported(checkpoint, tmp_path):
    shutil.copytree(checkpoint, tmp_path, dirs_exist_ok=True)
    weights = tmp_path / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:20_000])
    with pytest.raises(ConfigError, match="no semantic segmentation network"):
        probability(tmp_path, "building")


def test_photos_are_normalised_as_the_checkpoint_says(checkpoint, tmp_path):
    shutil.copytree(checkpoint, tmp_path, dirs_exist_ok=True)
    file = tmp_path / "preprocessor_config.json"

    def said(**words):
        file.write_text(json.dumps(words))
        return probability(tmp_path, "building")

    as_imagenet = probability(checkpoint, "building")
    assert np.array_equal(said(do_resize=True), as_imagenet)
    assert np.array_equal(
        said(image_mean=[0.485, 0.456, 0.406], image_std=[0.229, 0.224, 0.225], do_normalize=True),
        as_imagenet,
    )
    assert np.abs(said(image_mean=[0.5] * 3, image_std=[0.5] * 3) - as_imagenet).max() > 1e-4
    assert np.array_equal(said(do_normalize=False), said(image_mean=[0.0] * 3, image_std=[1.0] * 3))
    for words in ({"image_mean": [0.5]}, {"do_flip_channel_order": True}, {"image_std": [0, 1, 1]}):
        with pytest.raises(ConfigError, match="cannot be followed"):
            said(**words)


def test_what_the_checkpoint_says_of_photos_counts_for_its_digest(checkpoint, tmp_path):
    shutil.copytree(checkpoint, tmp_path, dirs_exist_ok=True)
    params = SemanticParams(str(tmp_path))
    before = Semantic(params).weights_digest
    (tmp_path / "preprocessor_config.json").write_text('{"image_mean": [0.5, 0.5, 0.5]}')
    assert Semantic(params).weights_digest != before


def test_a_gated_repository_without_its_weights_is_reported(tmp_path, monkeypatch):
    import huggingface_hub

    (tmp_path / "README.md").write_text("agree to the licence first")
    monkeypatch.setattr(huggingface_hub, "snapshot_download", lambda *args, **kwargs: str(tmp_path))
    with pytest.raises(ConfigError, match="holds no safetensors of facebook/sam3") as told:
        Semantic(SemanticParams("facebook/sam3"))
    for words in ("https://huggingface.co/facebook/sam3", "accept", "hf auth login", "hf download"):
        assert words in told.value.hint


def copied(checkpoint, folder, **config):
    shutil.copytree(checkpoint, folder, dirs_exist_ok=True)
    stored = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(stored | config))
    return folder


def refusal(folder):
    with pytest.raises(ConfigError) as told:
        probability(folder, "building")
    assert told.value.hint
    return told.value.message


def test_code_of_a_stranger_is_neither_run_nor_offered(checkpoint, tmp_path, monkeypatch):
    ran = tmp_path / "ran"
    named = {"AutoConfig": "evil.C", "AutoModelForSemanticSegmentation": "evil.M"}
    folder = copied(checkpoint, tmp_path / "code", model_type="evil", auto_map=named)
    (folder / "evil.py").write_text(f"open({str(ran)!r}, 'w')\n")
    monkeypatch.setattr("builtins.input", lambda *_: "y")
    assert "holds code of its own" in refusal(folder)
    assert not ran.exists()


@pytest.mark.parametrize("named", ["../model.safetensors", "weights.bin", "/etc/passwd"])
def test_an_index_names_safetensors_of_its_folder_alone(checkpoint, tmp_path, named):
    folder = copied(checkpoint, tmp_path / "index")
    (folder / "model.safetensors.index.json").write_text(json.dumps({"weight_map": {"a": named}}))
    assert named in refusal(folder)
    (folder / "model.safetensors.index.json").write_text("[]")
    assert "is no index of weights" in refusal(folder)


@pytest.mark.parametrize(
    "named", ["own.safetensors.index.json", "../net/model.safetensors", "part/a.safetensors"]
)
def test_a_configuration_names_safetensors_of_its_folder_alone(checkpoint, tmp_path, named):
    """Through an index of another name any file was opened, and was not part of the digest."""
    copied(checkpoint, tmp_path / "net")
    folder = copied(checkpoint, tmp_path / "led", transformers_weights=named)
    (folder / "model.safetensors").unlink()
    (folder / "own.safetensors.index.json").write_text(json.dumps({"weight_map": {"a": "../net/w.bin"}}))
    assert named in refusal(folder)


@pytest.mark.parametrize(
    ("config", "said"),
    [
        ({"depths": "x"}, "no semantic segmentation network"),
        ({"id2label": ["building"]}, "no semantic segmentation network"),
        ({"num_channels": 4}, "its weights are of other shapes than its config.json says"),
    ],
)
def test_a_configuration_that_cannot_be_is_reported_in_a_line(checkpoint, tmp_path, config, said):
    assert said in refusal(copied(checkpoint, tmp_path / "net", **config))


def test_quantised_and_damaged_weights_are_refused(checkpoint, tmp_path):
    from safetensors.torch import load_file, save_file

    folder = copied(checkpoint, tmp_path / "net")
    file = folder / "model.safetensors"
    stored = load_file(file)
    for change, said in (
        (lambda value: value.to(torch.int8), "weights of whole numbers"),
        (lambda value: value * float("nan"), "holds NaN or infinity"),
    ):
        save_file({name: change(value) for name, value in stored.items()}, file, metadata={"format": "pt"})
        assert said in refusal(folder)
    file.write_bytes(b"\xff" * 100)
    assert "no semantic segmentation network" in refusal(folder)


def test_quantised_weights_beside_those_that_are_read_do_not_matter(checkpoint, tmp_path):
    from safetensors.torch import load_file, save_file

    folder = copied(checkpoint, tmp_path / "net")
    stored = load_file(folder / "model.safetensors")
    whole = {name: value.to(torch.int8) for name, value in stored.items()}
    save_file(whole, folder / "model_int8.safetensors", metadata={"format": "pt"})
    assert np.array_equal(probability(folder, "building"), probability(checkpoint, "building"))
    stored_config = json.loads((folder / "config.json").read_text())
    stored_config["transformers_weights"] = "model_int8.safetensors"
    (folder / "config.json").write_text(json.dumps(stored_config))
    assert "weights of whole numbers" in refusal(folder)


def test_a_backbone_that_a_configuration_names_is_not_fetched(tmp_path, monkeypatch):
    from transformers import ConvNextConfig, UperNetConfig, UperNetForSemanticSegmentation

    stages = [f"stage{number}" for number in (1, 2, 3, 4)]
    backbone = ConvNextConfig(hidden_sizes=[8] * 4, depths=[1] * 4, out_features=stages)
    net = UperNetConfig(backbone_config=backbone, hidden_size=8, auxiliary_in_channels=8)
    UperNetForSemanticSegmentation(net).save_pretrained(tmp_path / "net")
    asked = []
    monkeypatch.setattr("socket.getaddrinfo", lambda host, *_, **__: asked.append(host))
    named = {"backbone": "somebody/anything", "use_pretrained_backbone": True, "backbone_config": None}
    assert "no semantic segmentation network" in refusal(copied(tmp_path / "net", tmp_path / "led", **named))
    assert asked == []
