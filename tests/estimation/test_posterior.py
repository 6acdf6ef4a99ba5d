"""The posterior mean against integrals, and how far errors of a map lead answers astray."""

import numpy as np
import pytest
import scipy.optimize

from lodbench.estimation import posterior as map_errors
from lodbench.estimation.outline_alignment import OutlinePoints
from lodbench.estimation.posterior import _root, covariance_under_map_errors, posterior_mean

X = np.linspace(-8.0, 8.0, 4001)
MODE, COVARIANCE = np.full(6, 0.3), np.diag([4.0, 1.0, 2.0, 0.5, 0.5, 1.0])


def no_prior(poses):
    return np.zeros(len(poses))


class Independent:
    """A density of which each number is independent of the others."""

    def __init__(self, log_density):
        self.log_density = log_density

    def mean(self, vector=MODE, covariance=COVARIANCE):
        """Returns what is found."""
        return posterior_mean(
            lambda poses, temper: temper * self.log_density(poses).sum(axis=1),
            no_prior,
            vector,
            covariance,
            0.0,
        )

    def means(self):
        """Returns the (6,) means by integrating each axis by itself."""
        logs = self.log_density(np.repeat(X[:, None], 6, axis=1))
        weights = np.exp(logs - logs.max(axis=0))
        return (weights * X[:, None]).sum(axis=0) / weights.sum(axis=0)


def gaussian(vectors):
    return -0.5 * (vectors - np.array([1.0, -0.5, 0.0, 0.6, 0.3, 0.0])) ** 2 / np.diagonal(COVARIANCE)


def bumpy(vectors):
    """A wide hill whose top is a bump far down its side."""
    return -0.5 * vectors**2 + 1.5 * np.exp(-0.5 * ((vectors - 1.2) / 0.1) ** 2)


def one_sided(vectors):
    """Steep below its top at 0, gentle above."""
    return np.where(vectors < 0.0, -2.0 * vectors**2, -0.3 * vectors**2)


@pytest.mark.parametrize("density", [gaussian, bumpy, one_sided])
def test_it_is_the_integral_s(density):
    independent = Independent(density)
    found = independent.mean()
    spread = np.sqrt(np.diagonal(COVARIANCE))
    assert (np.abs(found - independent.means()) < 0.2 * spread).all()


def test_the_mean_of_a_bumpy_hill_is_not_its_top():
    found = Independent(bumpy).mean(np.full(6, 1.2))
    # Six numbers by a thousand draws: how far they are off together.
    assert np.sqrt(np.mean((found - Independent(bumpy).means()) ** 2)) < 0.3
    assert (found < 0.6).all()


def test_a_direction_that_is_held_stays():
    held = np.diag([4.0, 1.0, 2.0, 1e-12, 1e-12, 1.0])
    found = Independent(gaussian).mean(covariance=held)
    np.testing.assert_allclose(found[3:5], MODE[3:5], atol=1e-5)


def test_a_constant_of_the_exponent_does_not_count():
    def with_level(poses, temper):
        return temper * bumpy(poses).sum(axis=1) + 50.0 * temper**2

    # Tempered, so that rounds are drawn at different exponents.
    found = posterior_mean(with_level, no_prior, MODE, COVARIANCE, 2.8)
    without = posterior_mean(
        lambda poses, temper: temper * bumpy(poses).sum(axis=1), no_prior, MODE, COVARIANCE, 2.8
    )
    np.testing.assert_allclose(found, without, atol=1e-9)


def test_signs_and_order_of_axes_do_not_matter(monkeypatch):
    once, solve = Independent(bumpy).mean(), np.linalg.eigh

    def otherwise(matrix):
        squares, axes = solve(matrix)
        return squares[::-1], axes[:, ::-1] * np.array([1, -1, 1, -1, -1, 1])

    monkeypatch.setattr(np.linalg, "eigh", otherwise)
    np.testing.assert_allclose(Independent(bumpy).mean(), once, atol=1e-9)


def test_it_draws_the_same_every_time():
    first, second = (Independent(bumpy).mean() for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize(("least_m", "expected_m"), [(0.1, 0.3), (0.3, 0.3), (0.8, 0.8)])
def test_a_sharp_likelihood_is_tempered_until_the_position_is_wide_enough(least_m, expected_m):
    """Of a sharp Gaussian likelihood and a wide prior around another place: their weighted mean."""
    seen, before, prior_m = np.array([0.3, 0.0, 0.0]), np.array([2.0, 0.0, 0.0]), 2.0
    sharp_m = 0.3 / np.sqrt(3.0)

    def log_likelihood(poses, temper):
        return -0.5 * temper * ((poses - seen) ** 2).sum(axis=1) / sharp_m**2

    def log_prior(poses):
        return -0.5 * ((poses - before) ** 2).sum(axis=1) / prior_m**2

    found = posterior_mean(log_likelihood, log_prior, seen, np.eye(3), least_m)
    each_m = expected_m / np.sqrt(3.0)
    temper = (each_m**-2 - prior_m**-2) / sharp_m**-2
    expected = seen + (before - seen) * (prior_m**-2 / (temper / sharp_m**2 + prior_m**-2))
    np.testing.assert_allclose(found, expected, atol=0.03)


@pytest.mark.parametrize("seed", range(30))
def test_a_root_is_where_scipy_has_it_to_the_bit(seed):
    zero, bend, wave = np.random.default_rng(seed).uniform((-2.9, 0.2, 0.0), (-0.1, 5.0, 0.4))

    def value(place):
        away = zero - place
        return float(np.expm1(bend * away) / bend + wave * np.sin(3.0 * away))

    assert _root(value, -3.0, 0.0, 0.01) == scipy.optimize.brentq(value, -3.0, 0.0, xtol=0.01)


HEIGHT_M, FOCAL_PX = 150.0, 500.0
# The prior leaves the place open and holds the tilt.
PRIOR = np.diag(np.array([30.0, 30.0, 30.0, 0.6, 0.6, 5.0]) ** -2.0)
DEG = np.pi / 180.0


def outline_of(num_buildings, spread_m=50.0, points_each=40):
    """Returns outlines of square roofs of several heights on a lattice, seen from straight above."""
    side = int(np.ceil(np.sqrt(num_buildings)))
    pixels, normals, moves, buildings = [], [], [], []
    for k in range(num_buildings):
        middle = (np.array(divmod(k, side)) - (side - 1) / 2) / side * spread_m
        depth = HEIGHT_M - 5.0 - 4.0 * (k % 4)
        scale = FOCAL_PX / depth
        turn = np.linspace(0.0, 2.0 * np.pi, points_each, endpoint=False) + 0.01
        for out in np.column_stack([np.cos(turn), np.sin(turn)]):
            x, y = middle + 6.0 * out / np.abs(out).max()
            u, v = x * scale, y * scale
            tilts = DEG * np.array([[u * v, FOCAL_PX**2 + v * v], [FOCAL_PX**2 + u * u, u * v]]) / FOCAL_PX
            shift = [[-scale, 0.0], [0.0, -scale], [-u / depth, -v / depth]]
            roof = [[u / depth, v / depth], [0.0, 0.0]]
            moves.append([*shift, *tilts, DEG * np.array([-v, u]), [0.01 * u, 0.01 * v], *roof])
            pixels.append([u, v])
            normals.append(np.eye(2)[np.abs(out).argmax()] * np.sign(out[np.abs(out).argmax()]))
            buildings.append(k)
    count = len(pixels)
    return OutlinePoints(
        np.array(pixels),
        np.array(normals),
        np.full(count, 4.0),
        np.array(moves),
        np.array(buildings),
        np.zeros((count, 2)),
    )


def slopes_of(points):
    return points.slopes()


def information_of(points, worth):
    pose = slopes_of(points)[:, :6]
    return worth * (pose * points.lengths[:, None]).T @ pose


def sigmas(points, worth=1.0, prior=PRIOR, lens_percent=0.2):
    covariance = covariance_under_map_errors(information_of(points, worth), prior, points, lens_percent)
    np.testing.assert_allclose(covariance, covariance.T)
    assert (np.linalg.eigvalsh(covariance) > 0).all()
    return np.sqrt(np.diagonal(covariance))


def test_it_is_how_answers_scatter_over_maps_that_are_wrong(monkeypatch):
    """Monte Carlo: buildings stand elsewhere, roofs are higher, lenses longer; least squares answers."""
    points, worth = outline_of(9), 2.0
    for name in ("_TOGETHER_PX", "_OWN_PX", "_PART_M", "_BASE_M"):
        monkeypatch.setattr(map_errors, name, 1e-6)
    slopes, generator = slopes_of(points), np.random.default_rng(3)
    pulls = worth * slopes[:, :6] * points.lengths[:, None]
    curvature = pulls.T @ slopes[:, :6] + PRIOR
    errors = []
    for _ in range(4000):
        east, north, up = generator.normal(0.0, 1.0, (3, 9)) * [[0.5], [0.5], [0.7]]
        up = up + 0.35 * generator.normal()
        b = points.buildings
        moved = -(slopes[:, 0] * east[b] + slopes[:, 1] * north[b]) + slopes[:, 7] * up[b]
        moved += slopes[:, 6] * 0.2 * generator.normal()
        # What the photo does not say of its own, and where the prior was drawn.
        noise = generator.multivariate_normal(np.zeros(6), curvature)
        errors.append(np.linalg.solve(curvature, pulls.T @ moved + noise))
    np.testing.assert_allclose(sigmas(points, worth), np.std(errors, axis=0), rtol=0.06)


def test_more_buildings_say_more_however_sharp_the_photo():
    few, many = outline_of(4), outline_of(36)
    assert (sigmas(many)[:3] < 0.6 * sigmas(few)[:3]).all()
    # A photo of twice the worth tells little more of few buildings: where they stand is not known.
    assert (sigmas(few, worth=100.0) > 0.9 * sigmas(few, worth=50.0)).all()


def test_an_exact_map_leaves_the_curvature(monkeypatch):
    points = outline_of(9)
    for name in ("_POSITION_M", "_ROOF_M", "_PART_M", "_ROOFS_M", "_BASE_M", "_TOGETHER_PX", "_OWN_PX"):
        monkeypatch.setattr(map_errors, name, 1e-6)
    plain = np.sqrt(np.diagonal(np.linalg.inv(information_of(points, 1.0) + PRIOR)))
    np.testing.assert_allclose(sigmas(points, lens_percent=1e-6), plain, rtol=5e-3)


@pytest.mark.parametrize("count", [0, 5])
def test_without_outlines_the_prior_is_all_that_is_known(count):
    points = outline_of(1)
    few = OutlinePoints(*(getattr(points, name)[:count] for name in OutlinePoints.__dataclass_fields__))
    np.testing.assert_allclose(
        covariance_under_map_errors(np.zeros((6, 6)), PRIOR, few, 0.2), np.linalg.inv(PRIOR)
    )


def test_a_photo_that_says_nothing_leaves_the_prior():
    points = outline_of(4)
    found = covariance_under_map_errors(np.zeros((6, 6)), PRIOR, points, 0.2)
    np.testing.assert_allclose(found, np.linalg.inv(PRIOR))


def test_long_outlines_are_thinned_without_changing_what_they_say():
    dense, thin = outline_of(9, points_each=200), outline_of(9, points_each=50)
    information = information_of(dense, 1.0)
    whole = np.sqrt(np.diagonal(covariance_under_map_errors(information, PRIOR, dense, 0.2)))
    longer = OutlinePoints(
        *(
            getattr(thin, name) * (4.0 if name == "lengths" else 1)
            for name in OutlinePoints.__dataclass_fields__
        )
    )
    part = np.sqrt(np.diagonal(covariance_under_map_errors(information, PRIOR, longer, 0.2)))
    np.testing.assert_allclose(whole, part, rtol=0.05)
