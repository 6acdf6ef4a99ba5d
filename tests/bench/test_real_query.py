"""Redrawn priors of real photos; maps made of traced masks, wrong by what is requested."""

import json
import math

import cv2
import numpy as np
import pandas as pd
import pytest

from lodbench.bench.photo_masks import TracedOptions, open_traced_photos
from lodbench.bench.real_query import RealOptions, RealSet, measure_real, shared_and_own
from lodbench.bench.real_report import flight_errors, held, is_within, report_real, trusted
from lodbench.citymap import CityMap
from lodbench.citymodel import open_scene
from lodbench.cli.bench import main
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.errors import DatasetError
from lodbench.evaluation.metrics import ERROR
from lodbench.evaluation.pose_errors import Threshold
from lodbench.geometry import EulerAngles, Pose
from lodbench.methods.protocol import Estimate, FlightEstimate
from lodbench.segmentation.masks import read_mask
from lodbench.segmentation.protocol import make_segmenter
from tests.town import write_dataset


def trials(*ends):
    """Returns trials of one method that end so many metres and degrees off, with their probabilities."""
    rows = [dict(zip((*ERROR, "probability"), end, strict=True)) for end in ends]
    common = {
        "photo": "photo.jpg",
        "prior": "0",
        "score": 0.1,
        "seconds": 1.0,
        "cpu_seconds": 1.0,
        "surprise": math.nan,
        "failure": "",
        "set": "data",
        "flight": "all",
        "height_m": 100.0,
        **dict.fromkeys(("east_m", "north_m", "up_m", "edges_px", "edges_found"), math.nan),
        **dict.fromkeys(("ground_m", "ground_held"), math.nan),
    }
    common |= {"prior_translation_error_m": 20.0, "prior_rotation_error_deg": 3.0}
    return pd.DataFrame(rows).assign(method="m", **common)


class TestTheReport:
    def test_places_are_held_by_what_was_said_of_them(self):
        ends = trials(*[(1.0, 0.1, 0.5)] * 4)
        assert held(ends) is None
        assert "places within" not in str(report_real(ends, "data").figures)
        # Squared standard deviations in three directions: 95 % stay below 7.81; one answer said nothing.
        said = ends.assign(surprise=[0.5, 7.8, 7.9, math.nan])
        assert held(said).tolist() == [True, True, False]
        report = report_real(said, "data")
        figures = {f.figure: f.value for f in report.figures}
        assert figures["m: places within the said 95 %"] == pytest.approx(200 / 3)
        assert "67 %" in report.text

    def test_intervals_are_over_photos(self):
        ends = trials((1.0, 0.1, 0.5), (1.0, 0.1, 0.5), (9.0, 0.1, 0.5), (9.0, 0.1, 0.5))
        one, two = (
            report_real(each, "data").text.splitlines()
            for each in (ends, ends.assign(photo=["a", "a", "b", "b"]))
        )
        # One photo says nothing of others; of two that are wholly right and wholly wrong, all may be.
        assert " to " not in one[2]
        assert "0 to 100 %" in two[2]

    def test_limits_are_strict_and_failures_count(self):
        ends = trials((1.9, 0.1, 0.5), (2.0, 0.1, 0.5), (1.0, 1.5, 0.5), (math.inf, 180.0, 0.0))
        assert is_within(ends, Threshold(2, 1)).tolist() == [True, False, False, False]
        assert is_within(ends, Threshold(2, 2)).tolist() == [True, False, True, False]
        figures = {f.figure: f.value for f in report_real(ends, "data").figures}
        assert figures["m: recall 2m-2deg"] == 50.0
        assert figures["m: priors"] == 4.0


def flight(places, **more):
    """Returns trials of one flight's photos that end (N, 3) metres from the truth."""
    places = np.array(places, dtype=np.float64)
    rows = trials(*[(float(np.linalg.norm(place)), 0.1, 0.95) for place in places])
    ends = dict(zip(("east_m", "north_m", "up_m"), places.T, strict=True))
    return rows.assign(photo=[f"{k}.jpg" for k in range(len(places))], **ends, **more)


class TestFlights:
    def test_common_and_own_errors_add_up_to_all(self):
        rows = flight([(3, 4, -2), (3, 4, -2), (3, 5, -2), (0, 4, -2), (3, 4, 3)])
        common = flight_errors(rows)
        assert common[:4] == pytest.approx((-2.0, -2.0, 5.0, 5.0))
        # 0, 0, 1, 3 and 5 m are left.
        assert common.own_m == pytest.approx(1.0)
        assert flight_errors(rows.iloc[:2]) is None
        lost = flight([(3, 4, -2)] * 3 + [(math.nan,) * 3])
        assert flight_errors(lost) == pytest.approx((-2.0, -2.0, 5.0, 5.0, 0.0))

    def test_opposite_errors_of_two_priors_do_not_cancel(self):
        rows = [flight([(0, 0, up)] * 3, height_m=50.0).assign(prior=str(up)) for up in (-2.0, 3.0, 2.5)]
        assert flight_errors(pd.concat(rows))[:2] == pytest.approx((2.5, 5.0))

    def test_wrong_answers_are_counted_among_the_trusted(self):
        rows = flight([(0, 0, 1), (0, 0, 3), (0, 0, 4), (0, 0, 5)]).assign(probability=[0.9, 0.9, 0.89, 0.99])
        assert trusted(rows) == (2, 3)

    def test_a_row_for_each_set_and_method_and_one_for_the_truth(self):
        one = flight([(0, 0, -3)] * 4, edges_px=1.5).assign(edges_found=[0.5, 0.7, 0.5, 0.7], surprise=9.0)
        both = pd.concat([one.assign(set="a"), one.assign(set="b", probability=math.nan)])
        truth = pd.DataFrame({"set": ["a", "a", "b"], "photo": "x", "edges_px": 0.7, "edges_found": 0.8})
        report = report_real(both, "data", truth)
        rows = report.text.splitlines()[2:6]
        assert [row.split()[:2] for row in rows] == [["a", "truth"], ["a", "m"], ["b", "truth"], ["b", "m"]]
        for words in ("0/0/100 %", "-3.00 m, -3.00 %", "0.00 m, 0.00 %", "95/0 %", "4 of 4", "1.50 px, 60 %"):
            assert words in rows[1], words
        assert "0.70 px, 80 %" in rows[0]
        assert "-/0 %" in rows[3]
        figures = {f.figure: f.value for f in report.figures}
        assert figures["a, m: common height"] == -3.0
        assert figures["b, truth: roof edges with an image edge"] == 80.0
        assert figures["a, m: wrong answers at probability 0.9"] == 4.0


class Together:
    """Answers a flight with its priors, and notes what it was given."""

    name = "together"
    requires = frozenset()

    def __init__(self):
        self.calls = []

    def localize_flight(self, queries, city_map, streams):
        self.calls.append(queries)
        return FlightEstimate([Estimate(query.prior, 1.0, probability=0.5) for query in queries])


class TestPriors:
    def measured(self, towns, options):
        method, segmenter = Together(), make_segmenter("none")[0]
        sets = []
        for root, city in towns:
            dataset = open_folder(FolderParams(str(root), str(city), name=root.name))
            sets.append(RealSet(dataset, open_scene(city), segmenter))
        return measure_real(sets, {"together": method}, options), method.calls, sets

    def test_a_flight_is_given_whole_with_errors_that_its_photos_share(self, town):
        options = RealOptions(3, is_shared=True, is_published_too=False)
        report, calls, (photos,) = self.measured([town], options)
        assert [len(call) for call in calls] == [3, 3, 3]
        centers = {
            entry.name: photos.dataset.truth[entry.key].center - photos.scene.origin
            for entry in photos.dataset.entries
        }
        off = np.array([[query.prior.center - centers[query.name] for query in call] for call in calls])
        # Each photo by itself errs by 2 m at most, a flight by up to 8 m and 28 m besides.
        assert (np.ptp(off, axis=1) <= 4.0).all()
        assert (np.ptp(off, axis=1) > 0.0).all()
        assert np.ptp(off[:, :, 2].mean(axis=1)) > 4.0
        assert (np.abs(off) <= (10.0, 10.0, 30.0)).all()
        assert report.data["translation_error_m"].tolist() == pytest.approx(
            np.linalg.norm(off, axis=2).ravel().tolist()
        )
        assert "mostly shared" in report.text

    @pytest.mark.parametrize(("off", "ground_m", "held"), [((0, 0, 0), 0.0, 100.0), ((3, 4, 0), 5.0, 0.0)])
    def test_pixels_are_placed_on_the_ground(self, town, off, ground_m, held):
        """Nearly level ground seen from 5 m aside is 5 m aside, and in no ellipse of 1 m."""

        class Near(Together):
            def localize_flight(self, queries, city_map, streams):
                # `tests.town.prior_of` moves by (5, -4, 6) metres and turns by 3 degrees.
                poses = []
                for query in queries:
                    pitch, roll, yaw = query.prior.euler
                    center = query.prior.center - (5, -4, 6) + off
                    poses.append(Pose.from_euler(EulerAngles(pitch, roll, yaw - 3), center))
                covariance = np.diag([0.01, 0.01, 0.01, 1e-6, 1e-6, 1e-6])
                return FlightEstimate([Estimate(pose, 1.0, covariance=covariance) for pose in poses])

        photos = RealSet(
            open_folder(FolderParams(*map(str, town))), open_scene(town[1]), make_segmenter("none")[0]
        )
        report = measure_real([photos], {"near": Near()}, RealOptions(is_published_only=True))
        figures = {f.figure: f.value for f in report.figures}
        assert figures["near: ground points, median"] == pytest.approx(ground_m, abs=0.03)
        assert figures["near: ground points within the said 95 %"] == pytest.approx(held, abs=5.0)
        median, share = (
            figures[f"near: ground points{words}"] for words in (", median", " within the said 95 %")
        )
        assert f"{median:.2f} m, {share:.0f} %" in report.text

    def test_a_narrow_prior_is_shared_no_wider(self):
        shared, own = shared_and_own(UniformPrior(x_m=1.0, y_m=1.0, z_m=0.0, pitch_deg=0.0, roll_deg=0.0))
        assert (shared.horizontal_m, own.horizontal_m, shared.height_m, own.tilt_deg) == (0.5, 0.5, 0.0, 0.0)
        assert shared.yaw_deg + own.yaw_deg == 7.5

    def test_sets_over_maps_of_their_own_and_published_priors_only(self, town, tmp_path):
        other = write_dataset(tmp_path / "other", 4)
        other = other[0].rename(tmp_path / "second"), other[1]
        report, calls, _ = self.measured([town, other], RealOptions(is_published_only=True))
        assert [len(call) for call in calls] == [3, 4]
        assert report.data["set"].tolist() == ["data"] * 3 + ["second"] * 4
        assert set(report.data["prior"]) == {"published"}
        # `tests.town.prior_of` moves by (5, -4, 6) metres.
        figures = {f.figure: f.value for f in report.figures}
        assert figures["second, together: common height"] == pytest.approx(6.0, abs=1e-4)
        assert figures["second, together: common plan"] == pytest.approx(math.hypot(5, 4), abs=1e-4)
        assert figures["second, together: own error, median"] == pytest.approx(0.0, abs=1e-4)


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("real"))


@pytest.mark.slow
def test_methods_start_from_the_same_priors_and_better_ones_end_nearer(town, tmp_path, capsys):
    root, city = town
    asked = ["real", "--query", str(root), "--city", str(city), "--priors", "2", "--pictures", str(tmp_path)]
    assert main([*asked, "--method", "prior_only,lodlocv2", "--json"]) == 0
    lines = capsys.readouterr().out.splitlines()
    figures = {
        f["figure"]: f["value"] for f in map(json.loads, (line for line in lines if line.startswith("{")))
    }
    # Two drawn priors and the published one, for each of three photos.
    assert figures["prior_only: priors"] == 9
    assert figures["prior_only: recall 2m-1deg"] == 0
    assert figures["lodlocv2: priors"] == 9
    assert figures["lodlocv2: median translation"] < figures["prior_only: median translation"] / 2
    assert (tmp_path / "basins.png").read_bytes().startswith(b"\x89PNG")
    assert main([*asked, "--method", "prior_only", "--prior-range", "50"]) == 0
    text = capsys.readouterr().out
    assert "+-50/50/30 m" in text
    assert "published" not in text


def test_what_is_refused(town, tmp_path, capsys):
    root, city = town
    from lodbench.cli import main as lodbench

    for wrong, words in (
        (["--city", str(tmp_path / "none.gml")], "does not exist"),
        (["--city", str(city), "--priors", "0"], "not a number of priors"),
        (["--city", str(city), "--method", "nobody"], "nobody"),
        (["--method", "prior_only"], "needs a city model"),
        (["--city", str(city), "--method-option", "single=region"], "Write --method-option region.KEY=VALUE"),
        (["--city", str(city), "--method-option", "region.no=1"], "no"),
        (["--city", str(city), "--published-priors", "--shared-priors", "yes"], "--published-priors takes"),
    ):
        assert lodbench(["bench", "real", "--query", str(root), *wrong]) == 2
        assert words in capsys.readouterr().err
    assert lodbench(["bench", "real", "--query", str(root.parent), "--method", "prior_only"]) == 2
    assert f"Name one: --query {root}" in capsys.readouterr().err


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """Two places: blocks with a court on grass, and a photo of nothing."""
    root = tmp_path_factory.mktemp("traced")
    for place, boxes in (
        ("town", [(40, 30, 130, 100), (180, 60, 260, 190), (20, 140, 90, 200)]),
        ("field", []),
    ):
        mask = np.zeros((240, 320), np.uint8)
        for left, top, right, bottom in boxes:
            mask[top:bottom, left:right] = 255
        mask[60:80, 60:100] = 0
        noise = np.random.default_rng(1).integers(0, 25, (240, 320, 3), dtype=np.uint8)
        picture = np.where(mask[..., None] > 0, (60, 70, 150), (60, 120, 70)).astype(np.uint8) + noise
        for folder, image in (("photos", picture), ("masks", mask)):
            (root / place / folder).mkdir(parents=True)
            cv2.imwrite(str(root / place / folder / "a.png"), image)
    return root


def test_the_true_pose_shows_the_traced_mask(photos):
    dataset, scene = open_traced_photos(photos, TracedOptions(0.0))
    (entry,) = dataset.entries
    assert (entry.key, scene.num_buildings) == ("town/a.png", 3)
    drawn = CityMap(scene).render(entry.camera, dataset.truth[entry.key])
    traced = read_mask(photos / "town" / "masks" / "a.png") >= 0.5
    # The court is kept; borders of pixels may fall to either side.
    assert (drawn & traced).sum() / (drawn | traced).sum() > 0.99


def test_roofs_go_on_beyond_the_photo(tmp_path):
    """So that a camera too high sees as much of a roof at the photo's edge as of any other."""
    mask = np.zeros((240, 320), np.uint8)
    mask[:, :100] = 255
    for folder in ("photos", "masks"):
        (tmp_path / "town" / folder).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / "town" / folder / "a.png"), mask)
    dataset, scene = open_traced_photos(tmp_path, TracedOptions(0.0))
    (entry,) = dataset.entries
    higher = dataset.truth[entry.key].shifted([0.0, 0.0, 5.0])
    drawn = CityMap(scene).render(entry.camera, higher)
    assert drawn[:, :95].all()
    assert not drawn[:, 105:].any()


def test_a_wrong_map_is_wrong_by_about_what_was_asked(photos):
    dataset, scene = open_traced_photos(photos, TracedOptions(1.0, seed=3))
    other, _ = open_traced_photos(photos, TracedOptions(1.0, seed=3))
    assert other.truth.keys() == dataset.truth.keys()
    (entry,) = dataset.entries
    drawn = CityMap(scene).render(entry.camera, dataset.truth[entry.key])
    traced = read_mask(photos / "town" / "masks" / "a.png") >= 0.5
    assert 0.5 < (drawn & traced).sum() / (drawn | traced).sum() < 0.99


def test_photos_without_buildings_are_no_queries(photos, tmp_path):
    (tmp_path / "field").symlink_to(photos / "field")
    with pytest.raises(DatasetError, match="shows a building"):
        open_traced_photos(tmp_path, TracedOptions())


def test_the_command_finds_poses_from_pixels(photos, capsys):
    assert (
        main(["real", "--photos", str(photos), "--priors", "2", "--method", "prior_only,region", "--json"])
        == 0
    )
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines() if line.startswith("{")]
    figures = {line["figure"]: line["value"] for line in lines}
    assert figures["region: priors"] == 2
    assert figures["region: median translation"] < 0.3 * figures["prior_only: median translation"]


def test_traced_masks_are_perfect_masks(photos, capsys):
    words = ["--priors", "2", "--method", "contour_alignment", "--segmenter", "masks", "--json"]
    assert main(["real", "--photos", str(photos), *words]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines() if line.startswith("{")]
    figures = {line["figure"]: line["value"] for line in lines}
    assert figures["contour_alignment: median translation"] < 2.0
