"""One real flight as a dataset: its map beside it, all its photos one flight, a board of its own."""

import shutil

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lodbench.cli import main as lodbench
from lodbench.datasets.exchange.colmap import write_colmap
from lodbench.datasets.folder import FolderParams, RealFlightParams, open_folder, open_real_flight
from lodbench.datasets.pose_text import FoundPose, read_cameras, read_poses
from lodbench.errors import DatasetError
from lodbench.geometry.similarity import Similarity
from lodbench.harness.runs.predict import _batches
from lodbench.harness.runs.requirements import warn_of_flights
from lodbench.methods.registry import make_method
from tests.town import write_dataset


@pytest.fixture
def flight(tmp_path):
    """A made flight of three photos, its map among its files."""
    root, city = write_dataset(tmp_path / "made")
    return root.rename(tmp_path / "ochota"), shutil.move(city, tmp_path / "ochota" / "city.obj")


def test_map_lies_beside_and_all_photos_are_one_flight(flight, caplog):
    root, city = flight
    dataset = open_real_flight(RealFlightParams(str(root)))
    assert dataset.name == "real_flights"
    assert dataset.city_model == city
    assert dataset.splits == ("ochota",)
    method = make_method("flight")
    warn_of_flights(method, dataset.entries)
    assert not caplog.records
    (batch,) = _batches(method, dataset.entries, dataset.entries[:1])
    assert [entry.name for entry in batch] == ["view_00.png", "view_01.png", "view_02.png"]


def test_what_finds_photos_from_the_ones_before_refuses_photos_of_no_flight(flight):
    root, city = flight
    unnamed = open_folder(FolderParams(str(root), str(city))).entries
    with pytest.raises(DatasetError, match=r"method=tracking .* flights of 3 photos of") as caught:
        warn_of_flights(make_method("tracking"), unnamed)
    assert "sequences.txt" in caught.value.hint
    warn_of_flights(make_method("tracking"), unnamed[:1])
    warn_of_flights(make_method("tracking"), open_real_flight(RealFlightParams(str(root))).entries)


def test_files_that_name_flights_are_believed(flight, tmp_path):
    root, city = flight
    (root / "sequences.txt").write_text("view_00.png a\nview_01.png b\nview_02.png a\n")
    other = shutil.copy(city, tmp_path / "other.obj")
    dataset = open_real_flight(RealFlightParams(str(root), other))
    assert [entry.sequence for entry in dataset.entries] == ["a", "b", "a"]
    assert dataset.city_model.name == "other.obj"


def test_several_flights_at_once_are_refused(flight):
    root, _ = flight
    with pytest.raises(DatasetError, match=r"several flights.*: ochota") as caught:
        open_real_flight(RealFlightParams(str(root.parent)))
    assert f"dataset.root={root}" in str(caught.value.hint)
    with pytest.raises(DatasetError, match="is not a folder"):
        open_real_flight(RealFlightParams(str(root / "nothing")))


def test_true_poses_are_compared_with_the_reconstruction(tmp_path):
    root, _ = write_dataset(tmp_path, 5)
    truth = read_poses(root / "GT_pose.txt")
    camera = next(iter(read_cameras(root / "intrinsic.txt").values()))
    # In a frame of its own: half as large, turned about the vertical, shifted.
    other = Similarity(
        0.5, Rotation.from_euler("z", 40, degrees=True).as_matrix(), np.array([3.0, 9.0, -2.0])
    )
    found = [FoundPose(name, "", other.pose(pose), camera) for name, pose in truth.items()]
    write_colmap(found, root / "sparse")
    opened = open_real_flight(RealFlightParams(str(root)))
    assert opened.findings == ()
    found[1] = found[1]._replace(pose=found[1].pose.shifted(np.array([0.0, 0.0, 1.5])))
    write_colmap(found, root / "sparse")
    (finding,) = open_real_flight(RealFlightParams(str(root))).findings
    assert (finding.code.code, finding.object_id) == ("LB543", "data/view_01.png")
    assert 2.0 < float(finding.detail.split()[0]) <= 3.0
    (root / "sparse" / "images.txt").write_text("1 2 3\n")
    (finding,) = open_real_flight(RealFlightParams(str(root))).findings
    assert (finding.code.code, finding.object_id) == ("LB543", "sparse")


def test_check_compares_with_the_card(flight, capsys):
    root, _ = flight
    assert lodbench(["dataset", "check", "real_flights", "--root", str(root)]) == 0
    output = capsys.readouterr().out
    assert "ochota: 3 queries, 3 with a true pose (its card says 17)" in output
    assert "COUNT_UNEXPECTED" in output
    assert lodbench(["dataset", "card", "real_flights"]) == 0
    card = capsys.readouterr().out
    assert "CC BY 3.0" in card
    assert "Andrew Zaborowski" in card


def test_real_flights_have_a_board_of_their_own(flight, tmp_path, capsys):
    root, city = flight
    board, runs = tmp_path / "board", tmp_path / "runs"
    same = ["method=prior_only", f"dataset.root={root}", f"paths.runs={runs}"]
    assert lodbench(["run", "dataset=real_flights", *same]) == 0
    assert lodbench(["run", "dataset=folder", f"city={city}", *same]) == 0
    for name in ("real_flights", "folder"):
        (run,) = [path.parent for path in runs.rglob("summary.json") if name in path.parts]
        assert lodbench(["leaderboard", "add", str(run), "--root", str(board)]) == 0
    assert lodbench(["leaderboard", "build", "--root", str(board)]) == 0
    real, drawn = ((board / f"{name}.md").read_text() for name in ("real_flights", "folder"))
    assert real.startswith("# real_flights\n\nReal photos, ")
    assert "structure from motion" in real
    assert "ochota 3" in real
    assert "Real photos" not in drawn
    assert "structure from motion" in (board / "real_flights.html").read_text()
    assert (board / "index.html").read_text().count("structure from motion") == 1
    assert lodbench(["leaderboard", "build", "--root", str(board), "--check"]) == 0
    capsys.readouterr()


def test_methods_have_the_reconstruction_where_that_is_set_and_there_is_one(flight):
    root, _ = flight
    with pytest.raises(DatasetError, match="no COLMAP model sparse"):
        open_real_flight(RealFlightParams(str(root), reconstruction=True))
    cameras = read_cameras(root / "intrinsic.txt")
    poses = read_poses(root / "GT_pose.txt")
    own = Similarity(0.1, np.eye(3), np.array([4.0, 5.0, 6.0]))
    model = [FoundPose(name, "", own.pose(poses[name]), cameras[name]) for name in list(poses)[:2]]
    write_colmap(model, root / "sparse")
    for wanted, count in ((False, 0), (True, 2)):
        entries = open_real_flight(RealFlightParams(str(root), reconstruction=wanted)).entries
        found = [entry for entry in entries if entry.reconstructed is not None]
        assert len(found) == count
    assert found[0].reconstructed.center == pytest.approx(model[0].pose.center)
