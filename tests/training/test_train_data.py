"""What a training takes pictures and masks for, and how they are changed on the way."""

import shutil

import cv2
import numpy as np
import pytest

from lodbench.cli import main
from lodbench.errors import ConfigError, DatasetError
from lodbench.photos.pictures import picture_size
from lodbench.segmentation.packaged import Compact, CompactInstances, CompactInstancesParams, CompactParams
from lodbench.training.augment import flipped, random_crop, relit
from lodbench.training.samples import find_samples, split_samples
from tests.training.squares import train

torch = pytest.importorskip("torch", reason="torch is not installed (extra [torch])")
pytest.importorskip("onnx", reason="onnx is not installed (extra [torch])")


@pytest.mark.slow
def test_interiors_of_labelled_buildings_are_learnt(views, tmp_path, capsys):
    from lodbench.segmentation.nets.unets import CompactNet

    learnt = "segmenter=compact_instances"
    assert train(views, tmp_path / "a", learnt, "schedule.epochs=1") == 2
    told = capsys.readouterr().err
    assert "have no label" in told
    assert "labels=true" in told
    labelled = tmp_path / "labelled"
    shutil.copytree(views, labelled)
    for mask in labelled.rglob("masks/*.png"):
        labels = (cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE) > 0).astype(np.uint16)
        labels[:, np.flatnonzero(labels.any(axis=0))[15:]] *= 2
        (mask.parent.parent / "labels").mkdir(exist_ok=True)
        cv2.imwrite(str(mask.parent.parent / "labels" / mask.name), labels)
    _, target = find_samples(labelled, "train", "interiors")[0].read(0, square=False)
    # Two halves of 15 by 28 pixels, each two pixels smaller on every side.
    assert target.sum() == 2 * 11 * 24
    assert train(labelled, tmp_path / "a", learnt, "schedule.epochs=1") == 0
    weights = tmp_path / "a" / "compact_instances.onnx"
    photo = np.zeros((64, 96, 3), np.uint8)
    assert CompactInstances(CompactInstancesParams(weights=str(weights))).interior(photo).any()
    # The same layers as those of compact, to which they would be masks.
    with pytest.raises(ConfigError, match=r"has learnt interiors of buildings, not masks"):
        Compact(CompactParams(weights=str(weights))).probability(photo)
    masks = Compact(CompactParams()).store(CompactNet(), tmp_path)
    instances = CompactInstances(CompactInstancesParams(weights=str(masks)))
    with pytest.raises(ConfigError, match=r"has learnt masks of buildings, not interiors"):
        instances.interior(photo)
    assert train(labelled, tmp_path / "b", learnt, f"negatives=[{views}]") == 2
    assert "negatives has masks of buildings only" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("sides", ["schedule.crop=50", "schedule.size=70"])
def test_sides_that_are_no_multiples_of_the_stride_are_padded(views, tmp_path, capsys, sides):
    more = () if "crop" in sides else ("schedule.crop=0",)
    assert train(views, tmp_path / "a", "schedule.epochs=1", "init=package", sides, *more) == 0
    assert (tmp_path / "a" / "compact.onnx").is_file()


def test_faults_of_the_data(views, tmp_path, capsys):
    assert main(["train", f"data={tmp_path / 'none'}"]) == 2
    assert "There is no folder" in capsys.readouterr().err
    (tmp_path / "train" / "images").mkdir(parents=True)
    assert main(["train", f"data={tmp_path}"]) == 2
    assert "no views to train on" in capsys.readouterr().err
    cv2.imwrite(str(tmp_path / "train" / "images" / "1.png"), np.zeros((9, 9, 3), np.uint8))
    with pytest.raises(DatasetError, match=r"1 pictures in .* have no mask"):
        find_samples(tmp_path, "train")
    assert main(["train", f"data={views}", "segmenter=masks"]) == 2
    told = capsys.readouterr().err
    assert "no network to train" in told
    assert (
        "Trainable: compact, compact_instances, compact_classes, efficient_unet, sam2_unet, sam1_adapter."
        in told
    )


def test_a_mask_of_another_aspect_is_refused_before_training(views, tmp_path):
    shutil.copytree(views, tmp_path / "set")
    samples = find_samples(tmp_path / "set", "train")
    cv2.imwrite(str(samples[3].mask), np.zeros((96, 64), np.uint8))
    with pytest.raises(DatasetError, match="the mask is 64 x 96, the photo 96 x 64: another aspect"):
        find_samples(tmp_path / "set", "train")
    with pytest.raises(DatasetError, match="another aspect"):
        samples[3].read(64, square=True)


def test_pictures_that_would_share_a_mask_are_refused(views, tmp_path):
    shutil.copytree(views, tmp_path / "set")
    photo = find_samples(tmp_path / "set", "train")[0].photo
    cv2.imwrite(str(photo.with_suffix(".tif")), cv2.imread(str(photo)))
    with pytest.raises(DatasetError, match="share a name"):
        find_samples(tmp_path / "set", "train")


def test_views_that_are_trained_on_do_not_validate(views, tmp_path, capsys):
    assert train(views, tmp_path / "out", f"val_data={views}") == 2
    assert "10 of the 12 views of val_data are trained on" in capsys.readouterr().err


def test_views_are_held_out_where_there_are_none_to_validate_on(views):
    train_views, val_views, source = split_samples(
        find_samples(views, "train"), find_samples(views, "val"), None
    )
    assert (len(train_views), len(val_views)) == (10, 2)
    train_views, val_views, source = split_samples(find_samples(views, "train"), [], None)
    assert (len(train_views), len(val_views)) == (9, 1)
    assert "held out" in source
    assert not {s.key for s in train_views} & {s.key for s in val_views}


def test_pictures_and_masks_change_together():
    generator = np.random.default_rng(0)
    mask = (cv2.GaussianBlur(generator.random((90, 120)), (0, 0), 6) > 0.5).astype(np.float32)
    photo = np.repeat((255 * mask[..., None]).astype(np.uint8), 3, axis=2)
    for draw in range(5):
        stream = np.random.default_rng(draw)
        picture, truth = random_crop(*flipped(photo, mask, stream, (1, 0)), 64, (0.8, 1.5), stream)
        assert truth.shape == (64, 64)
        assert abs(picture[..., 0] / 255.0 - truth).max() < 0.02  # bytes, and their coarser interpolation
        again = relit(picture, np.random.default_rng(draw))
        assert 0 <= again.min() <= again.max() <= 1
        assert (again == relit(picture, np.random.default_rng(draw))).all()


def test_a_share_of_pictures_loses_its_colours():
    photo = np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8)
    for draw in range(8):
        colours = relit(photo, np.random.default_rng(draw))
        band = relit(photo, np.random.default_rng(draw), one_band=1.0)
        assert 0 <= band.min() <= band.max() <= 1
        assert band.std() > 0.1
        # Noise, where it is drawn, differs by channel.
        assert np.median(np.ptp(band, axis=2)) < 0.1 < np.median(np.ptp(colours, axis=2))


def test_a_photo_that_cannot_be_read_is_reported_before_anything_is_learnt(tmp_path):
    for kind, name in (("images", "0.jpg"), ("masks", "0.png"), ("images", "1.jpg"), ("masks", "1.png")):
        (tmp_path / "train" / kind).mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(tmp_path / "train" / kind / name), np.zeros((8, 8), np.uint8))
    (tmp_path / "train" / "images" / "1.jpg").write_bytes(b"")
    with pytest.raises(DatasetError, match=r"The photo .*1\.jpg cannot be read") as told:
        find_samples(tmp_path, "train")
    assert told.value.hint


def test_a_photo_whose_comment_is_damaged_is_a_photo(tmp_path):
    for kind in ("images", "masks"):
        (tmp_path / "train" / kind).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / "train" / kind / "0.png"), np.zeros((8, 8), np.uint8))
    photo = tmp_path / "train" / "images" / "0.png"
    whole, comment = photo.read_bytes(), b"tEXtComment\0by hand"
    # With a wrong checksum: Pillow refuses the file.
    chunk = (len(comment) - 4).to_bytes(4) + comment + bytes(4)
    photo.write_bytes(whole[:33] + chunk + whole[33:])
    assert picture_size(photo) is None
    (sample,) = find_samples(tmp_path, "train")
    assert sample.read(0, square=False)[0].shape == (8, 8, 3)


def test_one_view_alone_is_too_few(tmp_path):
    for kind, name in (("images", "0.jpg"), ("masks", "0.png")):
        (tmp_path / "train" / kind).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / "train" / kind / name), np.zeros((8, 8), np.uint8))
    with pytest.raises(DatasetError, match="One view is too few") as told:
        split_samples(find_samples(tmp_path, "train"), [], None)
    assert "val_data=SET" in told.value.hint
