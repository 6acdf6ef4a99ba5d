"""Loaders of own layouts: each reads its miniature, and refuses ten damaged ones in one line each."""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from lodbench.cli import main
from lodbench.datasets.published.catalogue import SPECS
from lodbench.datasets.registry import open_dataset
from lodbench.errors import DatasetError
from lodbench.geometry import Pose
from tests.data import own_layouts as layouts

Damage = Callable[[Path], None]


def replaced(place: str, old: str, new: str, count: int = 1) -> Damage:
    """Returns what changes the text of a file by a pattern."""

    def damage(root: Path) -> None:
        (path,) = sorted(root.glob(place))[:1]
        text = path.read_text()
        changed = re.sub(old, new, text, count=count, flags=re.MULTILINE)
        assert changed != text
        path.write_text(changed)

    return damage


def written(place: str, data: bytes) -> Damage:
    """Returns what gives the first file of a pattern another content."""
    return lambda root: sorted(root.glob(place))[0].write_bytes(data) and None


def cut(place: str, share: float = 0.5) -> Damage:
    """Returns what cuts off the end of a file."""

    def damage(root: Path) -> None:
        path = sorted(root.glob(place))[0]
        path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])

    return damage


def removed(place: str) -> Damage:
    """Returns what removes the files of a pattern."""

    def damage(root: Path) -> None:
        for path in sorted(root.glob(place)):
            path.unlink()

    return damage


def array(place: str, name: str, change: Callable[[np.ndarray], object]) -> Damage:
    """Returns what changes an array of the first sample; None leaves it out."""

    def damage(root: Path) -> None:
        path = sorted(root.glob(place))[0]
        with np.load(path) as arrays:
            found = dict(arrays)
        changed = change(found.pop(name))
        np.savez(path, **found, **({} if changed is None else {name: changed}))

    return damage


def stated(key: str, value: object, name: str = "aerial") -> Damage:
    """Returns what changes AnyVisLoc's reference; None leaves it out."""

    def damage(root: Path) -> None:
        path = next(root.glob("Scene_01/*.json"))
        known = json.loads(path.read_text())
        known["modes"][name][key] = value
        path.write_text(json.dumps(known))

    return damage


def turned_sideways(place: str) -> Damage:
    """Returns what rotates all quaternions by 90 degrees around the view."""

    def damage(root: Path) -> None:
        path = root / place
        lines = []
        for line in path.read_text().splitlines():
            words = line.split()
            if not line.startswith("#") and len(words) == 8:
                w, x, y, z = (float(v) * 0.5**0.5 for v in words[1:5])
                words[1:5] = [f"{v:.9f}" for v in (w - z, x + y, y - x, z + w)]
            lines.append(" ".join(words))
        layouts.write_lines(path, lines)

    return damage


@dataclass(frozen=True)
class Loader:
    """What is known of a loader: its miniature, the settings it needs, and damages with what is said."""

    write: Callable[[Path], dict[str, Pose]]
    damages: dict[str, tuple[Damage, str]]
    settings: dict[str, object] = field(default_factory=dict)
    bad_settings: dict[str, str] = field(default_factory=dict)


_GT, _SAMPLE = "egenioussBench/query_images/val_gt_poses.txt", "full/test_inPlace/*.npz"
_POSES, _COLMAP = "Query/poses/gt_pose.txt", "data/all_colmaps/UAVD4L-LoD/Japan_07/colmap_320"
_OBJECT = np.array([{"a": 1}], dtype=object)
LOADERS = {
    "egeniouss": Loader(
        layouts.write_egeniouss,
        {
            "six numbers": (replaced(_GT, r" \S+$", "", 3), "line 3: 6 values after the name"),
            "no number": (replaced(_GT, r" \S+$", " north", 3), "line 3: could not convert"),
            "not finite": (replaced(_GT, r"(IMG.*) \S+$", r"\1 nan"), "no place on Earth"),
            "no unit quaternion": (replaced(_GT, r"(IMG\S+) \S+", r"\1 3"), "quaternion has length"),
            "name twice": (replaced(_GT, "IMG_20240001", "IMG_20240000"), "occurs twice"),
            "empty": (written(_GT, b"# nothing\n"), "holds no poses"),
            "binary": (written(_GT, b"\xff\xfe\x00\x81"), "not a text file"),
            "sideways": (turned_sideways(_GT), "is not documented, and the pictures do not decide"),
            "camera": (written("*/metadata/*.txt", b"fx = 110\n"), "has no line MODEL W H params"),
            "phone's head": (
                written("*/query_images/val_android*", b"name,lat,lon,alt\n"),
                "line 1: 3 values after the name",
            ),
            "far away": (replaced(_GT, r"(IMG.*) \S+$", r"\1 1e9"), "no place on Earth"),
        },
        bad_settings={
            "poses=c2w": "dataset.poses=c2w is unknown",
            "priors=gps": "dataset.priors=gps is unknown",
            "camera=PINHOLE 96": "dataset.camera='PINHOLE 96': too few values",
            "height_offset_m=.nan": "dataset.height_offset_m",
            "zone=32": "takes no zone",
        },
    ),
    "ortholoc": Loader(
        layouts.write_ortholoc,
        {
            "no archive": (written(_SAMPLE, b"nothing"), "is no readable .npz"),
            "cut off": (cut(_SAMPLE), "is no readable .npz"),
            "pickled": (
                array(_SAMPLE, "extrinsics", lambda a: _OBJECT),
                "is no readable .npz: Object arrays",
            ),
            "lacking": (array(_SAMPLE, "extrinsics", lambda a: None), "has no array extrinsics"),
            "no rotation": (array(_SAMPLE, "extrinsics", lambda a: 2 * a), "holds no rotation"),
            "not finite": (array(_SAMPLE, "extrinsics", lambda a: a * np.nan), "not finite"),
            "skew": (array(_SAMPLE, "intrinsics", lambda a: a + np.eye(3, k=1)), "no pinhole without skew"),
            "negative focal length": (
                array(_SAMPLE, "intrinsics", lambda a: a * [[-1, 1, 1]]),
                "intrinsics: ",
            ),
            "grey": (
                array(_SAMPLE, "image_query", lambda a: a[..., 0]),
                "image_query is (120, 160), not N x N x 3",
            ),
            "of floats": (array(_SAMPLE, "image_query", lambda a: a / 255), "image_query is of type float64"),
            "points of another size": (
                array(_SAMPLE, "point_map", lambda a: a[:50]),
                "point_map is (50, 160, 3)",
            ),
            "points elsewhere": (
                lambda root: (
                    [
                        array(f"full/*/*{k:04d}.npz", "point_map", lambda a: np.roll(a, 3, axis=1))(root)
                        for k in range(3)
                    ]
                    and None
                ),
                "px off their pixels",
            ),
            "holes only": (array(_SAMPLE, "dsm", lambda a: a * np.nan), "dsm holds no height"),
        },
        bad_settings={
            "samples=L99*": "is called L99*",
            "focal=guess": "dataset.focal=guess is unknown",
            "pixel_origin=left": "dataset.pixel_origin=left is unknown",
            "map_stride=0": "dataset.map_stride",
        },
    ),
    "anyvisloc": Loader(
        layouts.write_anyvisloc,
        {
            "cut off": (cut("Scene_01/*.npz"), "is no readable .npz"),
            "pickled": (
                array("Scene_01/*.npz", "K", lambda a: _OBJECT),
                "is no readable .npz: Object arrays",
            ),
            "lacking": (array("Scene_01/*.npz", "K", lambda a: None), "has no array K"),
            "not finite": (
                array("Scene_01/*.npz", "xyz", lambda a: a * np.inf),
                "xyz has values that are not finite",
            ),
            "angles elsewhere": (array("Scene_01/*.npz", "euler_deg", lambda a: a + 40), "agree in 2 of 3"),
            "photo outside": (
                array("Scene_01/*3.npz", "image_relpath", lambda a: np.array("../../etc/passwd")),
                "is no file beside it",
            ),
            "no JSON": (written("Scene_01/*.json", b"{"), "L01_reference.json"),
            "no modes": (written("Scene_01/*.json", b"{}"), "has no modes"),
            "no resolution": (stated("map_resolution", None), "map_resolution is no pair of numbers"),
            "resolution of zero": (stated("dsm_resolution", [0, 1]), "is not above 0"),
            "map outside": (stated("dsm_path", "/etc/passwd"), "is no file beside it"),
            "map damaged": (written("Scene_01/aerial_map.png", b"PNG"), "cannot be read as a picture"),
            "heights cut off": (cut("Scene_01/aerial_dsm.npy"), "is no surface model"),
        },
        bad_settings={
            "scene=Scene_99": "There is no Scene_99",
            "prior_track=yaw": "dataset.prior_track=yaw is unknown",
            "map=drone": "dataset.map=drone is unknown",
            "prior_range_m=-1": "dataset.prior_range_m",
        },
    ),
    "semcitylocked": Loader(
        layouts.write_semcitylocked,
        {
            "no faces": (replaced("*/LoD_model/*lod2.obj", "^f .*$", "", 0), "TUM_CC_lod2.obj"),
            "no OBJ": (written("*/LoD_model/*lod2.obj", b"\x00\x01"), "TUM_CC_lod2.obj"),
            "no number": (replaced("*/LoD_model/*lod2.obj", r"^v \S+", "v west"), "TUM_CC_lod2.obj"),
            "as high as wide": (
                replaced("*/LoD_model/*lod2.obj", r"^(v.*) 18$", r"\1 120", 4),
                "points up is not documented",
            ),
            "photo cut off": (cut("*/original_images/*", 0.93), "is no picture of 160 x 120"),
            "poses of six numbers": (replaced("poses.txt", r" \S+$", ""), "line 1"),
            "poses not finite": (replaced("poses.txt", r"(DJI.*) \S+$", r"\1 nan"), "line 1"),
            "no unit quaternion": (replaced("poses.txt", r"(DJI\S+) \S+", r"\1 3"), "quaternion has length"),
            "no poses": (written("poses.txt", b"\n"), "holds no poses"),
            "binary poses": (written("poses.txt", b"\xff\xfe\x81"), "poses.txt"),
        },
        {"poses": "ROOT/poses.txt", "poses_format": "lines"},
        {
            "level=4": "dataset.level=4 is unknown",
            "up_axis=x": "dataset.up_axis=x is unknown",
            "origin=[1,2]": "takes three numbers",
            "poses_format=pickle": "format=pickle is not known",
        },
    ),
    "tokyo_lodv3": Loader(
        layouts.write_tokyo,
        {
            "line cut off": (replaced(f"{_COLMAP}/images.txt", r"^1 (\S+) .*$", r"1 \1"), "images.txt"),
            "not finite": (replaced(f"{_COLMAP}/images.txt", r"^1 \S+", "1 nan"), "images.txt"),
            "no unit quaternion": (replaced(f"{_COLMAP}/images.txt", r"^1 \S+", "1 5"), "images.txt"),
            "camera without a number": (
                replaced(f"{_COLMAP}/cameras.txt", r"^1 (.*) \S+$", r"1 \1"),
                "cameras.txt",
            ),
            "no priors": (written("data/UAVD4L-LoD/*/GPS*.txt", b"# none\n"), "GPS_pose_new_all.txt"),
            "no queries": (written("data/UAVD4L-LoD/Japan_07/dataset_test.txt", b""), "lists no query"),
            "query twice": (
                replaced("data/UAVD4L-LoD/Japan_07/dataset_test.txt", "DJI_0001", "DJI_0000"),
                "lists DJI_0000_W.JPG twice",
            ),
            "prior of six numbers": (
                replaced("data/UAVD4L-LoD/*/GPS*.txt", r" \S+$", ""),
                "GPS_pose_new_all.txt",
            ),
            "prior not finite": (
                replaced("data/UAVD4L-LoD/*/GPS*.txt", r" \S+$", " inf"),
                "GPS_pose_new_all.txt",
            ),
            "binary priors": (written("data/UAVD4L-LoD/*/GPS*.txt", b"\xff\xfe\x81"), "GPS_pose_new_all.txt"),
        },
        {"city_model": "ROOT/city.obj"},
        {"axes=blender": "dataset.axes=blender is unknown", "prior_file=GPS.txt": "is in no split"},
    ),
    "uavd4l": Loader(
        layouts.write_uavd4l,
        {
            "six numbers": (replaced(_POSES, r" \S+$", ""), "line 1: 6 values"),
            "not finite": (replaced(_POSES, r" \S+$", " nan"), "line 1"),
            "no unit quaternion": (replaced(_POSES, r"(DJI\S+) \S+", r"\1 3"), "quaternion has length"),
            "name twice": (replaced(_POSES, "DJI_202201", "DJI_202200"), "occurs twice"),
            "empty": (written(_POSES, b""), "No true pose"),
            "binary": (written(_POSES, b"\xff\xfe\x81"), "no UTF-8 text"),
            "other names": (replaced(_POSES, "DJI", "IMG", 0), "No true pose"),
            "unknown camera": (replaced("Query/intrinsics/w*", "PINHOLE", "LENS"), "w_intrinsic.txt, line 1"),
            "negative focal length": (
                replaced("Query/intrinsics/w*", " 140.0", " -140.0"),
                "w_intrinsic.txt, line 1",
            ),
            "prior of six numbers": (replaced("Query/poses/w*", r" \S+$", ""), "w_pose.txt, line 1"),
            "tile without faces": (replaced("Model/*.obj", "^f .*$", "", 0), "tile_0_0.obj"),
        },
        bad_settings={"map_origin=[1,2]": "takes three numbers", "textured_map=nowhere": "does not exist"},
    ),
}


def settings_of(name: str, root: Path) -> dict[str, object]:
    return {
        key: value.replace("ROOT", str(root)) if isinstance(value, str) else value
        for key, value in LOADERS[name].settings.items()
    }


def check(name: str, root: Path, capsys, *words: str) -> tuple[int, str, str]:
    """Runs `lodbench dataset check`; returns its exit code, and what it printed."""
    told = [f"--set={key}={value}" for key, value in settings_of(name, root).items()]
    code = main(["dataset", "check", name, "--root", str(root), *told, *words])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path / "cache"))


@pytest.mark.parametrize("name", LOADERS)
class TestEveryLoader:
    def test_reads_its_miniature(self, name, tmp_path):
        truth = LOADERS[name].write(tmp_path / "data")
        dataset = open_dataset(
            {"name": name, "root": str(tmp_path / "data"), **settings_of(name, tmp_path / "data")}
        )
        assert dataset.truth.keys() == truth.keys()
        for key, pose in truth.items():
            np.testing.assert_allclose(dataset.truth[key].center, pose.center, atol=2e-6)
            np.testing.assert_allclose(dataset.truth[key].rotation, pose.rotation, atol=1e-6)
        for entry in dataset.entries:
            assert entry.camera is not None
            assert not entry.camera.distortion
            assert entry.image.is_file()
        assert set(dataset.splits) <= {*(split.name for split in SPECS[name].splits), "Scene_01"}
        assert dataset.protocol == SPECS[name].protocol

    def test_check_finds_nothing_wrong(self, name, tmp_path, capsys):
        LOADERS[name].write(tmp_path / "data")
        code, out, err = check(name, tmp_path / "data", capsys)
        # Counts of a miniature, and regular poses, are none of the real thing.
        wrong = re.findall(r"LB\d+ (\w+), (?:error|warning)", out)
        assert code == 0, out + err
        assert set(wrong) <= {"COUNT_UNEXPECTED", "TRUTH_LIKE_PLAN", "CITY_NOT_IN_VIEW", "SPLIT_MISSING"}

    def test_an_empty_folder_is_explained_on_one_screen(self, name, tmp_path, capsys):
        code = main(["dataset", "check", name, "--root", str(tmp_path)])
        out, err = capsys.readouterr()
        assert (code, out) == (2, "")
        assert len(err.splitlines()) <= 24
        assert "missing:" in err
        assert all(host.url in err for host in SPECS[name].hosts)

    def test_list_says_where_it_is(self, name, tmp_path, capsys):
        assert main(["dataset", "list", "--root", str(tmp_path)]) == 0
        assert re.search(rf"^{name} +not there: {SPECS[name].title}", capsys.readouterr().out, re.MULTILINE)
        LOADERS[name].write(tmp_path / "data")
        main(["dataset", "list", "--root", str(tmp_path / "data"), "--json"])
        (found,) = [each for each in json.loads(capsys.readouterr().out) if each["name"] == name]
        assert found["bytes"] > 0
        assert [line for line in found["missing"] if "city model" not in line] == []


CASES = [(name, damage) for name, loader in LOADERS.items() for damage in loader.damages]


@pytest.mark.parametrize(("name", "damage"), CASES, ids=[f"{name}, {damage}" for name, damage in CASES])
def test_a_damaged_one_is_refused_in_one_line(name, damage, tmp_path, capsys):
    root = tmp_path / "data"
    LOADERS[name].write(root)
    break_it, words = LOADERS[name].damages[damage]
    break_it(root)
    code, out, err = check(name, root, capsys)
    assert (code, out) == (2, ""), out
    first, *hint = err.splitlines()
    assert words in first
    assert len(hint) <= 1


@pytest.mark.parametrize("name", LOADERS)
def test_ten_damages_of_each(name):
    assert len(LOADERS[name].damages) >= 10


SETTINGS = [(name, word) for name, loader in LOADERS.items() for word in loader.bad_settings]


@pytest.mark.parametrize(("name", "word"), SETTINGS, ids=[f"{name}, {word}" for name, word in SETTINGS])
def test_a_wrong_setting_is_refused_by_its_name(name, word, tmp_path, capsys):
    LOADERS[name].write(tmp_path / "data")
    code, out, err = check(name, tmp_path / "data", capsys, f"--set={word}")
    assert (code, out) == (2, "")
    assert LOADERS[name].bad_settings[word] in err.splitlines()[0]


def opened(name: str, root: Path, **settings: object):
    return open_dataset({"name": name, "root": str(root), **settings_of(name, root), **settings})


def codes(dataset) -> list[str]:
    return [item.code.name for item in dataset.findings]


class TestWhatIsLeftOpen:
    @pytest.mark.parametrize("reading", ["c2w_opencv", "c2w_opengl", "w2c_opencv", "w2c_opengl"])
    def test_level_pictures_decide_how_poses_are_read(self, tmp_path, reading):
        truth = layouts.write_egeniouss(tmp_path, reading)
        dataset = opened("egeniouss", tmp_path)
        assert "READING_INFERRED" in codes(dataset)
        assert [f.detail.split(":")[0] for f in dataset.findings if f.object_id == "dataset.poses"] == [
            reading
        ]
        for key, pose in truth.items():
            np.testing.assert_allclose(dataset.truth[key].rotation, pose.rotation, atol=1e-6)

    def test_a_reading_that_is_set_counts_and_is_doubted(self, tmp_path):
        layouts.write_egeniouss(tmp_path)
        assert "READING_UNFIT" in codes(opened("egeniouss", tmp_path, poses="w2c_opengl"))

    def test_another_vertical_datum_is_noticed(self, tmp_path, capsys):
        layouts.write_egeniouss(tmp_path)
        assert check("egeniouss", tmp_path, capsys)[0] == 0
        code, out, _ = check("egeniouss", tmp_path, capsys, "--set=height_offset_m=43.5")
        assert code == 1
        assert "HEIGHTS_UNLIKE" in out

    @pytest.mark.parametrize("axes", ["opencv", "opengl"])
    def test_upright_pictures_decide_the_camera_s_axes(self, tmp_path, axes):
        truth = layouts.write_tokyo(tmp_path, axes)
        dataset = opened("tokyo_lodv3", tmp_path)
        for entry in dataset.entries:
            np.testing.assert_allclose(
                dataset.truth[entry.key].rotation, truth[entry.key].rotation, atol=1e-9
            )
            np.testing.assert_allclose(entry.prior.center - truth[entry.key].center, [4, 3, 0], atol=1e-6)
            assert len(entry.hypotheses) == 2

    @pytest.mark.parametrize("half_px", [0.5, 0.0])
    def test_point_maps_decide_where_pixels_begin(self, tmp_path, half_px):
        layouts.write_ortholoc(tmp_path, half_px)
        camera = opened("ortholoc", tmp_path).entries[0].camera
        assert (camera.cx, camera.cy) == pytest.approx((layouts.DRONE.cx, layouts.DRONE.cy))

    @pytest.mark.parametrize("frame", ["left", "right"])
    def test_either_frame_of_matrices_is_read(self, tmp_path, frame):
        truth = layouts.write_anyvisloc(tmp_path, frame)
        dataset = opened("anyvisloc", tmp_path)
        for key, pose in truth.items():
            np.testing.assert_allclose(dataset.truth[key].rotation, pose.rotation, atol=1e-9)

    @pytest.mark.parametrize("up", ["y", "z"])
    def test_the_flat_side_of_a_city_decides_its_vertical(self, tmp_path, up):
        layouts.write_semcitylocked(tmp_path, up)
        assert opened("semcitylocked", tmp_path).city_options.up_axis == up

    def test_poses_far_from_their_tiles_are_moved(self, tmp_path):
        origin = (400_000.0, 3_130_000.0, 0.0)
        truth = layouts.write_uavd4l(tmp_path, origin)
        dataset = opened("uavd4l", tmp_path, map_origin=list(origin))
        for entry in dataset.entries:
            np.testing.assert_allclose(dataset.truth[entry.key].center, truth[entry.key].center, atol=1e-6)
            np.testing.assert_allclose(entry.prior.center - truth[entry.key].center, [3, 1, -4], atol=1e-6)


class TestTracks:
    def test_an_unknown_focal_length_is_a_first_guess_and_how_good_it_is(self, tmp_path):
        layouts.write_ortholoc(tmp_path)
        entry = opened("ortholoc", tmp_path, focal="unknown").entries[0]
        assert (entry.camera.fx, entry.camera.cx) == (192.0, 80.0)
        assert entry.camera_sigmas.focal_percent == entry.lens_percent == 30.0

    def test_yaw_and_pitch_or_pitch_alone(self, tmp_path):
        truth = layouts.write_anyvisloc(tmp_path)
        for track, off in (("yp", 1e-6), ("p", 180.0)):
            dataset = opened("anyvisloc", tmp_path, prior_track=track, prior_range_m=30.0)
            turns = []
            for entry in dataset.entries:
                angles, known = entry.prior.euler, truth[entry.key].euler
                assert angles.pitch_deg == pytest.approx(known.pitch_deg, abs=1e-6)
                assert angles.roll_deg == pytest.approx(0, abs=1e-6)
                away = entry.prior.center - truth[entry.key].center
                assert abs(away[2]) < 1e-9
                assert (0 < abs(away[:2])).all()
                assert (abs(away[:2]) <= 30).all()
                turns.append(abs((angles.yaw_deg - known.yaw_deg + 180) % 360 - 180))
            assert max(turns) <= off
            assert track == "yp" or max(turns) > 1
        assert all(e.prior is None for e in opened("anyvisloc", tmp_path, prior_track="none").entries)

    def test_too_many_samples_are_refused(self, tmp_path, monkeypatch):
        layouts.write_ortholoc(tmp_path)
        monkeypatch.setattr("lodbench.datasets.published.ortholoc._MOST_SAMPLES", 2)
        with pytest.raises(DatasetError, match=r"3 samples are more than the 2"):
            opened("ortholoc", tmp_path)
        assert len(opened("ortholoc", tmp_path, samples="L01_R*").entries) == 2


class TestMaps:
    def test_a_surface_model_lies_where_its_sample_does(self, tmp_path):
        from lodbench.citymodel import open_scene

        layouts.write_ortholoc(tmp_path)
        dataset = opened("ortholoc", tmp_path, map_stride=1)
        scene = open_scene(dataset.city_model)
        points = scene.vertices + scene.origin
        # A cell of 2 km, ground of 200 m; a tower of 25 m in each.
        low, high = points.min(axis=0), points.max(axis=0)
        np.testing.assert_allclose((low, high), ([-99, -99, 2], [4099, 99, 27]), atol=1e-3)
        near = points[np.abs(points[:, 0] - 2000) < 500]
        assert near[near[:, 2] > 20].min(axis=0).tolist() == pytest.approx([1981, -13, 27], abs=1e-3)

    def test_south_is_turned_to_north_and_origins_add_up(self, tmp_path):
        from lodbench.citymodel import open_scene

        layouts.write_anyvisloc(tmp_path)
        scene = open_scene(opened("anyvisloc", tmp_path, map_stride=1).city_model)
        tall = (scene.vertices + scene.origin)[scene.vertices[:, 2] + scene.origin[2] > 20]
        # Columns 30 to 49 and rows 20 to 29 of cells of 3 x 4 m from 110 m west and 115 m north on.
        np.testing.assert_allclose(tall.min(axis=0)[:2], [-110 + 3 * 30.5, 115 - 4 * 29.5], atol=1e-3)
        np.testing.assert_allclose(tall.max(axis=0)[:2], [-110 + 3 * 49.5, 115 - 4 * 20.5], atol=1e-3)

    def test_distorted_photos_are_undistorted_once(self, tmp_path):
        layouts.write_anyvisloc(tmp_path, dist=(-0.08, 0.01, 0.0, 0.0, 0.0))
        first = opened("anyvisloc", tmp_path).entries[0]
        before = first.image.stat().st_mtime_ns
        assert first.camera.fx != layouts.DRONE.fx
        assert opened("anyvisloc", tmp_path).entries[0].image.stat().st_mtime_ns == before


def submitted(dataset, poses):
    """Returns lines of a submission as (rotation, place) by name: read without lodbench."""
    from scipy.spatial.transform import Rotation

    found = {}
    for line in dataset.submission(poses).splitlines():
        if not line.startswith("#"):
            name, w, x, y, z, *place = line.split()
            found[name] = (
                Rotation.from_quat([float(v) for v in (x, y, z, w)]).as_matrix(),
                np.array(place, float),
            )
    return found


class TestSubmissions:
    @pytest.mark.parametrize("reading", ["c2w_opencv", "c2w_opengl", "w2c_opencv", "w2c_opengl"])
    def test_egenioussbench_gets_its_own_lines_back(self, tmp_path, reading):
        layouts.write_egeniouss(tmp_path, reading)
        dataset = opened("egeniouss", tmp_path, height_offset_m=-12.5)
        answers = dict(dataset.truth) | {"test/IMG_20249000.jpg": None}
        text = dataset.submission(answers)
        assert text.splitlines()[0] == "# IMAGE_NAME qw qx qy qz UTMx UTMy alt"
        given = [line.split() for line in (tmp_path / _GT).read_text().splitlines() if line[0] != "#"]
        written = {line.split()[0]: np.array(line.split()[1:], float) for line in text.splitlines()[1:]}
        assert list(written) == [words[0] for words in given]
        for name, *numbers in given:
            sign = np.sign(written[name][:4] @ np.array(numbers[:4], float))
            np.testing.assert_allclose(sign * written[name][:4], np.array(numbers[:4], float), atol=1e-8)
            np.testing.assert_allclose(written[name][4:], np.array(numbers[4:], float), atol=1e-6)

    @pytest.mark.parametrize("axes", ["opencv", "opengl"])
    def test_tokyo_s_lines_are_in_its_axes(self, tmp_path, axes):
        truth = layouts.write_tokyo(tmp_path, axes)
        found = submitted(opened("tokyo_lodv3", tmp_path), truth)
        flip = layouts.FLIP if axes == "opengl" else np.eye(3)
        for key, pose in truth.items():
            rotation, translation = found[key.split("/")[1]]
            np.testing.assert_allclose(rotation, flip @ pose.rotation, atol=1e-9)
            np.testing.assert_allclose(translation, flip @ pose.translation, atol=1e-9)

    def test_uavd4l_s_poses_go_back_to_where_they_were(self, tmp_path):
        origin = (400_000.0, 3_130_000.0, 0.0)
        truth = layouts.write_uavd4l(tmp_path, origin)
        found = submitted(opened("uavd4l", tmp_path, map_origin=list(origin)), truth)
        for key, pose in truth.items():
            rotation, translation = found[key.split("/")[1]]
            np.testing.assert_allclose(-rotation.T @ translation, pose.center + origin, atol=1e-6)

    def test_ortholoc_s_predictions_are_in_each_sample_s_coordinates(self, tmp_path):
        truth = layouts.write_ortholoc(tmp_path)
        dataset = opened("ortholoc", tmp_path)
        lost = next(iter(truth))
        lines = dataset.submission(truth | {lost: None}).splitlines()
        assert f"{Path(lost).stem} None" in lines
        poses = list(layouts.true_poses(3).values())
        for line in (line for line in lines if not line.endswith("None") or "q:" in line):
            name, quaternion, translation = re.fullmatch(
                r"(\S+) - 0 \(best\): q: \[(.*?)\] t: \[(.*?)\] fx: None fy: None cx: None cy: None", line
            ).groups()
            pose = poses[int(name[-4:])]
            x, y, z, w = map(float, quaternion.split(","))
            np.testing.assert_allclose(abs(np.dot([w, x, y, z], pose.quat_wxyz)), 1, atol=1e-12)
            np.testing.assert_allclose(
                [float(v) for v in translation.split(",")], pose.translation, atol=1e-9
            )

    def test_export_writes_it_and_says_where_there_is_none(self, tmp_path, monkeypatch, capsys):
        monkeypatch.chdir(tmp_path)
        layouts.write_tokyo(tmp_path / "tokyo")
        layouts.write_anyvisloc(tmp_path / "avl")
        for name, words in (("tokyo_lodv3", [f"city={tmp_path}/tokyo/city.obj"]), ("anyvisloc", [])):
            root = tmp_path / ("tokyo" if words else "avl")
            words = [*words, f"dataset.root={root}", f"paths.runs={tmp_path / name}"]
            assert main(["run", f"dataset={name}", "method=prior_only", "segmenter=none", *words]) == 0
        (tokyo,), (avl,) = (list((tmp_path / name).glob("*/*/*")) for name in ("tokyo_lodv3", "anyvisloc"))
        assert main(["export", str(tokyo), "--format", "submission"]) == 0
        assert len((tokyo / "export" / "submission.txt").read_text().splitlines()) == 3
        assert json.loads((tokyo / "summary.json").read_text())["protocol"]["bins"] == "lodlocv3"
        capsys.readouterr()
        assert main(["export", str(avl), "--format", "submission"]) == 2
        assert "anyvisloc has no format of submissions" in capsys.readouterr().err
