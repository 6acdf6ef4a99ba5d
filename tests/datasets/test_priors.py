import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.prior_sources import (
    BasinPrior,
    FilePrior,
    UniformPrior,
    prior_text,
    with_uniform_priors,
)
from lodbench.errors import ConfigError, DatasetError
from lodbench.geometry import EulerAngles, Pose, wrap_deg
from lodbench.storage import random_stream
from tests.town import write_dataset


def errors_of(prior: Pose, truth: Pose) -> tuple[float, float]:
    turn = prior.rotation @ truth.rotation.T
    cosine = min(1.0, max(-1.0, (float(np.trace(turn)) - 1.0) / 2.0))
    return float(np.linalg.norm(prior.center - truth.center)), math.degrees(math.acos(cosine))


@pytest.mark.slow
def test_medians_are_those_of_the_published_priors():
    truth = Pose.from_euler(EulerAngles(40.0, 0.5, 30.0), (100.0, -50.0, 130.0))
    prior = UniformPrior()
    sampled = [errors_of(prior.draw(truth, random_stream(0, "prior", k)), truth) for k in range(20000)]
    translation, rotation = np.median(np.array(sampled), axis=0)
    assert translation == pytest.approx(17.1, rel=0.02)
    assert rotation == pytest.approx(3.82, rel=0.02)


@given(
    st.integers(0, 2**32),
    st.floats(0, 60),
    st.floats(-179, 179),
    st.tuples(*[st.floats(0, 40)] * 3),
    st.tuples(*[st.floats(0, 9)] * 3),
)
def test_errors_stay_within_the_half_widths(seed, pitch, yaw, widths_m, widths_deg):
    truth = Pose.from_euler(EulerAngles(pitch, 0.0, yaw), (3.0, 2.0, 120.0))
    drawn = UniformPrior(*widths_m, *widths_deg).draw(truth, random_stream(seed, "prior"))
    assert (np.abs(drawn.center - truth.center) <= np.array(widths_m) + 1e-9).all()
    pitch_deg, roll_deg, yaw_deg = drawn.euler
    assert abs(wrap_deg(yaw_deg - yaw)) <= widths_deg[0] + 1e-6
    assert abs(pitch_deg - pitch) <= widths_deg[1] + 1e-6
    assert abs(roll_deg) <= widths_deg[2] + 1e-6


def test_same_stream_same_prior():
    truth = Pose.from_euler(EulerAngles(40.0, 0.0, 30.0), (0.0, 0.0, 130.0))
    first, second = (UniformPrior().draw(truth, random_stream(3, "prior", "q")) for _ in range(2))
    np.testing.assert_array_equal(first.cam_from_world, second.cam_from_world)


def test_a_width_of_zero_changes_no_other_axis():
    truth = Pose.from_euler(EulerAngles(40.0, 0.0, 30.0), (0.0, 0.0, 130.0))
    full = UniformPrior().draw(truth, random_stream(3, "q"))
    level = UniformPrior(z_m=0.0).draw(truth, random_stream(3, "q"))
    np.testing.assert_allclose(full.center[:2], level.center[:2], atol=1e-9)
    assert level.center[2] == pytest.approx(130.0)


@pytest.mark.parametrize("width", [-1.0, math.nan, math.inf])
def test_a_bad_width_is_named(width):
    with pytest.raises(ConfigError, match="z_m"):
        UniformPrior(z_m=width)


def test_a_wider_prior_errs_the_same_way_only_further(tmp_path):
    root, city = write_dataset(tmp_path, count=2)
    dataset = open_folder(FolderParams(str(root), str(city)))
    near, far = (with_uniform_priors(dataset, UniformPrior(d, d, d, 0, 0, 0), seed=3) for d in (10.0, 100.0))
    for a, b in zip(near.entries, far.entries, strict=True):
        truth = dataset.truth[a.key].center
        np.testing.assert_allclose(10 * (a.prior.center - truth), b.prior.center - truth, atol=1e-9)
        assert np.abs(a.prior.center - truth).max() <= 10
    other = with_uniform_priors(dataset, UniformPrior(), seed=4)
    assert not np.allclose(other.entries[0].prior.center, near.entries[0].prior.center)
    assert near.truth is dataset.truth


def test_a_query_without_truth_has_no_prior_that_was_drawn_around_one(tmp_path):
    """Its own would be answered under the protocol's words, `uniform around the truth`, and be none such."""
    root, city = write_dataset(tmp_path, count=2)
    dataset = open_folder(FolderParams(str(root), str(city)))
    lost = dataset.entries[0]
    known = {key: pose for key, pose in dataset.truth.items() if key != lost.key}
    drawn = with_uniform_priors(replace(dataset, truth=known), UniformPrior(), seed=0)
    assert lost.prior is not None
    assert (drawn.entries[0].prior, drawn.entries[0].hypotheses) == (None, ())
    assert drawn.entries[1].prior is not None


@pytest.mark.parametrize("prior", [UniformPrior(), BasinPrior()])
def test_nothing_is_drawn_around_no_truth(tmp_path, prior):
    dataset = open_folder(FolderParams(*map(str, write_dataset(tmp_path, count=2))))
    with pytest.raises(DatasetError, match="no true pose to draw priors around") as fault:
        prior.apply(replace(dataset, truth={}), seed=0)
    assert "prior=sensor" in fault.value.hint


@pytest.mark.parametrize(("paper_m", "paper_deg"), [(17.6, 3.87), (17.9, 3.94)])
def test_medians_are_within_5_percent_of_the_papers_swiss_ones(paper_m, paper_deg):
    truth = Pose.from_euler(EulerAngles(40.0, 0.5, 30.0), (100.0, -50.0, 130.0))
    sampled = [errors_of(UniformPrior().draw(truth, random_stream(1, k)), truth) for k in range(4000)]
    translation, rotation = np.median(np.array(sampled), axis=0)
    assert translation == pytest.approx(paper_m, rel=0.05)
    assert rotation == pytest.approx(paper_deg, rel=0.05)


def test_basin_priors_fill_the_box_and_keep_the_published_attitude():
    truth = Pose.from_euler(EulerAngles(40.0, 0.5, 30.0), (100.0, -50.0, 130.0))
    widths = BasinPrior(range_m=100.0).widths
    drawn = [widths.draw(truth, random_stream(1, k)) for k in range(2000)]
    offsets = np.array([prior.center - truth.center for prior in drawn])
    turns = np.array([np.subtract(prior.euler, truth.euler) for prior in drawn])
    # Uniform on +-w: the mean of the absolute value is w / 2, the largest close to w.
    np.testing.assert_allclose(np.abs(offsets).mean(axis=0), 50.0, rtol=0.05)
    np.testing.assert_allclose(np.abs(turns).mean(axis=0), [0.5, 0.5, 3.75], rtol=0.05)
    assert 99.0 < np.abs(offsets).max() <= 100.0


def test_all_hypotheses_are_written_and_read_back(tmp_path):
    root, city = write_dataset(tmp_path, count=2)
    dataset = open_folder(FolderParams(str(root), str(city)))
    several = tuple(dataset.entries[0].prior.shifted([d, 0, 0]) for d in (0.0, 5.0, 9.0))
    dataset = replace(dataset, entries=(replace(dataset.entries[0], hypotheses=several), dataset.entries[1]))
    (tmp_path / "priors.txt").write_text(prior_text(dataset.entries, "of a test", 0))
    read = FilePrior(str(tmp_path / "priors.txt")).apply(dataset, 0)
    np.testing.assert_allclose(read.entries[0].prior.center, several[0].center, atol=1e-9)
    centers = [pose.center for pose in read.entries[0].hypotheses]
    np.testing.assert_allclose(centers, [pose.center for pose in several], atol=1e-9)
    assert len(read.entries[1].hypotheses) == 1
