"""Region-based localisation on pictures of the tests' tiny town: two grounds of noise, no mask anywhere."""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.citymodel.extrude import pitched_blocks
from lodbench.citymodel.read import mesh_model, read_city_model
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Query
from lodbench.errors import ConfigError, QueryFault
from lodbench.estimation.state_vector import views_of
from lodbench.evaluation import pose_error
from lodbench.geometry import EulerAngles, Pose
from lodbench.geometry.pose import vector_from_pose
from lodbench.methods.contour_alignment import ContourAlignment
from lodbench.methods.localize import localize_query
from lodbench.methods.region import Region, RegionParams
from lodbench.methods.region.posteriors import PhotoFit, PosePosterior, grid_starts
from lodbench.methods.region.roofs import RaisedRoofs
from lodbench.methods.registry import make_method
from lodbench.rendering import IouFit
from lodbench.storage import random_stream
from tests.methods.test_region_lines import shaded_photo
from tests.methods.test_region_roofs import mean_errors
from tests.town import CAMERA, prior_of, true_poses

FAST = RegionParams(fine_width=200, starts=4, modes=2)


def streams(seed=0):
    return partial(random_stream, seed, "test", "query")


@pytest.fixture(scope="module")
def photographed(city_map, queries, truths, tmp_path_factory):
    """Returns the queries with a photo and without a mask: buildings are reddish, all else is greenish."""
    folder = tmp_path_factory.mktemp("photos")
    found = []
    for i, (query, truth) in enumerate(zip(queries, truths, strict=True)):
        inside = city_map.render(CAMERA, truth)[..., None]
        colours = np.where(inside, [90.0, 100.0, 140.0], [100.0, 130.0, 100.0])
        noise = random_stream(0, "photo", i).normal(0.0, 20.0, colours.shape)
        path = folder / f"q{i}.png"
        cv2.imwrite(str(path), np.clip(colours + noise, 0, 255).astype(np.uint8))
        found.append(replace(query, building_probability=None, image=path))
    return found


class TestTheMethod:
    def test_it_finds_photos_from_their_pixels(self, city_map, photographed, truths):
        for query, truth in zip(photographed, truths, strict=True):
            before = pose_error(query.prior, truth)
            estimate = Region(FAST).localize(query, city_map, streams())
            after = pose_error(estimate.pose, truth)
            assert after.translation_m < min(1.0, 0.5 * before.translation_m)
            assert after.rotation_deg < 1.0
            assert estimate.covariance is not None
            assert (np.linalg.eigvalsh(estimate.covariance) > 0).all()
            assert estimate.probability is not None
            assert 0.5 < estimate.probability <= 1.0

    def test_threads_and_repetition_change_no_bit(self, scene, city_map, photographed):
        first = Region(FAST).localize(photographed[0], city_map, streams())
        for threads in (1, 3):
            again = Region(FAST).localize(photographed[0], CityMap(scene, threads=threads), streams())
            np.testing.assert_array_equal(again.pose.cam_from_world, first.pose.cam_from_world)
            assert (again.probability, again.hypotheses) == (first.probability, first.hypotheses)

    def test_a_grey_photo_of_another_exposure_will_do(self, city_map, photographed, truths, tmp_path):
        grey = cv2.imread(str(photographed[1].image), cv2.IMREAD_GRAYSCALE)
        grey = np.where(city_map.render(CAMERA, truths[1]), grey // 2 + 60, grey // 2)
        cv2.imwrite(str(tmp_path / "grey.png"), grey.astype(np.uint8))
        query = replace(photographed[1], image=tmp_path / "grey.png")
        estimate = Region(FAST).localize(query, city_map, streams())
        assert pose_error(estimate.pose, truths[1]).translation_m < 2.0

    @pytest.mark.slow
    def test_a_photo_of_noise_is_not_trusted(self, city_map, photographed, tmp_path):
        noise = np.random.default_rng(1).integers(0, 256, (CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
        cv2.imwrite(str(tmp_path / "noise.png"), noise)
        query = replace(photographed[0], image=tmp_path / "noise.png")
        try:
            estimate = Region(FAST).localize(query, city_map, streams())
        except QueryFault:
            return
        assert estimate.probability is not None
        assert estimate.probability < 0.2

    @pytest.mark.slow
    def test_an_answer_that_is_not_to_be_trusted_is_searched_for_again(self, city_map, photographed):
        elsewhere = replace(photographed[0], image=photographed[1].image)
        for query, is_lost in ((photographed[0], False), (elsewhere, True)):
            once, twice = (
                localize_query(Region(replace(FAST, more_starts=more)), query, city_map, streams())
                for more in (1, 5)
            )
            assert (once.probability < 0.5) == is_lost
            assert (twice.hypotheses > 2 * once.hypotheses) == is_lost
            assert twice.probability >= once.probability
            if not is_lost:
                np.testing.assert_array_equal(twice.pose.cam_from_world, once.pose.cam_from_world)

    def test_an_answer_beyond_the_prior_s_range_is_said_to_be(self, city_map, photographed, truths):
        prior = truths[0].center + np.array([0.0, 0.0, 14.0])
        query = replace(photographed[0], prior=replace(truths[0], translation=-truths[0].rotation @ prior))
        for range_m, is_beyond in ((20.0, True), (32.0, False)):
            estimate = Region(replace(FAST, range_z_m=range_m)).localize(query, city_map, streams())
            away = estimate.pose.center[2] - prior[2]
            said = [
                note
                for note in estimate.notes
                if "outside the stated range" in note and f"z {away:+.1f} m" in note
            ]
            assert bool(said) == is_beyond
            # What the map is wrong about is no reason to be beyond: its covariance does not count here.
            assert (abs(away) > 0.5 * range_m + 1.0) == is_beyond

    def test_no_answer_lies_far_below_the_prior_s_range(self, city_map, photographed, truths):
        told = replace(FAST, range_z_m=10.0)
        low = replace(photographed[0], prior=truths[0].shifted([0.0, 0.0, 25.0]))
        estimate = Region(told).localize(low, city_map, streams())
        assert abs(estimate.pose.center[2] - low.prior.center[2]) < 1.4 * 5.0
        assert estimate.probability is not None
        assert estimate.probability < 0.2

    def test_a_prior_told_too_narrow_leads_no_answer_astray(self, city_map, photographed, truths):
        told = replace(FAST, range_x_m=10.0, range_y_m=10.0, beyond_m=5.0)
        for query, truth in zip(photographed[:3], truths[:3], strict=True):
            off = replace(query, prior=truth.shifted([-9.0, 8.0, 2.0]))
            estimate = Region(told).localize(off, city_map, streams())
            assert pose_error(estimate.pose, truth).translation_m < 1.0

    def test_the_grid_reaches_beyond_the_prior_but_not_in_height(self):
        params = RegionParams(range_x_m=20.0, range_y_m=6.0, range_z_m=0.0, range_yaw_deg=0.0, beyond_m=10.0)
        grid = params.grid()
        assert (grid.x.width, grid.y.width, grid.z.width, grid.yaw.width) == (40.0, 12.0, 0.0, 0.0)

    def test_a_grid_around_the_circle_has_no_heading_twice(self):
        axis = RegionParams(range_yaw_deg=360.0).grid().yaw
        offsets = np.sort(axis.offsets() % 360.0)
        gaps = np.diff(offsets, append=offsets[0] + 360.0)
        np.testing.assert_allclose(gaps, 360.0 / axis.count)
        assert gaps[0] <= RegionParams().stride_yaw_deg

    def test_where_the_circle_closes_nothing_is_found_twice(self, city_map, photographed, truths):
        query, truth = photographed[0], truths[0]
        told = replace(FAST, range_yaw_deg=360.0, starts=8, modes=4)
        _, _, yaw = truth.euler
        turned = Pose.from_euler(EulerAngles(*truth.euler[:2], yaw + 179.0), truth.center)
        estimate = Region(told).localize(replace(query, prior=turned), city_map, streams())
        assert pose_error(estimate.pose, truth).translation_m < 1.0
        for other in estimate.alternatives:
            apart = pose_error(other, estimate.pose)
            assert apart.translation_m > 2.0 or apart.rotation_deg > 2.0

    def test_16_bits_are_seen_over_the_range_in_use(self, city_map, photographed, truths, tmp_path):
        grey = cv2.imread(str(photographed[1].image), cv2.IMREAD_GRAYSCALE)
        radiometric = 7200.0 + np.where(city_map.render(CAMERA, truths[1]), grey // 2 + 60, grey // 2)
        cv2.imwrite(str(tmp_path / "thermal.png"), radiometric.astype(np.uint16))
        query = replace(photographed[1], image=tmp_path / "thermal.png")
        estimate = Region(FAST).localize(query, city_map, streams())
        assert pose_error(estimate.pose, truths[1]).translation_m < 2.0

    def test_starts_are_tops_of_different_hills(self, city_map, photographed):
        query, params = photographed[0], RegionParams(starts=8)
        photo = cv2.imread(str(query.image))
        posterior = PosePosterior(query, city_map, PhotoFit(photo, (151, 113), params, True), params)
        starts, best = grid_starts(query, posterior, params)
        fits = posterior.fits(starts)
        assert fits[0] == fits.max() == best
        grid = params.grid()
        steps = [axis.width / (axis.count - 1) for axis in (grid.x, grid.y, grid.z, grid.yaw)]
        for i in range(len(starts)):
            apart = np.abs(starts[:, [0, 1, 2, 5]] - starts[i, [0, 1, 2, 5]]) / steps
            assert (np.delete(apart, i, axis=0).max(axis=1) > 1.5).all()

    def test_the_answer_is_a_mean_unless_told(self, city_map, photographed, truths):
        query, truth = photographed[2], truths[2]
        without_lines = replace(FAST, lines_weight=0.0)
        best, mean = (
            Region(replace(without_lines, place_sigma_m=sigma_m)).localize(query, city_map, streams())
            for sigma_m in (0.0, 0.8)
        )
        apart = pose_error(mean.pose, best.pose)
        assert 0.0 < apart.translation_m < 1.0
        assert pose_error(mean.pose, truth).translation_m < 1.0
        # How sure the answer is comes from what the best pose shows.
        assert mean.probability == best.probability

    def test_a_prior_s_width_sets_the_search(self):
        wide = Region().params_for_prior(UniformPrior(50.0, 40.0, 30.0, 30.0, 2.0, 2.0))
        assert (wide.range_x_m, wide.range_y_m, wide.range_z_m, wide.range_yaw_deg) == (
            100.0,
            80.0,
            60.0,
            60.0,
        )
        assert wide.range_tilt_deg == 4.0
        assert len(wide.grid()) > len(RegionParams().grid())
        assert len(Region().params_for_prior(UniformPrior()).grid()) == len(RegionParams().grid())
        assert Region().params_for_true_tilt().range_tilt_deg == 0.0


class TestWhatIsRefused:
    def test_no_photo(self, city_map, queries):
        with pytest.raises(QueryFault, match="no photo"):
            Region(FAST).localize(replace(queries[0], image=None), city_map, streams())

    def test_a_file_that_is_no_photo(self, city_map, queries, tmp_path):
        (tmp_path / "q.png").write_bytes(b"no picture")
        with pytest.raises(QueryFault, match="decoded"):
            Region(FAST).localize(replace(queries[0], image=tmp_path / "q.png"), city_map, streams())

    def test_no_building_in_reach(self, city_map, photographed):
        far = replace(photographed[0], prior=photographed[0].prior.shifted([5000.0, 0.0, 0.0]))
        with pytest.raises(QueryFault, match="far from the city"):
            Region(FAST).localize(far, city_map, streams())

    @pytest.mark.parametrize(
        "wrong",
        [
            {"coarse_width": 4}, {"fine_width": 9000}, {"range_x_m": -1.0}, {"stride_m": 0.0}, {"starts": 0},
            {"more_starts": 0}, {"population": 7}, {"population": 4}, {"effective_pixels": float("inf")},
            {"edge_weight": -0.1},
        ],
    )  # fmt: skip
    def test_settings_out_of_range(self, wrong):
        (key,) = wrong
        with pytest.raises(ConfigError, match=key):
            make_method("region", **wrong)


@pytest.fixture
def told(scene):
    """The town, of whose buildings every other one is told to have a pitched roof."""
    return replace(scene, pitched=np.arange(scene.num_buildings) % 2 == 0)


def modes_found(scene):
    return np.maximum.reduceat(scene.vertices[:, 2], scene.vertex_starts[:-1])


def test_they_are_drawn_lower_and_the_others_as_they_are(scene, city_map, told):
    for step in (0, 2):
        plain = RaisedRoofs(city_map, scene, 0.8).at(step).scene
        lowered = RaisedRoofs(city_map, told, 0.8).at(step).scene
        np.testing.assert_allclose(modes_found(plain) - modes_found(lowered), 0.8 * told.pitched, atol=1e-4)
        floors = [np.minimum.reduceat(s.vertices[:, 2], s.vertex_starts[:-1]) for s in (plain, lowered)]
        np.testing.assert_array_equal(*floors)


def test_roofs_by_themselves_are_counted_from_there(city_map, told):
    own_m = np.linspace(-0.5, 0.5, told.num_buildings)
    roofs = RaisedRoofs(city_map, told, 0.8)
    moved = modes_found(roofs.with_offsets(own_m, 0.0, 0.0).at(0).scene) - modes_found(roofs.at(0).scene)
    np.testing.assert_allclose(moved, own_m, atol=1e-4)


def test_what_is_drawn_with_its_roof_is_no_block(shared_data):
    model = read_city_model(shared_data / "city/germany_lod2/LoD2_32_280_5657_1_NW.gml")
    blocks = mesh_model(model, "1", roof_height="median").scene
    assert int(pitched_blocks(blocks).sum()) == int(blocks.pitched.sum()) == 48
    assert not pitched_blocks(mesh_model(model, "2").scene).any()


def test_floors_may_follow_the_ground(shared_data):
    model = read_city_model(shared_data / "city/germany_lod2/LoD2_32_280_5657_1_NW.gml")
    blocks = mesh_model(model, "1", roof_height="median").scene
    vertices = blocks.vertices.copy()
    owner = np.repeat(np.arange(blocks.num_buildings), np.diff(blocks.vertex_starts))
    floors = np.minimum.reduceat(vertices[:, 2], blocks.vertex_starts[:-1])
    is_floor = vertices[:, 2] < floors[owner] + 0.1
    vertices[is_floor, 2] += 0.1 * (vertices[is_floor, 0] - vertices[:, 0].mean()) % 1.0
    assert int(pitched_blocks(replace(blocks, vertices=vertices)).sum()) == 48


def test_where_nothing_is_told_no_block_is_pitched(scene):
    assert not pitched_blocks(scene).any()


@pytest.mark.slow
def test_told_roofs_bring_the_answer_nearer(told, tmp_path):
    """Photos of a town whose every other roof is two metres lower than in the map, which tells which."""
    city_map = CityMap(told, threads=1)
    town = RaisedRoofs(city_map, told, 2.0).at(0)
    each = [replace(FAST, pitched_lower_m=lower_m) for lower_m in (0.0, 2.0)]
    untold, by_what_is_told = mean_errors(city_map, town, each, tmp_path, seeds=(0, 1))
    assert by_what_is_told < 0.9 * untold


def test_the_parameter_is_a_length():
    with pytest.raises(ConfigError, match="pitched_lower_m"):
        RegionParams(pitched_lower_m=-0.1)


# Few pixels do not tell a longer lens from a lower flight.
WIDE = CAMERA.scaled(960, 720)


def lengthened(camera, percent):
    return replace(camera, fx=camera.fx * (1 + 0.01 * percent), fy=camera.fy * (1 + 0.01 * percent))


@pytest.mark.parametrize("percent", [-4.0, 0.0, 2.5])
def test_another_lens_is_drawn_by_the_told_one(city_map, truths, percent):
    for truth in truths:
        vector = np.append(vector_from_pose(truth), percent)[None]
        of_longer = IouFit(city_map.render(lengthened(CAMERA, percent), truth))
        np.testing.assert_allclose(city_map.fit(CAMERA, *views_of(vector), of_longer), 1.0, atol=2e-3)


def test_a_pose_is_a_camera_with_the_lens_as_told(city_map, queries, truths, shaded_photos):
    params = RegionParams()
    posterior = PosePosterior(
        queries[0], city_map, PhotoFit(shaded_photos[0], (200, 150), params, False), params
    )
    poses = vector_from_pose(truths[0]) + random_stream(0, "poses").normal(0.0, 0.5, (5, 6))
    cameras = np.column_stack([poses, np.zeros(5)])
    np.testing.assert_array_equal(posterior.fits(poses), posterior.fits(cameras))
    assert (posterior.fits(np.column_stack([poses, np.full(5, 3.0)])) != posterior.fits(poses)).all()


@pytest.fixture(scope="module")
def shaded_photos(city_map, truths):
    return [shaded_photo(city_map, truth, number) for number, truth in enumerate(truths)]


def errors_of(city_map, folder, percent, params):
    """Returns the errors in place, metres, of photos whose lens is longer than told, and all notes."""
    errors, notes = [], []
    for number, truth in enumerate(true_poses(3).values()):
        path, lens = folder / f"{number}.png", lengthened(WIDE, percent)
        cv2.imwrite(str(path), shaded_photo(city_map, truth, number, lens))
        query = Query(path.name, "all", WIDE, prior_of(truth), None, path)
        estimate = Region(params).localize(query, city_map, partial(random_stream, 0, "test"))
        errors.append(pose_error(estimate.pose, truth).translation_m)
        notes.extend(estimate.notes)
    return np.array(errors), notes


@pytest.mark.slow
def test_a_longer_lens_is_found_and_told(city_map, tmp_path):
    """4 % are five metres of height, which whoever believes what is told makes up for."""
    believing, _ = errors_of(city_map, tmp_path, 4.0, replace(FAST, lens_doubt_percent=0.0))
    doubting, notes = errors_of(
        city_map, tmp_path, 4.0, replace(FAST, lens_doubt_percent=4.0, doubt_nats=1.0)
    )
    assert np.median(believing) > 3.0
    assert np.median(doubting) < 0.7 * np.median(believing)
    assert any("focal length" in note and "longer" in note for note in notes)


@pytest.mark.parametrize("method", [Region(FAST), ContourAlignment()], ids=["pixels", "mask"])
def test_a_focal_length_known_badly_leaves_the_height_open(
    city_map, queries, shaded_photos, tmp_path, method
):
    path = tmp_path / "photo.png"
    cv2.imwrite(str(path), shaded_photos[0])
    known = replace(queries[0], image=path)
    sigmas, probabilities = [], []
    for percent in (None, 0.1, 3.0):
        query = replace(known, lens_percent=percent)
        estimate = method.localize(query, city_map, partial(random_stream, 0, "test"))
        sigmas.append(np.sqrt(np.diagonal(estimate.covariance)))
        probabilities.append(estimate.probability)
    np.testing.assert_array_equal(sigmas[0], sigmas[1])
    assert sigmas[2][2] > 1.5 * sigmas[0][2]
    assert probabilities[2] < probabilities[0] == probabilities[1]


@pytest.mark.slow
def test_a_lens_as_told_is_left_alone(city_map, tmp_path):
    errors, notes = errors_of(city_map, tmp_path, 0.0, FAST)
    assert not any("focal length" in note for note in notes)
    assert np.median(errors) < 1.0
