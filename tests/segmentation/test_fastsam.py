"""FastSAM's instances as a mask: the pure part by hand, the adapter on a network made here, the licence."""

import warnings

import cv2
import numpy as np
import pytest

from lodbench.cli import main
from lodbench.datasets.query import Entry
from lodbench.errors import ConfigError
from lodbench.segmentation.fastsam import FastSam, FastSamParams, Instances, counted, decode

# Prototypes: the first is positive on the left half, the second on the upper half.
PROTOTYPES = np.full((2, 8, 8), -5, np.float32)
PROTOTYPES[0, :, :4] = PROTOTYPES[1, :4] = 5


def row(x, y, width, height, scores, coefficients):
    return [x, y, width, height, *scores, *coefficients]


def rows_of(*rows):
    return np.array(rows, np.float32).T


class TestDecode:
    def test_a_mask_is_its_prototypes_within_its_box(self):
        found = decode(rows_of(row(16, 16, 20, 32, [0.9], [1, 0])), PROTOTYPES, 0.4, 0.9)
        expected = np.zeros((32, 32), bool)
        expected[:, 6:16] = True
        assert found.masks[0].tolist() == expected.tolist()
        assert found.scores == pytest.approx([0.9])

    def test_boxes_reach_out_of_the_photo(self):
        found = decode(rows_of(row(0, 0, 20, 20, [0.9], [1, 0])), PROTOTYPES, 0.4, 0.9)
        assert found.masks[0].sum() == 100

    def test_prototypes_are_mixed(self):
        # Both needed: only where left and upper half meet does the sum rise above zero.
        found = decode(rows_of(row(16, 16, 32, 32, [0.9], [0.5, 0.6])), PROTOTYPES, 0.4, 0.9)
        assert found.masks[0][:14, :14].all()
        assert not found.masks[0][18:].any()

    def test_the_unlikely_and_the_doubled_go(self):
        rows = rows_of(
            row(16, 16, 20, 20, [0.5, 0.1], [1, 0]),
            row(16, 16, 20, 20.5, [0.8, 0.1], [1, 0]),  # the same thing, likelier
            row(16, 16, 20, 20, [0.1, 0.7], [1, 0]),  # of another class
            row(8, 8, 10, 10, [0.3, 0.2], [1, 0]),
        )
        found = decode(rows, PROTOTYPES, 0.4, 0.9)
        assert found.scores == pytest.approx([0.8, 0.7])
        assert found.classes.tolist() == [0, 1]

    def test_nothing_found_is_no_mask(self):
        found = decode(rows_of(row(16, 16, 20, 20, [0.1], [1, 0])), PROTOTYPES, 0.4, 0.9)
        assert counted(found, [], 1.0, (32, 32)).shape == (0, 32, 32)
        assert not counted(found, [], 1.0, (32, 32)).any()


def test_the_union_is_of_the_classes_requested_and_of_nothing_too_large():
    masks = np.zeros((3, 4, 5), bool)
    masks[0, 0], masks[1, 1], masks[2, :3] = True, True, True
    found = Instances(masks, np.array([0.9, 0.8, 0.7], np.float32), np.array([0, 2, 0]))
    assert counted(found, [], 1.0, (4, 5)).any(axis=0).sum() == 15
    assert counted(found, [2], 1.0, (4, 5)).any(axis=0).sum() == 5
    assert counted(found, [], 0.5, (4, 5)).any(axis=0).sum() == 10


@pytest.mark.parametrize(
    ("settings", "message", "hint"),
    [
        ({}, "AGPL-3.0", "accept_agpl=true"),
        ({"weights": "FastSAM-x.onnx"}, "AGPL-3.0", "accept_agpl=true"),
        ({"accept_agpl": True}, "without weights", "yolo export model=FastSAM-x.pt format=onnx imgsz=1024"),
        ({"accept_agpl": True, "weights": "FastSAM-x.pt"}, "is a pickle", "yolo export"),
        ({"accept_agpl": True, "weights": "nowhere.onnx"}, r"no weights nowhere\.onnx", "yolo export"),
    ],
)
def test_the_licence_comes_first_then_the_weights(settings, message, hint):
    with pytest.raises(ConfigError, match=message) as told:
        FastSam(FastSamParams(**settings))
    assert hint in told.value.hint


def test_the_command_says_the_licence_before_any_work(capsys):
    assert main(["run", "dataset=folder", "dataset.root=x", "dataset.city_model=y", "segmenter=fastsam"]) == 2
    told = capsys.readouterr().err
    assert "AGPL-3.0" in told
    assert len(told.splitlines()) == 2


SIZE = 64


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A network that finds two instances: what is red as class 0, what is green as class 1."""
    torch = pytest.importorskip("torch", reason="torch is not installed (extra [torch])")
    pytest.importorskip("onnx", reason="onnx is not installed (extra [torch])")
    whole = [SIZE / 2, SIZE / 2, float(SIZE), float(SIZE)]
    # As many anchors as strides of 8, 16 and 32 pixels make.
    rows = torch.tensor([[*whole, 0.9, 0.1, 1.0, 0.0], [*whole, 0.1, 0.8, 0.0, 1.0], *([[0.0] * 8] * 82)]).T[
        None
    ]

    class Finder(torch.nn.Module):
        def forward(self, photos):
            small = torch.nn.functional.avg_pool2d(photos, 4)
            # Like an export of ultralytics it is made for one size.
            return rows + 0 * photos.reshape(1, 3, SIZE * SIZE).mean(), 20 * small[:, :2] - 10

    path = tmp_path_factory.mktemp("fastsam") / "finder.onnx"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            Finder(), (torch.zeros(1, 3, SIZE, SIZE),), str(path), opset_version=13, dynamo=False
        )
    return path


class TestAdapter:
    def photo(self):
        photo = np.zeros((48, 96, 3), np.uint8)
        photo[:24, :48, 0] = 255
        photo[24:, 48:, 1] = 255
        return photo

    def segmenter(self, weights, **settings):
        settings = {"size": SIZE, "accept_agpl": True, **settings}
        return FastSam(FastSamParams(weights=str(weights), **settings))

    def test_photos_become_masks(self, weights):
        found = self.segmenter(weights).probability(self.photo())
        assert found.shape == (32, 64)
        assert set(np.unique(found)) == {0.0, 1.0}
        expected = np.zeros((32, 64), bool)
        expected[:16, :32] = expected[16:, 32:] = True
        assert (found.astype(bool) == expected).mean() > 0.95

    def test_and_into_instances(self, weights, tmp_path):
        photo = tmp_path / "photo.png"
        cv2.imwrite(str(photo), self.photo()[:, :, ::-1])
        found = self.segmenter(weights).segment_instances(Entry(photo.name, "all", None, None, photo, None))
        assert found.shape == (2, 32, 64)
        np.testing.assert_array_equal(
            found.any(axis=0), self.segmenter(weights).probability(self.photo()) >= 0.5
        )

    def test_one_class_alone(self, weights):
        segmenter = self.segmenter(weights, classes=[1])
        found = segmenter.probability(self.photo())
        assert found[20:, 40:].all()
        assert not found[:12].any()
        assert "AGPL" in segmenter.notes()[0]
        assert "whatever it is" not in segmenter.notes()[0]
        assert "whatever it is" in self.segmenter(weights).notes()[0]

    def test_another_network_or_size_is_reported(self, weights, tmp_path):
        from lodbench.segmentation.photo_segmenter import packaged_file

        with pytest.raises(ConfigError, match=r"answers \[\(1, 1, 64, 64\)\], not the rows"):
            self.segmenter(packaged_file("compact.onnx")).probability(self.photo())
        with pytest.raises(ConfigError, match="does not take a photo of"):
            self.segmenter(weights, size=96).probability(self.photo())
        (tmp_path / "text.onnx").write_text("hello")
        with pytest.raises(ConfigError, match="not a safe ONNX network"):
            self.segmenter(tmp_path / "text.onnx").probability(self.photo())

    def test_an_export_with_suppression_is_refused(self, weights):
        class Suppressed:
            def setInput(self, blob): ...

            def getUnconnectedOutLayersNames(self):
                return ()

            def forward(self, names):
                return np.zeros((1, 300, 38), np.float32), np.zeros((1, 32, 16, 16), np.float32)

        segmenter = self.segmenter(weights)
        segmenter._net = Suppressed()
        with pytest.raises(ConfigError, match=r"answers \[\(1, 300, 38\), .*not the rows") as told:
            segmenter.probability(self.photo())
        assert "without nms" in told.value.hint

    @pytest.mark.parametrize(
        ("row", "value", "said"),
        [(4, np.nan, "NaN"), (0, np.inf, "NaN, or values beyond"), (7, np.nan, "NaN"), (4, 5.0, "scores of")],
    )
    def test_answers_that_are_no_instances_are_reported_and_no_empty_mask(self, weights, row, value, said):
        rows = np.zeros((1, 8, 84), np.float32)
        rows[0, row] = value

        class Damaged:
            def setInput(self, blob): ...

            def getUnconnectedOutLayersNames(self):
                return ()

            def forward(self, names):
                return rows, np.zeros((1, 2, 16, 16), np.float32)

        segmenter = self.segmenter(weights)
        segmenter._net = Damaged()
        with pytest.raises(ConfigError, match=said) as told:
            segmenter.probability(self.photo())
        assert "yolo export" in told.value.hint
