"""Checks of datasets: photos, priors, and parts that contradict each other; sound ones are not accused."""

import shutil
import warnings
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from PIL import Image

from lodbench.cli import main
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.pose_text import format_camera, format_pose, lines_to_text, read_poses
from lodbench.datasets.query import Dataset, Entry
from lodbench.findings import Findings
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.harness.dataset_check import check_dataset, planned, prior_errors_in_words
from lodbench.harness.runs.requirements import check_photos
from tests.town import CAMERA, true_poses, write_dataset

POSE = Pose.from_euler(EulerAngles(30.0, 0.0, 0.0), (1.0, 2.0, 3.0))


def test_errors_of_priors_without_a_truth_are_not_known():
    entries = [
        SimpleNamespace(split=name, key=name, prior=prior) for name, prior in (("a", POSE), ("b", None))
    ]
    dataset = SimpleNamespace(splits=("a", "b"), entries=entries, truth={})
    assert prior_errors_in_words(dataset) == {"a": "errors not known, for there is no truth", "b": "no prior"}
    dataset.truth = {"a": POSE.shifted((3.0, 4.0, 0.0))}
    assert prior_errors_in_words(dataset)["a"] == "median 5.00 m / 0.00 deg"


@pytest.mark.parametrize(
    ("size", "problem"),
    [
        # Between Pillow's warning, from 89 megapixels on, and its error, from 179 on.
        ((12288, 8192), None),
        ((20000, 10000), "too many pixels"),
    ],
)
def test_a_large_photo_is_read_in_silence_and_a_bomb_is_a_finding(tmp_path, size, problem):
    photo = tmp_path / "a.png"
    Image.new("1", size).save(photo)
    entry = Entry("a.png", "data", None, None, photo, None)
    findings = Findings()
    with warnings.catch_warnings(action="error"):
        check_photos(Dataset("own", "", tmp_path, None, None, ("data",), (entry,), {}), True, findings)
    details = [item.detail for item in findings.items]
    assert len(details) == (problem is not None)
    assert all(str(problem) in detail for detail in details)


@pytest.mark.attack
def test_no_program_is_started_for_what_a_photo_is_by_its_content(tmp_path, monkeypatch):
    """Pillow hands PostScript to Ghostscript, whatever the file is called."""
    (tmp_path / "gs").write_text(f"#!/bin/sh\ntouch {tmp_path}/started\n")
    (tmp_path / "gs").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    photo = tmp_path / "a.png"
    photo.write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 48\n%%EndComments\nshowpage\n%%EOF\n")
    findings = Findings()
    entry = Entry("a.png", "data", Camera(64, 48, 50.0, 50.0, 32.0, 24.0), None, photo, photo)
    check_photos(Dataset("own", "", tmp_path, None, None, ("data",), (entry,), {}), True, findings)
    assert {item.code.name for item in findings.items} >= {"IMAGE_UNREADABLE"}
    assert not (tmp_path / "started").exists()


def test_masks_that_a_run_would_refuse_are_findings(tmp_path):
    camera = Camera(60, 40, 50.0, 50.0, 30.0, 20.0)
    of_labels, colours = tmp_path / "labels.png", tmp_path / "colours.png"
    Image.new("L", (60, 40), 1).save(of_labels)
    Image.new("RGB", (60, 40), (200, 10, 10)).save(colours)
    entry = Entry("a.png", "data", camera, None, None, of_labels, instances=colours)
    for with_pixels, said in ((True, ["largest value is 1", "is not a grey image"]), (False, [])):
        findings = Findings()
        check_photos(Dataset("own", "", tmp_path, None, None, ("data",), (entry,), {}), with_pixels, findings)
        details = [item.detail for item in findings.items]
        assert all(words in detail for words, detail in zip(said, details, strict=True))


def town(folder: Path) -> Path:
    """Six views with exact masks, and photos: noise all over, darker where a building is."""
    root, _ = write_dataset(folder, 6)
    (root / "Query_image").mkdir()
    generator = np.random.default_rng(3)
    for file in (root / "masks").iterdir():
        ground = 150 + generator.normal(scale=12, size=(240, 320, 3))
        photo = ground - 60 * (cv2.imread(str(file), -1)[..., None] > 0)
        cv2.imwrite(str(root / "Query_image" / file.name), np.clip(photo, 0, 255).astype(np.uint8))
    return root


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    return town(tmp_path_factory.mktemp("sound") / "town")


def found(root: Path, city: Path) -> dict[str, set[str]]:
    """Returns the names of the views by the finding."""
    dataset = open_folder(FolderParams(str(root), str(city)))
    names: dict[str, set[str]] = {}
    for item in check_dataset(dataset).findings.items:
        names.setdefault(f"{item.code.name} {item.code.severity.value}", set()).add(
            item.object_id.rpartition("/")[2]
        )
    return names


def change_masks(change):
    def apply(root: Path) -> None:
        for file in (root / "masks").iterdir():
            cv2.imwrite(str(file), change(cv2.imread(str(file), -1)))

    return apply


def change_camera(camera: Camera):
    def apply(root: Path) -> None:
        names = read_poses(root / "GT_pose.txt")
        (root / "intrinsic.txt").write_text(lines_to_text(format_camera(name, camera) for name in names))

    return apply


def exchange(folder: str, first: str = "view_01.png", second: str = "view_02.png"):
    def apply(root: Path) -> None:
        (root / folder / first).rename(root / "other")
        (root / folder / second).rename(root / folder / first)
        (root / "other").rename(root / folder / second)

    return apply


def copied(folder: str, change=lambda picture: picture):
    def apply(root: Path) -> None:
        picture = cv2.imread(str(root / folder / "view_01.png"), -1)
        cv2.imwrite(str(root / folder / "view_02.png"), change(picture))

    return apply


def move_truth(root: Path) -> None:
    moved = {name: pose.shifted((60.0, 45.0, 0.0)) for name, pose in read_poses(root / "GT_pose.txt").items()}
    (root / "GT_pose.txt").write_text(lines_to_text(format_pose(*item) for item in moved.items()))


ALL = set(true_poses(6))
K = CAMERA
CASES = {
    "as it is": (lambda root: None, {}),
    "focal length in millimetres": (
        change_camera(Camera(K.width, K.height, 8.8, 8.8, K.cx, K.cy)),
        {"FIELD_OF_VIEW error": ALL},
    ),
    "fx of another unit than fy": (
        change_camera(Camera(K.width, K.height, K.fx, K.fy / 2, K.cx, K.cy)),
        {"FIELD_OF_VIEW error": ALL},
    ),
    "focal length halved": (
        change_camera(Camera(K.width, K.height, K.fx / 2, K.fy / 2, K.cx, K.cy)),
        {"CAMERA_UNLIKE_VIEW error": ALL},
    ),
    "focal length doubled": (
        change_camera(Camera(K.width, K.height, K.fx * 2, K.fy * 2, K.cx, K.cy)),
        {"CAMERA_UNLIKE_VIEW error": ALL},
    ),
    "cx and cy exchanged": (
        change_camera(Camera(K.width, K.height, K.fx, K.fy, K.cy, K.cx)),
        {"PRINCIPAL_EXCHANGED error": ALL},
    ),
    "cx and cy 0": (
        change_camera(Camera(K.width, K.height, K.fx, K.fy, 0.0, 0.0)),
        {"PRINCIPAL_POINT warning": ALL, "CAMERA_UNLIKE_VIEW error": ALL},
    ),
    "masks mirrored": (change_masks(lambda mask: mask[:, ::-1]), {"MASK_TURNED error": ALL}),
    "masks upside down": (change_masks(lambda mask: mask[::-1]), {"MASK_TURNED error": ALL}),
    "masks turned": (change_masks(lambda mask: mask[::-1, ::-1]), {"MASK_TURNED error": ALL}),
    "masks inverted": (change_masks(lambda mask: 255 - mask), {"MASK_TURNED error": ALL}),
    "masks exchanged": (exchange("masks"), {"MASK_EXCHANGED error": {"view_01.png", "view_02.png"}}),
    "a mask copied": (copied("masks"), {"MASK_EXCHANGED error": {"view_02.png"}}),
    "photos exchanged": (exchange("Query_image"), {"PHOTO_EXCHANGED error": {"view_01.png", "view_02.png"}}),
    "a photo copied": (copied("Query_image"), {"PHOTO_TWICE error": {"view_02.png"}}),
    "a photo copied and made brighter": (
        copied("Query_image", lambda photo: cv2.add(photo, (1, 1, 1, 0))),
        {"PHOTO_TWICE error": {"view_02.png"}},
    ),
    "true poses elsewhere": (move_truth, {"MASK_UNLIKE_CITY warning": ALL}),
}


@pytest.mark.parametrize("case", CASES)
def test_a_contradiction_is_found_and_named(sound, tmp_path, case):
    change, wanted = CASES[case]
    root = Path(shutil.copytree(sound, tmp_path / "data"))
    change(root)
    names = found(root, sound.parent / "city.obj")
    for finding, views in wanted.items():
        # From some views another reading is as good: most must be found, and nobody else accused.
        assert len(names.get(finding, set())) >= max(1, round(0.6 * len(views)))
        assert names[finding] <= views
    assert {name for name in names if name.endswith("error")} <= {*wanted, "CAMERA_UNLIKE_VIEW error"}
    if not wanted:
        assert not names


def run(root: Path, tmp_path: Path, sound: Path, capsys) -> tuple[int, str]:
    code = main(
        ["run", "dataset=folder", f"dataset.root={root}", f"city={sound.parent / 'city.obj'}",
         "segmenter=masks", "method=contour_alignment", "limit=2",
         "executor.threads=1", f"paths.runs={tmp_path / 'runs'}"]
    )  # fmt: skip
    return code, capsys.readouterr().err


@pytest.mark.parametrize(
    ("case", "words"),
    [
        ("focal length in millimetres", "a focal length of 8.8 px sees 174 degrees"),
        ("cx and cy exchanged", "cx 118.5 and cy 161 of 320 x 240 are exchanged"),
        ("masks inverted", "if it is inverted"),
    ],
)
def test_a_run_on_nothing_but_contradictions_ends_before_any_work(sound, tmp_path, capsys, case, words):
    root = Path(shutil.copytree(sound, tmp_path / "data"))
    CASES[case][0](root)
    code, err = run(root, tmp_path, sound, capsys)
    assert (code, words in err) == (2, True), err
    assert not (tmp_path / "runs").exists()


def test_a_run_warns_of_single_ones_and_notes_them(sound, tmp_path, capsys, caplog):
    root = Path(shutil.copytree(sound, tmp_path / "data"))
    for folder in ("masks", "Query_image"):
        shutil.copy(root / folder / "view_01.png", root / folder / "view_00.png")
    code, _ = run(root, tmp_path, sound, capsys)
    assert code == 0
    (summary,) = (tmp_path / "runs").rglob("summary.json")
    for text in (caplog.text, summary.read_text()):
        assert "the mask of data/view_00.png: IoU" in text
        assert "data/view_01.png has the photo of data/view_00.png" in text


def test_poses_as_regular_as_a_plan_are_called_so():
    turn = [Pose.from_euler(EulerAngles(40.0, 0.0, 10.0 * i), (3.0 * i, 0.0, 120.0)) for i in range(12)]
    assert planned(turn) == "12 poses have 1 heights and 1 tilts"
    generator = np.random.default_rng(0)
    swaying = [
        Pose.from_euler(EulerAngles(*generator.normal((40.0, 0.0, 10.0), 0.2)), (3.0 * i, 0.0, 120 + 0.1 * i))
        for i in range(12)
    ]
    assert planned(swaying) == planned(turn[:7]) == ""
