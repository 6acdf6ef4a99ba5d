"""Networks from strangers: refused before OpenCV reads them."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from lodbench.datasets.query import Entry
from lodbench.errors import ConfigError, InputChanged
from lodbench.segmentation import onnx_file
from lodbench.segmentation.onnx_file import onnx_fault, read_onnx
from lodbench.segmentation.packaged import Compact, CompactParams
from lodbench.segmentation.photo_segmenter import packaged_file
from lodbench.segmentation.protocol import make_segmenter

pytestmark = pytest.mark.attack


def small_network() -> onnx.ModelProto:
    """A convolution and a branch in an attribute: graphs may stand in graphs."""
    weights = numpy_helper.from_array(np.ones((1, 3, 3, 3), np.float32), "w")
    photo = helper.make_tensor_value_info("photo", TensorProto.FLOAT, [1, 3, "h", "w"])
    logits = helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, 1, "h", "w"])
    node = helper.make_node("Conv", ["photo", "w"], ["logits"], kernel_shape=[3, 3], pads=[1, 1, 1, 1])
    return helper.make_model(helper.make_graph([node], "g", [photo], [logits], [weights]))


def fault_of(model: onnx.ModelProto) -> str:
    return onnx_fault(model.SerializeToString())


def test_sound_networks_pass() -> None:
    assert onnx_fault(packaged_file("compact.onnx").read_bytes()) == ""
    assert fault_of(small_network()) == ""


@pytest.mark.parametrize("location", ["/etc/passwd", "../../secret", "weights.bin"])
@pytest.mark.parametrize("place", ["initializer", "constant", "nested"])
def test_no_other_file_is_named(tmp_path: Path, location: str, place: str) -> None:
    model = small_network()
    tensor = model.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value=location)
    if place == "constant":
        model.graph.node.append(helper.make_node("Constant", [], ["c"], value=tensor))
        del model.graph.initializer[:]
    elif place == "nested":
        branch = helper.make_graph([helper.make_node("Constant", [], ["c"], value=tensor)], "b", [], [])
        model.graph.node.append(helper.make_node("If", ["x"], ["y"], then_branch=branch, else_branch=branch))
        del model.graph.initializer[:]
    assert fault_of(model) == "its weights lie in another file"
    (tmp_path / "a.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(ConfigError, match="is not a safe ONNX network: its weights lie in another file"):
        read_onnx(tmp_path / "a.onnx", "")


def negative_weights(model: onnx.ModelProto) -> None:
    model.graph.initializer[0].dims[0] = -1


def huge_weights(model: onnx.ModelProto) -> None:
    del model.graph.initializer[0].dims[:]
    model.graph.initializer[0].dims.extend([1 << 20, 1 << 20])


def unknown_operator(model: onnx.ModelProto) -> None:
    model.graph.node[0].op_type = "Run\x1b"


def other_domain(model: onnx.ModelProto) -> None:
    model.graph.node[0].domain = "com.example"


def other_weights(model: onnx.ModelProto) -> None:
    model.graph.initializer[0].dims[0] = 2


def negative_input(model: onnx.ModelProto) -> None:
    model.graph.input[0].type.tensor_type.shape.dim[1].dim_value = -3


def short_numbers(model: onnx.ModelProto) -> None:
    model.graph.initializer[0].ClearField("raw_data")
    model.graph.initializer[0].float_data.extend([1.0, 1.0, 1.0])


def no_numbers(model: onnx.ModelProto) -> None:
    model.graph.initializer[0].ClearField("raw_data")


def short_whole_numbers(model: onnx.ModelProto) -> None:
    tensor = model.graph.initializer.add(name="shape", data_type=TensorProto.INT64, dims=[4])
    tensor.int64_data.extend([300, -1])


def many_dimensions(model: onnx.ModelProto) -> None:
    model.graph.initializer[0].dims.extend([1 << 24] * 200_000)


def many_fields(model: onnx.ModelProto) -> None:
    # Numbers of a field that nobody knows, one by one.
    model.ParseFromString(model.SerializeToString() + b"\x80\x7d\x01" * 1_000_001)


def no_strides(model: onnx.ModelProto) -> None:
    model.graph.node[0].attribute.append(helper.make_attribute("strides", [0, 0]))


def vast_padding(model: onnx.ModelProto) -> None:
    model.graph.node[0].attribute[1].ints[0] = 1 << 40


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (short_numbers, "a tensor of shape [1, 3, 3, 3] has 3 numbers"),
        (no_numbers, "a tensor of shape [1, 3, 3, 3] has 0 numbers"),
        (short_whole_numbers, "a tensor of shape [4] has 2 numbers"),
        (many_dimensions, "a shape has too many dimensions"),
        (many_fields, "it has too many parts"),
        (no_strides, "strides is 0"),
        (vast_padding, f"pads is {1 << 40}"),
        (negative_weights, "a dimension is -1"),
        (huge_weights, f"a tensor has {1 << 40} elements"),
        (other_weights, "a tensor of shape [2, 3, 3, 3] has 108 bytes"),
        (unknown_operator, r"it asks for 'Run\x1b'"),
        (other_domain, "it asks for 'com.example Conv'"),
        (negative_input, "a dimension is -3"),
    ],
)
def test_shapes_that_cannot_be(change, fault: str) -> None:
    model = small_network()
    change(model)
    assert fault_of(model) == fault


def test_nesting_is_bounded() -> None:
    graph = helper.make_graph([], "g", [], [])
    for _ in range(12):
        graph = helper.make_graph([helper.make_node("If", ["x"], ["y"], then_branch=graph)], "g", [], [])
    assert fault_of(helper.make_model(graph)) == "it is nested too deeply"


@pytest.mark.parametrize("content", [b"", b"\x0a", b"\xff" * 40, b"\x3a\x80\x80\x80\x80\x10", b"PK\x03\x04"])
def test_what_is_no_network(content: bytes) -> None:
    assert onnx_fault(content)


def test_a_reader_that_breaks_down_is_reported_in_one_line(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "a.onnx"
    path.write_bytes(small_network().SerializeToString().replace(b"Conv", b"Con\xb5"))
    monkeypatch.setattr(onnx_file, "onnx_fault", lambda content: "")
    with pytest.raises(ConfigError, match="OpenCV's reader breaks down"):
        read_onnx(path, "")


def test_what_opencv_says_of_a_network_does_not_reach_the_terminal(tmp_path: Path, capfd) -> None:
    model = small_network()
    model.graph.node.append(helper.make_node("Relu", ["\x1b[31mfar"], ["near"]))
    (tmp_path / "a.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(ConfigError, match="not an ONNX network that OpenCV can read"):
        read_onnx(tmp_path / "a.onnx", "")
    assert capfd.readouterr().err == ""


def test_mutated_networks_are_read_or_refused_in_one_line(tmp_path: Path) -> None:
    whole, stream = small_network().SerializeToString(), np.random.default_rng(0)
    seen = {"read": 0, "refused": 0}
    for _ in range(12):
        content = bytearray(whole)
        for place in stream.integers(0, len(whole), stream.integers(1, 4)):
            content[place] = stream.integers(0, 256)
        (tmp_path / "a.onnx").write_bytes(content)
        try:
            read_onnx(tmp_path / "a.onnx", "")
            seen["read"] += 1
        except ConfigError:
            seen["refused"] += 1
    assert min(seen.values()) > 0


def test_a_network_that_takes_too_much_memory_is_refused_before_it_is_read_here(tmp_path, monkeypatch):
    path = tmp_path / "a.onnx"
    path.write_bytes(small_network().SerializeToString())
    read_onnx(path, "")
    monkeypatch.setattr(onnx_file, "_PROBE_BYTES", 1 << 20)
    with pytest.raises(ConfigError, match="too much memory"):
        read_onnx(path, "")


def test_a_lower_bound_on_memory_than_ours_is_kept(tmp_path):
    path = tmp_path / "a.onnx"
    path.write_bytes(small_network().SerializeToString())
    code = (
        "import resource, sys; from pathlib import Path\n"
        "from lodbench.segmentation.onnx_file import read_onnx\n"
        "resource.setrlimit(resource.RLIMIT_AS, (6 << 30, 6 << 30)); read_onnx(Path(sys.argv[1]), '')"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_network_replaced_between_two_photos_leaves_no_mask_under_another_s_digest(tmp_path):
    for name, value in (("0.png", 60), ("1.png", 200), ("2.png", 90)):
        cv2.imwrite(str(tmp_path / name), np.full((64, 64, 3), value, np.uint8))
    photos = [Entry(name, "", None, None, tmp_path / name, None) for name in ("0.png", "1.png", "2.png")]
    weights = tmp_path / "w.onnx"
    weights.write_bytes(small_network().SerializeToString())
    first = Compact(CompactParams(size=64, weights=str(weights)))
    first.segment(photos[0])
    other = small_network()
    other.graph.initializer[0].CopyFrom(numpy_helper.from_array(-np.ones((1, 3, 3, 3), np.float32), "w"))
    weights.write_bytes(other.SerializeToString())
    assert first.segment(photos[1]).min() > 0.5
    second = Compact(CompactParams(size=64, weights=str(weights)))
    assert second.segment(photos[1]).max() < 0.5
    third = Compact(CompactParams(size=64, weights=str(weights)))
    assert third.weights_digest
    weights.write_bytes(small_network().SerializeToString())
    with pytest.raises(InputChanged):
        third.segment(photos[2])


def of_answers(*channels: int) -> onnx.ModelProto:
    """A network with an output of so many channels each."""
    photo = helper.make_tensor_value_info("photo", TensorProto.FLOAT, [1, 3, "h", "w"])
    nodes, weights, outputs = [], [], []
    for k, count in enumerate(channels):
        weights.append(numpy_helper.from_array(np.ones((count, 3, 3, 3), np.float32), f"w{k}"))
        nodes.append(
            helper.make_node("Conv", ["photo", f"w{k}"], [f"a{k}"], kernel_shape=[3, 3], pads=[1] * 4)
        )
        outputs.append(helper.make_tensor_value_info(f"a{k}", TensorProto.FLOAT, [1, count, "h", "w"]))
    return helper.make_model(helper.make_graph(nodes, "g", [photo], outputs, weights))


@pytest.mark.parametrize(
    ("channels", "told"), [((1, 1), "has 2 outputs instead of one"), ((19,), r"answers \(1, 19, ")]
)
@pytest.mark.parametrize("name", ["compact", "efficient_unet", "compact_instances"])
def test_a_network_of_another_kind_is_reported_in_one_line(tmp_path, name, channels, told) -> None:
    file, photo = tmp_path / "other.onnx", tmp_path / "photo.png"
    file.write_bytes(of_answers(*channels).SerializeToString())
    cv2.imwrite(str(photo), np.full((60, 80, 3), 128, np.uint8))
    segmenter, _ = make_segmenter(name, {"weights": str(file)})
    ask = segmenter.segment_instances if name == "compact_instances" else segmenter.segment
    with pytest.raises(ConfigError, match=told) as caught:
        ask(Entry("photo.png", "", None, None, photo, None))
    assert str(file) in str(caught.value)
    assert f"lodbench train segmenter={name} writes" in (caught.value.hint or "")
