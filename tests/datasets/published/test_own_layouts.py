"""Loaders of own layouts: each reads its miniature, and refuses ten damaged ones in one line each."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from lodbench.citymodel import open_scene
from lodbench.citymodel.textured_map import read_textured
from lodbench.cli import main
from lodbench.datasets.published.catalogue import SPECS
from lodbench.datasets.registry import make_priors, open_dataset
from lodbench.errors import DatasetError
from tests.data import own_layouts as layouts
from tests.datasets.published.damages import GT, LOADERS
from tests.photos.dji_photo import PROPERTIES


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
        assert "READING_CONTRADICTED" in codes(opened("egeniouss", tmp_path, poses="w2c_opengl"))

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
        monkeypatch.setattr("lodbench.datasets.published.egeniouss_ortholoc._MOST_SAMPLES", 2)
        with pytest.raises(DatasetError, match=r"3 samples are more than the 2"):
            opened("ortholoc", tmp_path)
        assert len(opened("ortholoc", tmp_path, samples="L01_R*").entries) == 2


class TestSensors:
    def test_undistorted_photos_keep_what_they_state(self, tmp_path):
        from pyproj import Transformer

        layouts.write_semcitylocked(tmp_path)
        lon, lat = float(PROPERTIES["GpsLongitude"]), float(PROPERTIES["GpsLatitude"])
        east, north = Transformer.from_crs(4326, 25832, always_xy=True).transform(lon, lat)
        dataset = opened("semcitylocked", tmp_path, crs="EPSG:25832", origin=[east - 7, north + 4, 80.0])
        assert all(entry.image.suffix == ".png" for entry in dataset.entries)
        placed = make_priors("sensor", {}).apply(dataset, 0)
        for entry in placed.entries:
            np.testing.assert_allclose(entry.prior.center, [7, -4, 123.41], atol=0.01)


class TestMaps:
    def test_a_surface_model_lies_where_its_sample_does(self, tmp_path):
        layouts.write_ortholoc(tmp_path)
        dataset = opened("ortholoc", tmp_path, map_stride=1)
        corners = read_textured(dataset.textured_map).corners.reshape(-1, 3)
        # A cell of 2 km, ground of 200 m with seven houses, the tallest of 38 m, in each.
        low, high = corners.min(axis=0), corners.max(axis=0)
        np.testing.assert_allclose((low, high), ([-99, -99, 2], [4099, 99, 40]), atol=1e-3)
        scene = open_scene(dataset.city_model)
        assert (scene.num_buildings, scene.lod, scene.crs) == (21, "2", None)
        houses = np.split(scene.vertices + scene.origin, scene.vertex_starts[1:-1])
        tallest = [house for house in houses if house[:, 2].max() > 39]
        for k, house in enumerate(sorted(tallest, key=lambda house: house[0, 0])):
            wanted = [-4 + 2000 * k, 0, 2], [22 + 2000 * k, 30, 40]
            np.testing.assert_allclose((house.min(axis=0), house.max(axis=0)), wanted, atol=1e-3)

    def test_south_is_turned_to_north_and_origins_add_up(self, tmp_path):
        layouts.write_anyvisloc(tmp_path)
        dataset = opened("anyvisloc", tmp_path, map_stride=1)
        # Columns 30 to 49 and rows 20 to 29 of cells of 3 x 4 m from 110 m west and 115 m north on.
        for points, side in (
            (read_textured(dataset.textured_map).corners.reshape(-1, 3), 0.5),
            (city_points(dataset), 0.0),
        ):
            tall = points[points[:, 2] > 20]
            wanted = [-110 + 3 * (30 + side), 115 - 4 * (30 - side)]
            np.testing.assert_allclose(tall.min(axis=0)[:2], wanted, atol=1e-3)
            wanted = [-110 + 3 * (50 - side), 115 - 4 * (20 + side)]
            np.testing.assert_allclose(tall.max(axis=0)[:2], wanted, atol=1e-3)

    def test_a_map_that_shows_no_building_is_one_all_the_same(self, tmp_path):
        layouts.write_anyvisloc(tmp_path)
        path = tmp_path / "Scene_01" / "satellite_dsm.npy"
        np.save(path, np.full((60, 80), 3.0, np.float32))
        dataset = opened("anyvisloc", tmp_path, map="satellite")
        assert dataset.city_model == dataset.textured_map
        assert any("no building rises" in note for note in dataset.notes)
        assert open_scene(dataset.city_model).num_buildings == 1

    def test_cells_on_no_grid_are_refused(self, tmp_path):
        layouts.write_ortholoc(tmp_path)
        path = next(tmp_path.glob("full/test_inPlace/*.npz"))
        with np.load(path) as arrays:
            changed = dict(arrays)
        for dsm in (changed["dsm"][:, ::-1], changed["dsm"][:1], changed["dsm"] * [1, 0, 1]):
            np.savez(path, **{**changed, "dsm": dsm.astype(np.float32)})
            with pytest.raises(DatasetError, match="no regular grid"):
                opened("ortholoc", tmp_path)


def city_points(dataset) -> np.ndarray:
    scene = open_scene(dataset.city_model)
    return scene.vertices + scene.origin


class TestPictures:
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
        given = [line.split() for line in (tmp_path / GT).read_text().splitlines() if line[0] != "#"]
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
