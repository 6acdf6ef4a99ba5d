"""Pose files of four formats: read alike, matched by name, faults named by line, conventions suspected."""

import math
from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer

from lodbench.datasets.pose_files import brought, read_pose_file
from lodbench.datasets.pose_text import FoundPose, format_pose, inverted, lines_to_text
from lodbench.datasets.query import Entry
from lodbench.errors import ConfigError, DatasetError
from lodbench.evaluation import pose_error
from lodbench.evaluation.predictions import match_poses, suspect_convention
from lodbench.geometry import EulerAngles, Pose
from tests.town import true_poses

TRUTH = true_poses(3)
ENTRIES = [Entry(name, "all", None, None, None, None) for name in TRUTH]


def lines(poses: dict[str, Pose]) -> str:
    return lines_to_text(format_pose(*item) for item in poses.items())


def colmap(poses: dict[str, Pose]) -> str:
    rows = ["# IMAGE_ID, QW, ..."]
    for number, (name, pose) in enumerate(poses.items(), start=1):
        numbers = " ".join(repr(float(v)) for v in (*pose.quat_wxyz, *pose.translation))
        # The second line of an image may be empty, or hold points that look like anything.
        rows += [f"{number} {numbers} 1 {name}", "" if number == 1 else "1.5 2.5 -1 3.5 4.5 17"]
    return lines_to_text(rows)


def tum(poses: dict[str, Pose], stamp=lambda index, name: Path(name).stem) -> str:
    rows = []
    for index, (name, pose) in enumerate(poses.items()):
        w, x, y, z = inverted(pose).quat_wxyz
        numbers = [*pose.center, x, y, z, w]
        rows.append(" ".join([str(stamp(index, name)), *(repr(float(v)) for v in numbers)]))
    return lines_to_text(rows)


def c2w(folder: Path, poses: dict[str, Pose]) -> Path:
    folder.mkdir()
    for name, pose in poses.items():
        np.savetxt(folder / f"{Path(name).stem}_pose.txt", pose.world_from_cam)
    return folder


def write(tmp_path: Path, kind: str, poses: dict[str, Pose]) -> Path:
    if kind == "c2w":
        return c2w(tmp_path / "poses", poses)
    path = tmp_path / "poses.txt"
    path.write_text({"lines": lines, "colmap": colmap, "tum": tum}[kind](poses))
    return path


# TUM lines that start with names, not times, cannot be told from others.
@pytest.mark.parametrize(
    ("kind", "asked"),
    [(kind, kind) for kind in ("lines", "c2w", "colmap", "tum")]
    + [(kind, "auto") for kind in ("lines", "c2w", "colmap")],
)
def test_every_format_gives_the_same_poses(tmp_path, kind, asked):
    path = write(tmp_path, kind, TRUTH)
    read, found = read_pose_file(path, asked)
    assert read == kind
    matched = match_poses(found, ENTRIES, kind)
    assert matched.notes == ()
    assert set(matched.poses) == {f"all/{name}" for name in TRUTH}
    for name, pose in TRUTH.items():
        error = pose_error(matched.poses[f"all/{name}"], pose)
        assert error.translation_m < 1e-9
        assert error.rotation_deg < 1e-9


def test_tum_is_mapped_by_order_only_if_counts_agree_and_times_increase(tmp_path):
    path = tmp_path / "trajectory.txt"
    path.write_text(tum(TRUTH, lambda index, name: 1700000000.25 + index))
    kind, found = read_pose_file(path, "auto")
    matched = match_poses(found, ENTRIES, kind)
    assert kind == "tum"
    assert "order" in matched.notes[0]
    assert list(matched.poses) == [f"all/{name}" for name in TRUTH]
    with pytest.raises(DatasetError, match="No name"):
        match_poses(found[:2], ENTRIES, kind)
    with pytest.raises(DatasetError, match="do not increase"):
        match_poses(found[::-1], ENTRIES, kind)


def test_a_name_that_is_a_number_is_no_timestamp_if_it_is_a_query(tmp_path):
    pose = next(iter(TRUTH.values()))
    (tmp_path / "p.txt").write_text(format_pose("0001", pose) + "\n")
    assert read_pose_file(tmp_path / "p.txt", "auto", {"0001"})[0] == "lines"
    with pytest.raises(DatasetError, match="line 1"):  # as TUM its numbers are no rotation
        read_pose_file(tmp_path / "p.txt", "auto")


@pytest.mark.parametrize("number", ["nan", "inf", "abc"])
@pytest.mark.parametrize("kind", ["lines", "colmap", "tum"])
def test_what_is_no_finite_number_is_named_by_its_line(tmp_path, kind, number):
    path = write(tmp_path, kind, TRUTH)
    rows = path.read_text().splitlines()
    words = rows[-1 if kind != "colmap" else -2].split()
    words[5] = number
    rows[-1 if kind != "colmap" else -2] = " ".join(words)
    path.write_text(lines_to_text(rows))
    with pytest.raises(DatasetError, match=rf"line {len(rows) - (kind == 'colmap')}"):
        read_pose_file(path, kind)


def test_a_matrix_that_is_not_finite_or_no_rotation_is_named_by_its_file(tmp_path):
    folder = c2w(tmp_path / "poses", TRUTH)
    for bad in (np.full((4, 4), math.nan), 2 * np.eye(4), np.eye(3), np.diag([1, 1, -1, 1])):
        np.savetxt(folder / "view_01_pose.txt", bad)
        with pytest.raises(DatasetError, match=r"view_01_pose\.txt"):
            read_pose_file(folder, "auto")


class TestMatching:
    def found(self, *names: str) -> list[FoundPose]:
        pose = next(iter(TRUTH.values()))
        return [FoundPose(name, f"p.txt, line {i}", pose) for i, name in enumerate(names, start=1)]

    def test_missing_names_are_simply_not_there(self):
        assert list(match_poses(self.found("view_01.png"), ENTRIES, "lines").poses) == ["all/view_01.png"]

    def test_folders_before_a_name_are_dropped_and_that_is_said(self):
        matched = match_poses(self.found("query/view_01.png", "all/view_00.png"), ENTRIES, "lines")
        assert list(matched.poses) == ["all/view_01.png", "all/view_00.png"]
        assert matched.notes == (
            "1 of the file's names were taken by their file name alone: query/view_01.png as all/view_01.png",
        )

    def test_a_double_name_is_refused_with_both_lines(self):
        with pytest.raises(DatasetError, match=r"line 2.*from p.txt, line 1"):
            match_poses(self.found("view_01.png", "query/view_01.png"), ENTRIES, "lines")

    def test_unknown_names_are_counted_and_some_shown(self):
        matched = match_poses(self.found("view_01.png", "a", "b", "c", "d"), ENTRIES, "lines")
        assert matched.notes == ("4 of the file's names are no query and were left out: a, b, c, ...",)
        with pytest.raises(DatasetError, match="No name"):
            match_poses(self.found("a"), ENTRIES, "lines")

    def test_a_name_of_two_splits_must_say_which(self):
        entries = [Entry("a.png", split, None, None, None, None) for split in ("in", "out")]
        with pytest.raises(DatasetError, match=r"in/a\.png, out/a\.png"):
            match_poses(self.found("a.png"), entries, "lines")
        assert list(match_poses(self.found("out/a.png"), entries, "lines").poses) == ["out/a.png"]


class TestConvention:
    def test_the_right_one_is_not_suspected(self):
        assert suspect_convention(TRUTH, TRUTH, True) is None
        far = {name: pose.shifted([50.0, 0, 0]) for name, pose in TRUTH.items()}
        assert suspect_convention(far, TRUTH, True) is None

    def test_the_other_direction_is_said(self):
        turned = {name: inverted(pose) for name, pose in TRUTH.items()}
        assert "camera to world" in suspect_convention(turned, TRUTH, False)

    def test_the_other_order_of_a_quaternion_is_said(self):
        turned = {
            name: Pose.from_quaternion([*pose.quat_wxyz[1:], pose.quat_wxyz[0]], pose.translation)
            for name, pose in TRUTH.items()
        }
        assert "real part last" in suspect_convention(turned, TRUTH, True)
        assert suspect_convention({}, TRUTH, True) is None


def test_wrong_settings_and_files_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="format=kitti"):
        read_pose_file(tmp_path, "kitti")
    with pytest.raises(DatasetError, match="does not exist"):
        read_pose_file(tmp_path / "none.txt", "auto")
    (tmp_path / "p.txt").write_text("a b c\n")
    with pytest.raises(DatasetError, match="no known pose format") as caught:
        read_pose_file(tmp_path / "p.txt", "auto")
    # Not every command that reads poses takes a format.
    assert caught.value.hint.startswith("Known formats: ")
    (tmp_path / "p.txt").write_text("")
    with pytest.raises(DatasetError, match=r"p\.txt holds no poses"):
        read_pose_file(tmp_path / "p.txt", "auto")
    with pytest.raises(DatasetError, match="is a file"):
        read_pose_file(tmp_path / "p.txt", "c2w")
    (tmp_path / "p.txt").write_text("# nothing\n")
    with pytest.raises(DatasetError, match="no poses"):
        read_pose_file(tmp_path / "p.txt", "lines")


@pytest.mark.parametrize("asked", ["auto", "colmap"])
def test_the_folder_above_colmap_s_models_says_where_they_are(tmp_path, asked):
    for model in ("sparse/0", "sparse/1"):
        (tmp_path / model).mkdir(parents=True)
        (tmp_path / model / "images.txt").write_text(colmap(TRUTH))
    for folder in (tmp_path, tmp_path / "sparse"):
        with pytest.raises(DatasetError, match="holds no COLMAP model") as caught:
            read_pose_file(folder, asked)
        told = " ".join(str(tmp_path / "sparse" / number) for number in "01").replace(" ", ", ")
        assert caught.value.hint == f"Name one of those below it: {told}"


CITY = "EPSG:25832+7837"
CENTER = (280_950.5, 5_657_400.25)


def found(crs: str | None, center=CENTER) -> FoundPose:
    pose = Pose.from_euler(EulerAngles(50.0, 3.0, -40.0), (*center, 160.0))
    return FoundPose("a.jpg", "geo.txt, line 2", pose, crs=crs)


@pytest.mark.parametrize("crs", ["EPSG:23032", "EPSG:25831", "EPSG:32632", "EPSG:31466"])
def test_a_camera_sees_the_same_places_in_the_city_s_system(crs):
    way = Transformer.from_crs(crs, "EPSG:25832", always_xy=True, allow_ballpark=False)
    image = found(crs, way.transform(*CENTER, direction="INVERSE"))
    (moved,), (note,) = brought([image], CITY)
    assert moved.pose.center == pytest.approx([*CENTER, 160.0], abs=1e-3)
    assert f"poses in {crs} brought to {CITY}; its heights stay as they are" in note
    for pixel in [(0, 0, 1), (1, 0, 1), (0, 1, 1)]:
        east, north, up = image.pose.center + 10 * image.pose.rotation.T @ np.array(pixel, float)
        seen = np.array([*way.transform(east, north), up])
        ray = moved.pose.rotation @ (seen - moved.pose.center)
        # A metre of the plane is not quite one on the ground: up to 1 in 1000 between zones.
        assert ray / ray[2] == pytest.approx(pixel, abs=2e-3)


def test_poses_of_the_same_plane_or_of_none_stay():
    for crs in ("EPSG:25832", "EPSG:25832+5783", None):
        image = found(crs)
        assert brought([image], CITY) == ([image], ())
    image = found("EPSG:25833")
    assert brought([image], None) == ([image], ())


@pytest.mark.parametrize(
    ("crs", "words"),
    [
        ("EPSG:2263", "EPSG:2263 is not in metres to the east and north"),
        ("EPSG:26918", "in EPSG:26918 cannot be brought to EPSG:25832"),
    ],
)
def test_what_cannot_be_brought_is_refused_by_both_names(crs, words):
    with pytest.raises(DatasetError, match=words) as caught:
        brought([found(crs)], CITY)
    assert CITY in caught.value.hint
