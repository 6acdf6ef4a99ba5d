"""Training of LoD-Loc (v1): its losses by hand, exact resume, the file it leaves, and what it refuses."""

import json
import math
import shutil

import cv2
import numpy as np
import pytest

from lodbench.cli import main
from lodbench.datasets.folder import RENDERED_TRUTH_FILE, write_poses
from lodbench.geometry import EulerAngles, Pose
from tests.town import CAMERA, box_obj, prior_of, true_poses

torch = pytest.importorskip("torch", reason="torch is not installed (extra [torch])")
onnx = pytest.importorskip("onnx", reason="onnx is not installed (extra [torch])")

SCHEDULE = [
    *("schedule.epochs=2", "schedule.batch=2", "schedule.size=96", "schedule.priors=1"),
    *("schedule.points=40", "schedule.poses=8", "threads=1"),
]


@pytest.fixture(scope="module")
def views(tmp_path_factory):
    """A set as the generator leaves it: four photos of boxes, poses, priors and a manifest."""
    root = tmp_path_factory.mktemp("set")
    (root / "city.obj").write_text(box_obj())
    truth = true_poses(4)
    (root / "train" / "images").mkdir(parents=True)
    for number, name in enumerate(truth):
        picture = np.random.default_rng(number).integers(0, 255, (120, 160, 3), np.uint8)
        cv2.imwrite(str(root / "train" / "images" / name), picture)
    priors = {name: prior_of(pose) for name, pose in truth.items()}
    write_poses(root / "train", dict.fromkeys(truth, CAMERA), truth, priors, truth_file=RENDERED_TRUTH_FILE)
    about = {"digest": "0", "inputs": {}, "views": {}, "settings": {"city": str(root / "city.obj")}}
    (root / "manifest.json").write_text(json.dumps(about))
    return root


def train(views, out, *words):
    return main(["train", "method=lodloc", f"data={views}", f"out={out}", *SCHEDULE, *words])


@pytest.mark.slow
def test_stopped_and_taken_up_it_ends_with_the_same_bytes(views, tmp_path, monkeypatch, capsys):
    from lodbench.baselines.lodloc.nets import loop

    assert train(views, tmp_path / "whole") == 0
    assert "weights: " in capsys.readouterr().out
    saved = loop.save_checkpoint

    def stops(state, folder):
        saved(state, folder)
        if len(state["history"]) == 1:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(loop, "save_checkpoint", stops)
        assert train(views, tmp_path / "stopped") != 0
    assert train(views, tmp_path / "stopped") == 0
    weights = [(tmp_path / name / "lodloc.onnx").read_bytes() for name in ("whole", "stopped")]
    assert weights[0] == weights[1]
    record = json.loads((tmp_path / "whole" / "training.json").read_text())
    assert [row["epoch"] for row in record["history"]] == [1, 2]
    assert record["counts"] == {
        "train": 3,
        "val": 1,
        "validated_on": "every 20th training view, held out: of the same regions",
    }
    assert train(views, tmp_path / "whole", "schedule.lr=0.001") == 2
    assert "other settings" in capsys.readouterr().err


def test_views_of_two_sets_that_are_called_alike_are_told_apart(views, tmp_path, capsys):
    """Sets of one layout share names: photos of `val_data` were given the features of trained ones."""
    from lodbench.baselines.lodloc.nets.loop import KeptFeatures
    from lodbench.baselines.lodloc.nets.net import start_from
    from lodbench.baselines.lodloc.training_views import ViewSettings, find_views

    other = tmp_path / "other"
    shutil.copytree(views, other)
    for photo in (other / "train" / "images").iterdir():
        cv2.imwrite(str(photo), np.full((120, 160, 3), 200, np.uint8))
    prepared = ViewSettings(96, "1", 1, 160, 1.0, 0)
    mine, theirs = (find_views(folder, prepared, ("train",))[0] for folder in (views, other))
    assert mine.key == theirs.key
    features = KeptFeatures(start_from(None).eval(), 10)
    assert not torch.equal(features(mine).half, features(theirs).half)
    assert train(views, tmp_path / "out", f"val_data={views}") == 2
    assert "4 of the 4 views of val_data are trained on" in capsys.readouterr().err


def test_another_map_is_another_training(views, tmp_path, capsys):
    shutil.copytree(views, tmp_path / "set")
    city, manifest = tmp_path / "set" / "city.obj", tmp_path / "set" / "manifest.json"
    manifest.write_text(manifest.read_text().replace(str(views), str(tmp_path / "set")))
    assert train(tmp_path / "set", tmp_path / "out", "schedule.epochs=1") == 0
    words = [line.split() for line in city.read_text().splitlines()]
    higher = [[*w[:3], str(1.5 * float(w[3]))] if w and w[0] == "v" else w for w in words]
    city.write_text("\n".join(map(" ".join, higher)) + "\n")
    assert train(tmp_path / "set", tmp_path / "out", "schedule.epochs=1") == 2
    assert "other views" in capsys.readouterr().err


def test_stopped_at_the_end_of_the_last_epoch_its_weights_are_there(views, tmp_path, monkeypatch, capsys):
    from lodbench.baselines.lodloc.nets import loop

    def stops(state, folder):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(loop, "save_checkpoint", stops)
        assert train(views, tmp_path / "out", "schedule.epochs=1") != 0
    stored = (tmp_path / "out" / "lodloc.onnx").read_bytes()
    assert train(views, tmp_path / "out", "schedule.epochs=1") == 0
    assert (tmp_path / "out" / "lodloc.onnx").read_bytes() == stored
    assert "epoch 1 of 1" in capsys.readouterr().err


def test_the_file_is_the_network_to_three_digits_and_half_as_large(tmp_path):
    from lodbench.baselines.lodloc.likelihood import maps_of
    from lodbench.baselines.lodloc.nets.net import start_from, unpacked
    from lodbench.baselines.lodloc.nets.packed_onnx import pack_onnx

    from lodbench.segmentation.nets.weights import write_onnx

    torch.manual_seed(0)
    net, path = start_from(None).eval(), tmp_path / "net.onnx"
    write_onnx(net, path, 32)
    whole = path.stat().st_size
    pack_onnx(path)
    assert path.stat().st_size < 0.55 * whole
    photo = np.random.default_rng(0).integers(0, 255, (96, 160, 3), np.uint8)
    found = maps_of(photo, 160, 96, str(path))
    with torch.no_grad():
        blob = torch.from_numpy(np.ascontiguousarray(photo.transpose(2, 0, 1)[None], dtype=np.float32) / 255)
        wanted = unpacked(net(blob)[0])
    for mine, other in zip((*found.stages, found.refinement), wanted, strict=True):
        assert np.abs(mine - other[0].numpy()).max() < 5e-3 * float(other.abs().max())


@pytest.mark.parametrize("steps", [1, 34, 40, 65])
def test_the_rate_never_passes_the_highest(steps):
    pytest.importorskip("torch")
    from lodbench.baselines.lodloc.nets.loop import learning_rate
    from lodbench.baselines.lodloc.training_params import LodLocTraining

    settings = LodLocTraining(data="d", out="o", epochs=1, lr=0.5)
    assert max(learning_rate(settings, step, steps) for step in range(steps)) <= 0.5


def test_the_share_of_the_truth_by_hand():
    from lodbench.baselines.lodloc.nets.losses import selection_loss

    # A map that is 2 left of column 10 and 0 right of it; two poses whose one point lies left and right.
    values = torch.zeros(20, 20)
    values[:, :10] = 2.0
    intrinsics = torch.tensor([10.0, 10.0, 10.0, 10.0])
    rotations, points = torch.eye(3).repeat(2, 1, 1), torch.tensor([[0.0, 0.0, 5.0]])
    centers = torch.tensor([[2.0, 0.0, 0.0], [-2.0, 0.0, 0.0]])
    loss = selection_loss(values, 1.0, points, rotations, centers, intrinsics)
    assert float(loss) == pytest.approx(-math.log(math.exp(2) / (math.exp(2) + 1)), abs=1e-6)


def test_the_jacobian_is_that_of_differences():
    from lodbench.baselines.lodloc.nets.losses import pose_jacobian
    from scipy.spatial.transform import Rotation

    points = np.array([[3.0, -2.0, 40.0], [-9.0, 4.0, 70.0]])
    intrinsics, slope = np.array([300.0, 290.0, 160.0, 120.0]), np.array([[0.4, -1.2], [2.0, 0.3]])

    def shown(delta):
        moved = points @ Rotation.from_rotvec(delta[:3]).as_matrix().T + delta[3:]
        return (slope * (moved[:, :2] / moved[:, 2:] * intrinsics[:2])).sum(axis=1)

    step = 1e-5
    by_differences = np.stack([(shown(e * step) - shown(-e * step)) / (2 * step) for e in np.eye(6)], axis=1)
    found = pose_jacobian(*(torch.from_numpy(each) for each in (slope, points, intrinsics)))
    assert found.numpy() == pytest.approx(by_differences, rel=1e-6, abs=1e-6)


def test_refinement_learns_from_where_it_ends():
    from lodbench.baselines.lodloc.nets.losses import projected, refinement_loss

    # A bowl around one pixel per point: the gradient points home, so a step shortens the way.
    truth = Pose.from_euler(EulerAngles(30, 0, 20), (0, 0, 100))
    generator = np.random.default_rng(3)
    points = torch.from_numpy((generator.uniform(-40, 40, (60, 3)) * (1, 1, 0.2)).astype(np.float32))
    intrinsics = torch.tensor([230.0, 228.0, 161.0, 118.5])
    pose = [torch.from_numpy(each.astype(np.float32)) for each in (truth.rotation, truth.center)]
    pixels, _ = projected(points, pose[0][None], pose[1][None], intrinsics)
    rows, columns = np.mgrid[0:240, 0:320] + 0.5
    far = np.sqrt(((np.stack([columns, rows], -1)[:, :, None] - pixels[0].numpy()) ** 2).sum(-1)).min(-1)
    values = torch.from_numpy(far.astype(np.float32)).requires_grad_()
    start = (pose[0], pose[1] + torch.tensor([0.5, -0.4, 0.3]))
    once = refinement_loss(values, points, start, tuple(pose), intrinsics, 1)
    before, _ = projected(points, start[0][None], start[1][None], intrinsics)
    # Barron's loss with alpha 1 and 2 px, by hand.
    at_start = (np.sqrt(((before - pixels)[0].numpy() ** 2).sum(1) / 4 + 1) - 1).mean()
    assert 0 < once.item() < 0.7 * at_start
    once.backward()
    assert values.grad.abs().sum() > 0


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["data=nowhere"], "holds no training set"),
        (["schedule.epochs=0"], "epochs=0"),
        (["init=nowhere.pt"], "no weights nowhere.pt"),
        (["method.size=300"], "do not apply"),
        (["method=lodlocv2"], "has nothing to train"),
        (["epohs=3"], "epohs is not a setting"),
    ],
)
def test_a_slip_ends_in_a_line_before_any_work(views, tmp_path, capsys, words, told):
    assert main(["train", "method=lodloc", f"data={views}", f"out={tmp_path}", *words]) == 2
    assert told in capsys.readouterr().err


def test_a_set_whose_city_is_gone_is_told(views, tmp_path, capsys):
    about = json.loads((views / "manifest.json").read_text())
    (tmp_path / "manifest.json").write_text(json.dumps(about | {"settings": {"city": "gone.gml"}}))
    assert main(["train", "method=lodloc", f"data={tmp_path}", f"out={tmp_path / 'out'}"]) == 2
    assert "gone.gml" in capsys.readouterr().err
    (tmp_path / "manifest.json").write_text("{")
    assert main(["train", "method=lodloc", f"data={tmp_path}", f"out={tmp_path / 'out'}"]) == 2
    assert "no manifest" in capsys.readouterr().err
