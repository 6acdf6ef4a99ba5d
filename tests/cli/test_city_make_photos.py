"""`lodbench city make --photos`: heights of footprints by photos of a drawn flight, against the true ones."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.citymodel import open_scene
from lodbench.cli import main
from lodbench.datasets.exchange.colmap import write_colmap
from lodbench.datasets.folder import write_poses
from lodbench.datasets.pose_text import FoundPose, format_pose, read_poses
from lodbench.synthesis.camera_paths import FLIGHT_PATHS
from tests.citymodel.surface_case import NORTH, WEST, write_footprints
from tests.town import BOXES, CAMERA, box_obj

pytest.importorskip("pyogrio")
CORNER = np.array([WEST, NORTH, 100.0])
NONE = float("nan")
SHARP = CAMERA.scaled(640, 480)
# One house that is not there, and one that no photo shows.
FAR = (900, 900, 920, 915, 0, 8)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory) -> Path:
    """Returns a folder with footprints without heights, and a dataset of drawn photos in their place."""
    root = tmp_path_factory.mktemp("drawn")
    shapely = pytest.importorskip("shapely")
    (root / "true.obj").write_text(box_obj())
    scene = open_scene(root / "true.obj")
    city_map = CityMap(scene, threads=1)
    middle = np.array([*scene.vertices[:, :2].mean(axis=0), 0.0])
    poses = list(FLIGHT_PATHS["orbit"](middle, np.random.default_rng(4), 8))[:8]
    (root / "flight" / "Query_image").mkdir(parents=True)
    truth = {}
    for k, pose in enumerate(poses):
        (picture,) = city_map.colour(SHARP, pose.rotation[None], pose.center[None])
        lawn = np.random.default_rng(0).normal((60, 90, 50), 4, picture.shape).astype(np.uint8)
        shown = np.where(city_map.render(SHARP, pose)[..., None], picture, lawn)[..., ::-1]
        cv2.imwrite(str(root / "flight" / "Query_image" / f"{k}.png"), shown)
        truth[f"{k}.png"] = pose.shifted(CORNER + scene.origin)
    write_poses(root / "flight", dict.fromkeys(truth, SHARP), truth, {})
    (root / "flight" / "dataset.json").write_text('{"priors": false}')
    boxes = [*BOXES, FAR]
    shapes = [shapely.box(west, south, east, north) for west, south, east, north, _, _ in boxes]
    write_footprints(
        root / "f.gpkg",
        [shapely.transform(shape, lambda points: points + CORNER[:2]) for shape in shapes],
        id=[f"h{n}" for n in range(len(boxes))],
        ground=[100.0 + base for *_, base, _ in boxes],
        height=[*[NONE] * 6, 3.0, NONE],
    )
    return root


@pytest.fixture
def folder(drawn, tmp_path, monkeypatch) -> Path:
    shutil.copytree(drawn, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


WORDS = ["city", "make", "--footprints", "f.gpkg"]


def attributes(path: Path) -> dict[str, dict]:
    return {name: each["attributes"] for name, each in json.loads(path.read_text())["CityObjects"].items()}


def require_true_heights(told: dict[str, dict]) -> None:
    """Requires heights near the true ones, and deviations that say how near."""
    measured = {name: each for name, each in told.items() if each["height_from"] == "photos"}
    true_m = {f"h{n}": top - base for n, (*_, base, top) in enumerate(BOXES)}
    off = np.array([each["measuredHeight"] - true_m[name] for name, each in measured.items()])
    sigmas = np.array([each["height_sigma_m"] for each in measured.values()])
    assert len(measured) >= 6
    assert np.median(np.abs(off)) <= 0.3
    assert (np.abs(off) <= 3 * sigmas).mean() >= 0.8


def test_photos_of_a_dataset_measure_roofs(folder, capsys):
    assert main([*WORDS, "--photos", "flight", "town.city.json", "--json"]) == 0
    made = json.loads(capsys.readouterr().out)
    told = attributes(folder / "town.city.json")
    require_true_heights(told)
    # A column says 3 m of a house of 8.
    assert told["h6"]["measuredHeight"] == pytest.approx(8.0, abs=1.0)
    assert made["photos"] == 8
    assert made["left_out"] == {"no height": 1}
    page = (folder / "town.city.html").read_text()
    assert "photos" in page
    scene = open_scene(folder / "town.city.json")
    assert scene.vertices[:, 2].max() + scene.origin[2] == pytest.approx(140.0, abs=1.0)


def test_photos_with_poses_of_a_file_and_a_default_height(folder):
    known = read_poses(folder / "flight" / "GT_pose.txt")
    write_colmap([FoundPose(name, "", pose, SHARP) for name, pose in known.items()], folder / "sparse")
    words = ["--photos", "flight/Query_image", "--poses", "sparse", "--option", "default_height_m=7"]
    assert main([*WORDS, *words, "town.city.json"]) == 0
    told = attributes(folder / "town.city.json")
    require_true_heights(told)
    assert (told["h7"]["measuredHeight"], told["h7"]["height_from"]) == (7.0, "default_height_m")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--poses", "flight/GT_pose.txt"], "--poses are those of photos"),
        (["--photos", "nowhere"], "nowhere is not a folder"),
        (["--photos", "flight", "--poses", "nowhere"], "nowhere does not exist"),
        (["--photos", "flight/Query_image", "--poses", "flight/GT_pose.txt"], "0 photos"),
        (["--photos", ".", "--poses", "f.gpkg"], "f.gpkg"),
    ],
)
def test_refused_in_one_line_with_nothing_written(folder, capsys, words, said):
    assert main([*WORDS, *words, "town.city.json"]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error
    assert not (folder / "town.city.json").exists()


def test_rough_poses_measure_nothing(folder, capsys):
    (folder / "flight" / "GT_pose.txt").rename(folder / "flight" / "GPS_pose.txt")
    (folder / "flight" / "dataset.json").write_text('{"truth": false}')
    assert main([*WORDS, "--photos", "flight", "town.city.json"]) == 2
    assert "no true poses" in capsys.readouterr().err


def test_photos_elsewhere_measure_nothing(folder, capsys):
    path = folder / "flight" / "GT_pose.txt"
    far = {name: pose.shifted([5000.0, 0.0, 0.0]) for name, pose in read_poses(path).items()}
    path.write_text("\n".join(format_pose(name, pose) for name, pose in far.items()) + "\n")
    assert main([*WORDS, "--photos", "flight", "--option", "height_column=ground", "town.city.json"]) == 0
    told = attributes(folder / "town.city.json")
    assert {each["height_from"] for each in told.values()} == {"column ground"}
