"""Places of pixels: known ones, Jacobians by differences, ellipses by drawing errors, a laser's range."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lodbench
from lodbench.citymap.places import (
    LaserResidual,
    LocatedPixel,
    Uncertainty,
    at_centre,
    ground_errors,
    laser_residual,
    places_of,
)
from lodbench.citymodel import open_scene
from lodbench.citymodel.scene import Scene, build_scene
from lodbench.datasets.pose_text import read_cameras, read_poses
from lodbench.errors import LodbenchError
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.photos.xmp import LaserRange
from lodbench.rendering.surfaces import Ground, Surfaces
from tests.town import box_obj

CAMERA = Camera(1000, 800, 900.0, 890.0, 505.0, 396.0)
LENS = replace(CAMERA, distortion=(-0.15, 0.04, 0.001, -0.002))
# West, south, east, north, base, top: all stand on one level.
BOXES = [
    (-60, -50, -25, -20, 2, 18),
    (-5, -3, 22, 30, 2, 40),
    (40, 20, 58, 64, 2, 15),
    (-55, 5, -30, 50, 2, 25),
]
VIEW = EulerAngles(32.0, 2.0, 25.0), (25.0, -60.0, 130.0)
# What six numbers of a pose may be off by together: high and tilted up, or low and tilted down.
_MIX = np.array(
    [
        [1.2, 0, 0, 0, 0, 0],
        [0, 1.5, 0, 0, 0, 0],
        [0.3, -0.5, 1.0, 0, 0, 0],
        [0.2, 0.55, -0.1, 0.05, 0, 0],
        [-0.5, 0.1, 0, 0, 0.06, 0],
        [0.1, 0.2, 0, 0, 0, 0.1],
    ]
)
COVARIANCE = _MIX @ _MIX.T


@pytest.fixture(scope="module")
def town(tmp_path_factory) -> Scene:
    path = tmp_path_factory.mktemp("town") / "city.obj"
    path.write_text(box_obj(BOXES))
    return open_scene(path)


@pytest.fixture(scope="module")
def surfaces(town) -> Surfaces:
    return Surfaces(town, 0.4, 0.3)


def pose_of(numbers) -> Pose:
    return Pose.from_euler(EulerAngles(*map(float, numbers[3:])), numbers[:3])


NUMBERS = np.array([*VIEW[1], *VIEW[0]])
PIXELS = np.random.default_rng(2).uniform([0, 0], [1000, 800], (60, 2))


def moved_camera(camera: Camera, focal: float, cx: float, cy: float, k1: float) -> Camera:
    numbers = {"fx": camera.fx * (1 + focal), "fy": camera.fy * (1 + focal), "cx": camera.cx + cx}
    lens = camera.distortion and (camera.distortion[0] + k1, *camera.distortion[1:])
    return replace(camera, **numbers, cy=camera.cy + cy, distortion=lens)


def residual(surfaces, pose, range_m) -> LaserResidual | None:
    return laser_residual(at_centre(surfaces, CAMERA, pose), pose, LaserRange(range_m))


def located(surfaces, camera, pose, pixels, known=None, laser=None) -> list[LocatedPixel | None]:
    return places_of(surfaces, camera, pose, np.array(pixels), known or Uncertainty(None), laser)


def test_known_places_from_straight_above(town):
    down = Pose.from_euler(EulerAngles(0, 0, 0), (0.0, 0.0, 130.0))
    roof = lodbench.locate(town, CAMERA, down, (505.0 + 90.0, 396.0 - 89.0))
    np.testing.assert_allclose(roof.place, [9.0, 9.0, 40.0], atol=1e-5)
    assert (roof.surface, roof.shows) == ("roof", f"roof of {roof.building}")
    assert (roof.covariance, roof.ellipse) == (None, None)
    ground = lodbench.locate(town, CAMERA, down, (505.0 - 90.0, 396.0))
    np.testing.assert_allclose(ground.place, [-12.8, 0.0, 2.0], atol=1e-5)
    assert (ground.surface, ground.building, ground.shows) == ("ground", None, "ground")


def test_a_wall_is_met_and_coordinates_are_the_city_s(town):
    moved = replace(town, origin=np.array([280000.0, 5650000.0, 50.0]))
    level = Pose.from_euler(EulerAngles(90, 0, 0), np.array([10.0, -100.0, 20.0]) + moved.origin)
    found = lodbench.locate(moved, CAMERA, level, (505.0, 396.0))
    np.testing.assert_allclose(found.place - moved.origin, [10.0, -3.0, 20.0], atol=1e-5)
    assert found.surface == "wall"


def test_the_ellipse_is_that_of_a_level_view(town):
    # 90 m above the roof, half a metre in x alone: no compensation, and one pixel is 0.1 m.
    down = Pose.from_euler(EulerAngles(0, 0, 0), (9.0, 9.0, 130.0))
    spread = np.diag([0.25, 0.04, 0, 0, 0, 0])
    found = lodbench.locate(town, CAMERA, down, (505.0, 396.0), spread, pixel_sigma_px=0, map_sigma_m=0.3)
    np.testing.assert_allclose(found.covariance, np.diag([0.25, 0.04, 0.09]), atol=1e-9)
    assert found.ellipse == pytest.approx((2.4477 * 0.5, 2.4477 * 0.2, 90.0), abs=1e-3)
    pixel = lodbench.locate(town, CAMERA, down, (505.0, 396.0), 0 * spread, map_sigma_m=0).covariance
    np.testing.assert_allclose(np.sqrt(np.diag(pixel)), [90 / 900, 90 / 890, 0], atol=1e-9)


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
def test_jacobians_are_differences(surfaces, camera):
    names = ("focal", "cx", "cy", "k1")
    steps = np.array([1e-4] * 6 + [1e-6, 1e-3, 1e-3, 1e-6])
    usable = 9 if camera is CAMERA else 10  # a pinhole has no k1 to move
    for column in range(usable):
        spread = np.zeros((10, 10))
        spread[column, column] = 1.0
        found = located(surfaces, camera, pose_of(NUMBERS), PIXELS[::2], Uncertainty(spread, names, 0.0))
        still = located(surfaces, camera, pose_of(NUMBERS), PIXELS[::2], Uncertainty(0 * spread, names, 0.0))
        ends = []
        for sign in (1, -1):
            step = np.zeros(10)
            step[column] = sign * steps[column]
            cam = moved_camera(camera, *step[6:])
            ends.append(located(surfaces, cam, pose_of(NUMBERS + step[:6]), PIXELS[::2]))
        kinds = set()
        for one, base, ahead, behind in zip(found, still, *ends, strict=True):
            if one is None or ahead is None or behind is None or one.shows != ahead.shows:
                continue
            slope = (ahead.place - behind.place) / (2 * steps[column])
            scale = max(1.0, float(slope @ slope))
            np.testing.assert_allclose(
                (one.covariance - base.covariance) / scale, np.outer(slope, slope) / scale, atol=2e-3
            )
            kinds.add(one.surface)
        assert kinds == {"roof", "wall", "ground"}


def test_ellipses_hold_95_percent_of_drawn_errors(town, surfaces):
    """Errors of pose, pixel and map are drawn; what the estimate says is compared with the true places."""
    generator, known = np.random.default_rng(11), Uncertainty(COVARIANCE)
    every = located(surfaces, CAMERA, pose_of(NUMBERS), PIXELS, known)
    clear = [(pixel, one) for pixel, one in zip(PIXELS, every, strict=True) if one and not one.beside]
    chosen = [each for kind in ("roof", "ground") for each in clear if each[1].surface == kind]
    chosen = [*chosen[:3], *chosen[-3:]]
    assert [one.surface for _, one in chosen] == ["roof"] * 3 + ["ground"] * 3
    pixels, inside = np.array([pixel for pixel, _ in chosen]), []
    for _ in range(90):
        error = generator.multivariate_normal(np.zeros(6), COVARIANCE)
        lift = np.float32(generator.normal(0, 0.3)) * np.float32([0, 0, 1])
        drawn = Surfaces(replace(town, vertices=town.vertices + lift), 0.3, 0.3)
        clicked = pixels + generator.normal(size=pixels.shape)
        for found, (_, true) in zip(
            located(drawn, CAMERA, pose_of(NUMBERS + error), clicked, known), chosen, strict=True
        ):
            off = (found.place - true.place)[:2]
            inside.append(off @ np.linalg.solve(found.covariance[:2, :2], off) <= 5.991)
    # Pixels of one draw err together.
    assert np.mean(inside) == pytest.approx(0.95, abs=0.04)


def test_errors_of_a_pose_compensate_one_another(surfaces):
    # A metre to the east and a roll that turns the view back by as much, 90 m above the roof.
    numbers, together = np.array([9.0, 9, 130, 0, 0, 0]), np.array([1.0, 0, 0, 0, np.degrees(1 / 90), 0])
    pixel, pose = [[505.0, 396.0]], pose_of(numbers)
    moved = located(surfaces, CAMERA, pose_of(numbers + together), pixel)[0].place
    assert np.linalg.norm(moved - [9, 9, 40]) < 0.02
    spread = np.outer(together, together)
    full, alone = (
        located(surfaces, CAMERA, pose, pixel, Uncertainty(matrix, pixel_sigma_px=0))[0].ellipse.major_m
        for matrix in (spread, np.diag(np.diag(spread)))
    )
    assert full < 1e-6
    assert alone == pytest.approx(2.4477 * np.sqrt(2), abs=1e-3)


def test_what_else_a_pixel_near_an_edge_may_show(town, surfaces):
    down = Pose.from_euler(EulerAngles(0, 0, 0), (21.7, 9.0, 130.0))
    near, far = located(
        surfaces, CAMERA, down, [[505.0, 396.0], [405.0, 396.0]], Uncertainty(0.09 * np.eye(6))
    )
    assert near.shows.startswith("roof of")
    assert "ground" in near.beside
    assert far.beside == ()


class TestLaser:
    """A range at the photo's centre, 500 400."""

    def test_the_residual_is_a_difference_of_ranges(self, surfaces):
        pose = pose_of(NUMBERS)
        place = located(surfaces, CAMERA, pose, [[500.0, 400.0]])[0].place
        truth = float(np.linalg.norm(place - pose.center))
        found = residual(surfaces, pose, truth - 0.7)
        assert found.residual_m == pytest.approx(0.7)
        for k in range(6):
            step = 1e-4 * np.eye(6)[k]
            one, other = (residual(surfaces, pose_of(NUMBERS + s), 100.0) for s in (step, -step))
            slope = (one.residual_m - other.residual_m) / 2e-4
            assert found.jacobian[k] == pytest.approx(slope, abs=1e-5)
        up = Pose.from_euler(EulerAngles(150, 0, 0), (0.0, 0.0, 100.0))
        assert residual(surfaces, up, 100.0) is None

    def test_it_is_weighed_in_as_least_squares_would(self, town):
        # Straight above a roof: of height of camera and roof the range knows the difference alone.
        middle = replace(CAMERA, cx=500.0, cy=400.0)
        down = Pose.from_euler(EulerAngles(0, 0, 0), (9.0, 9.0, 130.0))
        surfaces, laser = Surfaces(town, 0.6), LaserRange(89.0)
        spread = np.diag([0.1, 0.1, 1.0, 0, 0, 0])
        known = Uncertainty(spread, pixel_sigma_px=0)
        at_centre, elsewhere = located(surfaces, middle, down, [[500, 400], [250, 400]], known, laser)
        # Unknowns: camera's and roof's height; measured: both, and their difference, 1 m less than expected.
        design = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, -1.0]])
        weights = np.diag([1.0, 0.6**-2, laser.sigma_m**-2])
        inverse = np.linalg.inv(design.T @ weights @ design)
        expected = inverse @ design.T @ weights @ np.array([0.0, 0.0, -1.0])
        assert at_centre.place[2] - 40.0 == pytest.approx(expected[1])
        assert at_centre.covariance[2, 2] == pytest.approx(inverse[1, 1])
        assert at_centre.notes == ()
        # What is not on that roof is left as it was.
        assert elsewhere.surface == "ground"
        plain = located(surfaces, middle, down, [[250, 400]], known)[0]
        np.testing.assert_array_equal(elsewhere.place, plain.place)

    def test_a_contradiction_is_said_and_not_used(self, surfaces):
        pose = pose_of(NUMBERS)
        plain, measured = (
            located(surfaces, CAMERA, pose, [[500, 400]], Uncertainty(COVARIANCE), laser)[0]
            for laser in (None, LaserRange(60.0))
        )
        np.testing.assert_array_equal(measured.place, plain.place)
        assert "60.0 m" in measured.notes[0]
        assert "not used" in measured.notes[0]


class TestGround:
    """Planes through the bases of buildings."""

    def test_a_slope_is_followed_and_a_cellar_is_not(self):
        generator = np.random.default_rng(3)
        places = generator.uniform(-150, 150, (80, 2))
        bases = np.column_stack([places, 100 + 0.03 * places[:, 0] - 0.02 * places[:, 1]])
        bases[::9, 2] -= 4.0
        ground = Ground(bases)
        at = generator.uniform(-100, 100, (40, 2))
        planes = ground.at(at)
        off = planes.height_m - (100 + 0.03 * at[:, 0] - 0.02 * at[:, 1])
        assert np.median(np.abs(off)) < 0.15
        assert (np.abs(off) < 2 * planes.sigma_m).mean() > 0.9
        camera = np.array([0.0, 0.0, 220.0])
        rays = np.column_stack([generator.uniform(-0.5, 0.5, (30, 2)), -np.ones(30)])
        met = camera + ground.distances(camera, rays)[:, None] * rays
        np.testing.assert_allclose(met[:, 2], ground.at(met[:, :2]).height_m, atol=0.01)

    def test_farther_from_buildings_it_is_less_certain_and_far_away_unknown(self):
        ground = Ground(np.array([[0, 0, 5.0], [30, 0, 5.0], [0, 40, 5.0]]))
        near, middle, far = ground.at(np.array([[10.0, 10], [400.0, 0], [9000.0, 0]])).sigma_m
        assert near < 0.5 < middle < far
        assert np.isnan(ground.at(np.array([[9000.0, 0]])).height_m).all()
        assert ground.distances(
            np.array([0, 0, 100.0]), np.array([[1.0, 0, 0.1], [1.0, 0, -0.005]])
        ).tolist() == [np.inf, np.inf]

    def test_a_wall_s_part_below_it_is_not_met(self):
        box = np.array([[x, y, z] for z in (-20.0, 10.0) for x, y in ((0, 0), (10, 0), (10, 10), (0, 10))])
        sides = [(k, (k + 1) % 4, 4 + (k + 1) % 4, 4 + k) for k in range(4)]
        corners = np.array([t for a, b, c, d in sides for t in ((a, b, c), (a, c, d))])
        others = [box + np.array([east, 60, 20]) for east in (-40.0, 0.0, 40.0, -20.0, 20.0)]
        points = np.concatenate([box, *others])
        triangles = np.concatenate([corners + 8 * k for k in range(6)])
        owner = np.repeat(np.arange(6, dtype=np.int32), 8)
        surfaces = Surfaces(build_scene(points, triangles, owner, tuple("abcdef")), ground_sigma_m=0.2)
        hits = surfaces.hit(np.array([5.0, -50.0, 50.0]), np.array([[0.0, 50.0, -60.0], [0.0, 50.0, -45.0]]))
        assert hits.kind == ("ground", "wall")
        assert hits.building.tolist() == [-1, 0]


@pytest.mark.parametrize(
    ("pixel", "more", "said"),
    [
        ((1200.0, 20.0), {}, "outside the photo of 1000 x 800"),
        ((500.0, 400.0), {"covariance": np.eye(5)}, r"shape \(5, 5\), not \(6, 6\)"),
        ((500.0, 400.0), {"covariance": np.eye(6), "parameters": ("focal",)}, r"not \(7, 7\)"),
        ((500.0, 400.0), {"covariance": -np.eye(6)}, "negative eigenvalue"),
        ((500.0, 400.0), {"covariance": np.full((6, 6), np.nan)}, "not finite"),
        ((500.0, 400.0), {"covariance": np.eye(7), "parameters": ("fov",)}, "fov is not known"),
        ((500.0, 400.0), {"pixel_sigma_px": -1.0}, "no length"),
    ],
)
def test_what_cannot_be_located_is_told(town, pixel, more, said):
    with pytest.raises(LodbenchError, match=said):
        lodbench.locate(town, CAMERA, pose_of(NUMBERS), pixel, **more)


def test_the_sky_is_told(town):
    level = Pose.from_euler(EulerAngles(90, 0, 180), (0.0, -100.0, 60.0))
    with pytest.raises(LodbenchError, match="neither a building nor the ground: sky"):
        lodbench.locate(town, CAMERA, level, (500.0, 10.0))
    with pytest.raises(LodbenchError, match="is not a scene"):
        lodbench.locate("city.obj", CAMERA, level, (500.0, 10.0))


class TestGroundErrors:
    """Places by an estimate against those by the truth."""

    def test_the_truth_has_none(self, surfaces):
        pose = pose_of(NUMBERS)
        found = ground_errors(CAMERA, pose, COVARIANCE, pose, surfaces, PIXELS)
        known = np.isfinite(found.distance_m)
        assert known.sum() > 50
        assert found.distance_m[known].max() < 1e-6
        assert found.is_within[known].all()
        assert [kind == "" for kind in found.surface] == (~known).tolist()

    def test_another_surface_is_outside_and_another_camera_counts(self, surfaces):
        down = Pose.from_euler(EulerAngles(0, 0, 0), (21.7, 9.0, 130.0))
        args = CAMERA, down.shifted([1.0, 0, 0]), np.eye(6) * 0.3, down, surfaces, np.array([[505.0, 396.0]])
        found = ground_errors(*args)
        assert found.surface == ("ground",)
        assert found.distance_m[0] > 30
        assert not found.is_within[0]
        longer = replace(CAMERA, fx=950.0)
        args = CAMERA, down, np.eye(6) * 1e-6, down, surfaces, np.array([[405.0, 396.0]])
        assert ground_errors(*args).distance_m[0] < 1e-6
        assert ground_errors(*args, true_camera=longer).distance_m[0] == pytest.approx(
            90 * (100 / 900 - 100 / 950), rel=1e-6
        )

    def test_on_real_photos_points_are_known_better_than_the_camera(self, shared_data: Path):
        """Poses are drawn about the reference ones with the covariance of some matched points of the map."""
        flight = shared_data / "real_flights" / "ochota"
        if not flight.is_dir():
            pytest.skip(f"{flight} is not there")
        scene = open_scene(flight / "city.obj")
        surfaces, generator = Surfaces(scene), np.random.default_rng(0)
        cameras = read_cameras(flight / "intrinsic.txt")
        away, off, inside = [], [], []
        for name, pose in read_poses(flight / "GT_pose.txt").items():
            camera, truth = cameras[name], pose.shifted(-scene.origin)
            numbers = np.array([*truth.center, *truth.euler])
            pixels = generator.uniform(0, [camera.width, camera.height], (25, 2))
            hits = surfaces.hit(
                truth.center,
                np.column_stack([(pixels - [camera.cx, camera.cy]) / camera.fx, np.ones(25)])
                @ truth.rotation,
            )
            points = hits.places[np.isfinite(hits.places[:, 0])]

            def image(values, points=points, camera=camera):
                at = pose_of(values)
                return camera.project(points @ at.rotation.T + at.translation).ravel()

            steps = 1e-3 * np.eye(6)
            slopes = [(image(numbers + step) - image(numbers - step)) / 2e-3 for step in steps]
            design = np.array(slopes).T
            covariance = np.linalg.inv(design.T @ design / 25.0)
            for _ in range(4):
                error = generator.multivariate_normal(np.zeros(6), covariance)
                found = ground_errors(camera, pose_of(numbers + error), covariance, truth, surfaces, pixels)
                known = np.isfinite(found.distance_m)
                away.append(np.linalg.norm(error[:3]))
                off += found.distance_m[known].tolist()
                inside += found.is_within[known].tolist()
        assert len(inside) > 1000
        assert np.median(off) < 0.5 * np.median(away)
        # Pixels at edges jump from roof to ground.
        assert np.mean(inside) == pytest.approx(0.94, abs=0.04)
