"""`lodbench city convert` and `city make`: what is written, and from what."""

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
from tests.citymodel.gml_text import box_city, box_rings, city, member, solid_of, write
from tests.citymodel.surface_case import NORTH, WEST, heights_of, rectangle, write_footprints, write_raster
from tests.reporting.browser import PHONE, opened
from tests.town import BOXES, CAMERA, box_obj


def box(name: str, east: float, lod: int) -> str:
    return member(solid_of(box_rings(east), lod), name)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Where a city lies, and the same as two tiles."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiles").mkdir()
    for name, east in (("a.gml", 500000.0), ("tiles/a.gml", 500000.0), ("tiles/b.gml", 500500.0)):
        write(tmp_path / name, city(box(f"at {east:g}", east, 1)))
    return tmp_path


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize(
    ("words", "count", "told"),
    [
        (["a.gml", "a.gml"], 1, "a.gml is named twice: it is read once"),
        (["a.gml", "../{}/a.gml"], 1, "a.gml is named twice"),
        (["tiles", "tiles/b.gml"], 2, "tiles/b.gml lies in tiles: it is read once"),
        (["tiles/b.gml", "a.gml"], 2, ""),
    ],
)
def test_a_city_named_twice_is_read_once(capsys, folder, words, count, told):
    words = [word.format(folder.name) for word in words]
    assert main(["city", "convert", *words, "-o", "out.city.json", "--json"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["buildings"] == count
    assert "LB205" not in printed.out
    assert told in printed.err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["tiles", "out.scene", "--lod", "9"], "level of detail 9"),
        (["tiles", "out.scene", "--lod", "1", "--roof-height", "meidan"], "--roof-height=meidan is"),
        (["a.gml", "out.scene", "--lod", "9"], "level of detail 9"),
        (["a.gml", "new/t.gml", "--tiles", "100", "--lod", "9"], "level of detail 9"),
        (["a.gml", "new/t.gml", "--tiles", "100", "--id", "nix"], "nix"),
    ],
)
def test_a_fault_leaves_nothing(capsys, folder, words, told):
    before = names(folder)
    assert main(["city", "convert", *words]) == 2
    assert told in capsys.readouterr().err
    assert names(folder) == before


def test_tiles_of_a_cut_that_ends_in_a_fault_are_not_left(capsys, folder):
    """The second has no building of the level; what another program wrote stays."""
    write(folder / "mixed.gml", city(box("low", 500000.0, 1) + box("high", 500500.0, 2)))
    (folder / "cut").mkdir()
    (folder / "cut" / "notes.txt").write_text("mine")
    assert main(["city", "convert", "mixed.gml", "cut/t.glb", "--tiles", "100", "--lod", "1"]) == 2
    assert "level of detail 1" in capsys.readouterr().err
    assert names(folder / "cut") == ["notes.txt"]


def test_tiles_that_are_done_wait_for_one_that_is_mended(capsys, folder):
    (folder / "tiles" / "c.gml").write_text(box_city()[:-400])
    assert main(["city", "convert", "tiles", "out.scene", "--executor", "serial"]) == 2
    assert "out.scene.parts" in names(folder)
    write(folder / "tiles" / "c.gml", box_city())
    assert main(["city", "convert", "tiles", "out.scene", "--executor", "serial"]) == 0
    assert "out.scene.parts" not in names(folder)


pytest.importorskip("rasterio")
pytest.importorskip("pyogrio")

HOUSES = [(10.0, 10.0, 22.0, 20.0, 6.0), (40.0, 12.0, 48.0, 30.0, 9.5), (60.0, 60.0, 90.0, 80.0, 3.2)]


@pytest.fixture
def folder_of_city_make(tmp_path, monkeypatch) -> Path:
    """Footprints, two of them over a surface model; a third has a height, a fourth nothing."""
    monkeypatch.chdir(tmp_path)
    shapes = [*(rectangle(*house) for house in HOUSES), rectangle(300, 300, 310, 310)]
    nothing = float("nan")
    write_footprints(
        tmp_path / "f.gpkg", shapes, id=["a", "b", "c", "<d>"], height=[nothing, 1.0, 7.5, nothing]
    )
    write_raster(tmp_path / "dsm.tif", heights_of(HOUSES[:2]))
    write_raster(tmp_path / "dtm.tif", heights_of([]))
    return tmp_path


WORDS = ["city", "make", "--footprints", "f.gpkg", "--dsm", "dsm.tif", "--dtm", "dtm.tif"]


def test_a_city_and_a_page_of_what_came_from_where(folder_of_city_make, capsys):
    assert main([*WORDS, "town.city.json", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["heights_from"] == {"surface model": 2, "column height": 1}
    assert told["left_out"] == {"no height": 1}
    objects = json.loads((folder_of_city_make / "town.city.json").read_text())["CityObjects"]
    heights = {name: each["attributes"]["measuredHeight"] for name, each in objects.items()}
    assert heights == pytest.approx({"a": 6.0, "b": 9.5, "c": 7.5}, abs=0.1)
    assert objects["c"]["attributes"]["height_from"] == "column height"
    page = (folder_of_city_make / "town.city.html").read_text()
    assert "&lt;d&gt;" in page
    for scheme, size in (("light", PHONE), ("dark", PHONE)):
        with opened(folder_of_city_make / "town.city.html", size, scheme) as (shown, complaints):
            assert shown.locator(".map path[class^=kind]").count() == 3
            assert shown.evaluate("document.documentElement.scrollWidth <= innerWidth")
        assert complaints == []


def test_for_people(folder_of_city_make, capsys):
    assert main([*WORDS, "town.gml"]) == 0
    text = capsys.readouterr().out
    for words in ("3 buildings", "2  height from surface model", "1  left out: no height", "town.html"):
        assert words in text
    assert main(["city", "check", "town.gml"]) == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([*WORDS, "f.gpkg"], "f.gpkg"),
        (
            ["city", "make", "--footprints", "f.gpkg", "--dsm", "no.tif", "town.json"],
            "no surface model at no.tif",
        ),
        (["city", "make", "--footprints", "f.gpkg", "--dsm", "dsm.tif", "town.docx"], "town.docx"),
    ],
)
def test_refused_in_one_line_with_nothing_written(folder_of_city_make, capsys, words, said):
    before = sorted(path.name for path in folder_of_city_make.iterdir())
    assert main(words) == 2
    assert said in capsys.readouterr().err
    assert sorted(path.name for path in folder_of_city_make.iterdir()) == before


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
def photo_folder(drawn, tmp_path, monkeypatch) -> Path:
    shutil.copytree(drawn, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


PHOTO_WORDS = ["city", "make", "--footprints", "f.gpkg"]


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


def test_photos_of_a_dataset_measure_roofs(photo_folder, capsys):
    assert main([*PHOTO_WORDS, "--photos", "flight", "town.city.json", "--json"]) == 0
    made = json.loads(capsys.readouterr().out)
    told = attributes(photo_folder / "town.city.json")
    require_true_heights(told)
    # A column says 3 m of a house of 8.
    assert told["h6"]["measuredHeight"] == pytest.approx(8.0, abs=1.0)
    assert made["photos"] == 8
    assert made["left_out"] == {"no height": 1}
    page = (photo_folder / "town.city.html").read_text()
    assert "photos" in page
    scene = open_scene(photo_folder / "town.city.json")
    assert scene.vertices[:, 2].max() + scene.origin[2] == pytest.approx(140.0, abs=1.0)


def test_photos_with_poses_of_a_file_and_a_default_height(photo_folder):
    known = read_poses(photo_folder / "flight" / "GT_pose.txt")
    write_colmap([FoundPose(name, "", pose, SHARP) for name, pose in known.items()], photo_folder / "sparse")
    words = ["--photos", "flight/Query_image", "--poses", "sparse", "--option", "default_height_m=7"]
    assert main([*PHOTO_WORDS, *words, "town.city.json"]) == 0
    told = attributes(photo_folder / "town.city.json")
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
def test_photos_are_refused_in_one_line_with_nothing_written(photo_folder, capsys, words, said):
    assert main([*PHOTO_WORDS, *words, "town.city.json"]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error
    assert not (photo_folder / "town.city.json").exists()


def test_rough_poses_measure_nothing(photo_folder, capsys):
    (photo_folder / "flight" / "GT_pose.txt").rename(photo_folder / "flight" / "GPS_pose.txt")
    (photo_folder / "flight" / "dataset.json").write_text('{"truth": false}')
    assert main([*PHOTO_WORDS, "--photos", "flight", "town.city.json"]) == 2
    assert "no true poses" in capsys.readouterr().err


def test_photos_elsewhere_measure_nothing(photo_folder, capsys):
    path = photo_folder / "flight" / "GT_pose.txt"
    far = {name: pose.shifted([5000.0, 0.0, 0.0]) for name, pose in read_poses(path).items()}
    path.write_text("\n".join(format_pose(name, pose) for name, pose in far.items()) + "\n")
    assert (
        main([*PHOTO_WORDS, "--photos", "flight", "--option", "height_column=ground", "town.city.json"]) == 0
    )
    told = attributes(photo_folder / "town.city.json")
    assert {each["height_from"] for each in told.values()} == {"column ground"}
