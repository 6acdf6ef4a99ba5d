"""`lodbench georeference`: a COLMAP model in a frame of its own, placed in a city by masks of its photos."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from shapely.geometry import shape

import lodbench
from lodbench.cli import main
from lodbench.datasets.exchange.colmap import read_colmap, write_colmap
from lodbench.datasets.exchange.lines import write_lines
from lodbench.datasets.exchange.photogrammetry import write_odm
from lodbench.datasets.folder import write_poses
from lodbench.datasets.pose_files import brought, read_pose_file
from lodbench.datasets.pose_text import FoundPose
from lodbench.evaluation import pose_error
from lodbench.geometry import Pose
from lodbench.geometry.similarity import Similarity
from lodbench.harness.georeference import GeoreferenceRequest
from lodbench.harness.photo.flight_inputs import rough_start
from lodbench.methods.georeference import Georeference
from lodbench.photos.map_frame import MapFrame
from lodbench.synthesis.flights import FlightsParams, open_flights
from tests.cli.photo_case import stated
from tests.photos.dji_photo import write_photo, xmp_packet

COUNT, NOISE_M, NOISE_DEG = 6, 0.05, 0.03


@dataclass
class Case:
    """A reconstruction, its masks, and the truth behind them."""

    model: Path
    masks: Path
    rough: Path
    city: Path
    truth: dict[str, Pose]


@pytest.fixture(scope="module")
def case(tmp_path_factory, shared_data) -> Case:
    """A seeded flight over a real tile; its true poses in an arbitrary frame, with noise."""
    city = shared_data / "city/germany_lod2/LoD2_32_280_5657_1_NW.gml"
    dataset = open_flights(
        FlightsParams(
            str(city), num_flights=1, num_photos=COUNT, path="orbit", mask_iou=0.93, flights_seed=100
        )
    )
    generator = np.random.default_rng(5)
    turn = Rotation.random(random_state=5).as_matrix()
    middle = np.mean([pose.center for pose in dataset.truth.values()], axis=0)
    own = Similarity(0.04, turn, np.array([3.0, -2.0, 7.0]) - 0.04 * turn @ middle)
    folder = tmp_path_factory.mktemp("reconstruction")
    model, rough, truth = [], [], {}
    for entry in dataset.entries:
        true = dataset.truth[entry.key]
        shaken = Rotation.from_rotvec(generator.normal(0, NOISE_DEG, 3), degrees=True).as_matrix()
        seen = Pose.from_center(shaken @ true.rotation, true.center + generator.normal(0, NOISE_M, 3))
        model.append(FoundPose(entry.name, "", own.pose(seen), entry.camera))
        rough.append(FoundPose(entry.name, "", entry.prior))
        truth[entry.name] = true
    write_colmap(model, folder / "sparse")
    (folder / "sparse" / "points3D.txt").write_text("1 3.0 -2.0 7.0 9 9 9 0.5 1 0\n")
    write_lines(rough, folder / "rough.txt")
    return Case(folder / "sparse", dataset.entries[0].mask.parent, folder / "rough.txt", city, truth)


def georeference(capsys, case: Case, out: Path, *words: object) -> tuple[int, str]:
    code = main(["georeference", *map(str, (case.model, "--city", case.city, "--out", out, *words))])
    told = capsys.readouterr()
    return code, told.out + told.err


def errors_m(poses, truth) -> list[float]:
    return [pose_error(found.pose, truth[Path(found.name).name]).translation_m for found in poses]


@pytest.mark.slow
def test_a_model_is_placed_within_decimetres_and_handed_on(capsys, case, tmp_path):
    words = "--masks", case.masks, "--start", case.rough
    code, told = georeference(capsys, case, tmp_path, *words)
    assert code == 0
    assert f"cameras       {COUNT}, placed by the masks of {COUNT}" in told
    rough = [
        pose_error(pose.pose, case.truth[pose.name]).translation_m
        for pose in read_pose_file(case.rough, "lines")[1]
    ]
    errors = errors_m(read_colmap(tmp_path / "colmap"), case.truth)
    assert np.median(rough) > 4.0
    assert np.median(errors) < 0.6
    # The similarity says so itself, and its own sigmas cover what it is off by.
    said = json.loads((tmp_path / "similarity.json").read_text())
    assert said["similarity"]["scale"] == pytest.approx(1 / 0.04, rel=0.01)
    off = np.mean(
        [found.pose.center - case.truth[found.name].center for found in read_colmap(tmp_path / "colmap")],
        axis=0,
    )
    sigmas = [said["sigmas"][name] for name in ("east_m", "north_m", "up_m")]
    assert (np.abs(off) < 4.0 * np.array(sigmas) + 0.05).all()
    # Each format is read back as the same cameras.
    for name, file in (
        ("metashape", "metashape_reference.txt"),
        ("pix4d", "calibrated_external_camera_parameters.txt"),
        ("odm", "geo.txt"),
    ):
        assert max(errors_m(read_pose_file(tmp_path / file, name)[1], case.truth)) < 1.5
    moved = [float(word) for word in (tmp_path / "colmap" / "points3D.txt").read_text().split()[1:4]]
    middle = np.mean([pose.center for pose in case.truth.values()], axis=0)
    assert np.linalg.norm(np.array(moved) - middle) < 1.0
    features = json.loads((tmp_path / "cameras.geojson").read_text())["features"]
    cameras = [each for each in features if each["properties"].get("kind") == "estimate"]
    frame = MapFrame("EPSG:25832+7837")
    east, north = frame.east_north(*shape(cameras[0]["geometry"]).coords[0][::-1])
    assert (east, north) == pytest.approx(case.truth[cameras[0]["properties"]["name"]].center[:2], abs=1.0)


@pytest.mark.slow
def test_what_was_found_is_a_start_of_its_own_and_of_this_model(capsys, case, tmp_path):
    for start in (case.rough, tmp_path / "similarity.json"):
        code, told = georeference(capsys, case, tmp_path, "--masks", case.masks, "--start", start)
        assert code == 0
    assert "the similarity in" in told
    assert np.median(errors_m(read_colmap(tmp_path / "colmap"), case.truth)) < 0.6


@pytest.mark.slow
def test_a_model_that_its_masks_do_not_place_is_not_to_be_trusted(capsys, case, tmp_path):
    masks = sorted(case.masks.iterdir())
    (tmp_path / "masks").mkdir()
    for mask, other in zip(masks, [*masks[3:], *masks[:3]], strict=True):
        shutil.copy(other, tmp_path / "masks" / mask.name)
    code, told = georeference(
        capsys, case, tmp_path / "out", "--masks", tmp_path / "masks", "--start", case.rough
    )
    said = json.loads((tmp_path / "out" / "similarity.json").read_text())
    assert max(errors_m(read_colmap(tmp_path / "out" / "colmap"), case.truth)) > 2.0
    assert code == 3
    assert f"{len(said['untrusted'])} of {len(said['used'])} are unreliable" in told
    assert "What helps: masks that show the buildings" in told
    assert not said["trusted"]


def test_rough_poses_in_another_system_are_brought_to_the_city_s(case, tmp_path):
    rough = [pose._replace(crs="EPSG:25832") for pose in read_pose_file(case.rough, "lines")[1]]
    write_odm(brought(rough, "EPSG:25833")[0], tmp_path / "geo.txt", "EPSG:25833")
    request = GeoreferenceRequest(
        city=case.city,
        out=tmp_path,
        model=case.model,
        method=Georeference(),
        start=tmp_path / "geo.txt",
    )
    images = list(read_colmap(case.model))
    start = rough_start(request, images, MapFrame("EPSG:25832+7837"))
    assert "poses in EPSG:25833 brought to EPSG:25832+7837" in start.notes[0]
    placed = [image._replace(pose=start.similarity.pose(image.pose)) for image in images]
    assert max(errors_m(placed, case.truth)) < 30.0


@pytest.mark.parametrize("text", ['{"model": "elsewhere"}', "{}", "no JSON"])
def test_the_result_of_another_model_is_not_written_over(capsys, case, tmp_path, text):
    (tmp_path / "similarity.json").write_text(text)
    code, told = georeference(capsys, case, tmp_path, "--masks", case.masks, "--start", case.rough)
    assert code == 2
    assert "similarity.json is no result of placing" in told
    assert "--out OTHER" in told
    assert [file.name for file in tmp_path.iterdir()] == ["similarity.json"]


@pytest.mark.parametrize("name", ["geo.txt", "cameras.geojson", "colmap"])
def test_somebody_else_s_file_is_not_written_over(capsys, case, tmp_path, name):
    """Control points of ODM, or the model itself in `colmap`: projects have files of these names."""
    shutil.copytree(case.model, tmp_path / "colmap") if name == "colmap" else (tmp_path / name).touch()
    code, told = georeference(capsys, case, tmp_path, "--masks", case.masks, "--start", case.rough)
    assert code == 2
    assert f"{name} is no result of placing" in told
    assert [file.name for file in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--masks", "EMPTY", "--start", "ROUGH"), "0 of 6 photos can be used, and 3 are needed"),
        (("--masks", "BLACK", "--start", "ROUGH"), "photos can be used, and 3 are needed"),
        (("--masks", "MASKS", "--start", "FAR"), "km outside the city model"),
        (("--masks", "MASKS", "--start", "FEW"), "2 of the model's 6 cameras have a rough place"),
    ],
)
def test_what_is_missing_is_said_in_one_line(capsys, case, tmp_path, words, said):
    (tmp_path / "empty").mkdir()
    (tmp_path / "black").mkdir()
    for mask in case.masks.iterdir():
        size = cv2.imread(str(mask)).shape[:2]
        cv2.imwrite(str(tmp_path / "black" / mask.name), np.zeros(size, np.uint8))
    rough = read_pose_file(case.rough, "lines")[1]
    write_lines([pose._replace(pose=pose.pose.shifted((9e4, 0, 0))) for pose in rough], tmp_path / "far.txt")
    write_lines(rough[:2], tmp_path / "few.txt")
    known = {
        "MASKS": case.masks, "ROUGH": case.rough, "EMPTY": tmp_path / "empty",
        "BLACK": tmp_path / "black", "FAR": tmp_path / "far.txt", "FEW": tmp_path / "few.txt",
    }  # fmt: skip
    code, told = georeference(capsys, case, tmp_path / "out", *(known.get(word, word) for word in words))
    assert code == 2
    assert said in told
    assert not (tmp_path / "out").exists()


def test_no_photo_and_no_mask_is_taken_for_two_images_of_one_name(capsys, case, tmp_path):
    model, rough = list(read_colmap(case.model)), read_pose_file(case.rough, "lines")[1]
    names = [f"cam{k % 2}/{model[k // 2].name}" for k in range(COUNT)]
    write_colmap(
        [each._replace(name=name) for each, name in zip(model, names, strict=True)], tmp_path / "two"
    )
    write_lines(
        [each._replace(name=name) for each, name in zip(rough, names, strict=True)], tmp_path / "r.txt"
    )
    words = [
        "--city",
        case.city,
        "--masks",
        case.masks,
        "--start",
        tmp_path / "r.txt",
        "--out",
        tmp_path / "o",
    ]
    assert main(["georeference", *map(str, (tmp_path / "two", *words))]) == 2
    assert "is of other images as well: keep the model's folders" in capsys.readouterr().err
    images = tmp_path / "images"
    images.mkdir()
    for each in model:
        (images / each.name).write_bytes(each.name.encode())
    words = ["--city", case.city, "--masks", case.masks, "--images", images, "--out", tmp_path / "o"]
    assert main(["georeference", *map(str, (tmp_path / "two", *words))]) == 2
    assert "may be of several of the model's images" in capsys.readouterr().err


@pytest.mark.slow
def test_photos_are_found_whatever_the_letters_of_their_ending(capsys, case, tmp_path):
    bare = [each._replace(name=Path(each.name).stem) for each in read_colmap(case.model)][:4]
    write_colmap(bare, tmp_path / "bare")
    images = tmp_path / "images"
    images.mkdir()
    stems = [image.name for image in bare]
    for stem, pose in ((Path(name).stem, pose) for name, pose in case.truth.items()):
        if stem not in stems:
            continue
        properties = stated(pose, "EPSG:25832+7837", False, 0.0)
        write_photo(images / f"{stem}.JPG", xmp=xmp_packet(properties))
    words = ["--city", case.city, "--masks", case.masks, "--images", images, "--out", tmp_path / "o"]
    # Photos of one shade contradict nothing that their masks say.
    assert main(["georeference", *map(str, (tmp_path / "bare", *words))]) == 0
    assert f"what the photos state: {len(bare)} cameras" in capsys.readouterr().out


def dataset_of(case: Case, root: Path, masks: int) -> Path:
    """Writes the flight as a dataset with the model as its reconstruction, and so many of the masks."""
    cameras = {image.name: image.camera for image in read_colmap(case.model)}
    priors = {found.name: found.pose for found in read_pose_file(case.rough, "lines")[1]}
    (root / "masks").mkdir(parents=True)
    write_poses(root, cameras, case.truth, priors)
    for mask in sorted(case.masks.iterdir())[:masks]:
        shutil.copy(mask, root / "masks")
    return root


@pytest.mark.slow
def test_a_run_places_photos_without_masks_as_well_and_says_where_the_model_lies(capsys, case, tmp_path):
    root = dataset_of(case, tmp_path / "own", COUNT - 1)
    words = ["dataset=folder", f"dataset.root={root}", f"city={case.city}", f"paths.runs={tmp_path / 'runs'}"]
    assert main(["run", "method=georeference", *words]) == 2
    assert "method=georeference needs poses of its photos in a reconstruction" in capsys.readouterr().err
    shutil.copytree(case.model, root / "reconstruction")
    assert main(["run", "method=georeference", *words]) == 0
    (run,) = (tmp_path / "runs").glob("*/georeference/*")
    errors = lodbench.load_run(run).queries["translation_error_m"]
    assert len(errors) == COUNT
    assert max(errors) < 0.8
    (findings,) = (run / "flights").glob("*.json")
    placement = json.loads(findings.read_text())["placement"]
    assert placement["similarity"]["scale"] == pytest.approx(1 / 0.04, rel=0.01)
    ((name, reason),) = placement["left_out"]
    assert name == sorted(case.truth)[-1]
    assert "mask" in reason
    assert len(placement["used"]) == COUNT - 1
    assert main(["report", str(run), "--out", str(tmp_path / "page.html")]) == 0
