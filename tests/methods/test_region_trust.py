"""The model of trust: a probability that each sign moves the way it should, and by how much it may."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from lodbench.methods.region.trust import ConfidenceFeatures, success_probability

shares = st.floats(0.0, 1.0)
some_signs = st.builds(
    ConfidenceFeatures,
    shares,
    st.floats(0.0, 100.0),
    st.floats(-50.0, 900.0),
    st.floats(-1.0, 1.5),
    st.floats(0.0, 9.0),
)
BETTER = {"probability": 1, "apart_m": -1, "lines": 1, "sharpness": 1, "beyond": -1}


@given(some_signs, st.sampled_from(sorted(BETTER)), st.floats(0.0, 5.0))
def test_a_better_sign_never_lowers_it(features, name, step):
    value = max(
        getattr(features, name) + BETTER[name] * step, {"lines": -50.0, "sharpness": -1.0}.get(name, 0.0)
    )
    assert success_probability(features._replace(**{name: value})) >= success_probability(features)


@given(some_signs)
def test_it_is_a_probability(features):
    assert 0.0 <= success_probability(features) <= 1.0


def test_no_sign_alone_makes_an_answer_sure():
    good = ConfidenceFeatures(0.95, 0.6, 200.0, 0.6, 0.0)
    assert success_probability(good) > 0.95
    # Far below the prior's range, or where no edges lie along the lines: not trusted. Far from the best by
    # regions: less.
    assert success_probability(good._replace(beyond=0.4)) < 0.1
    assert success_probability(good._replace(lines=0.0)) < 0.5
    assert success_probability(good._replace(apart_m=30.0)) < success_probability(good)
    # Edges beside the lines, not on them: another map than this.
    assert success_probability(good._replace(sharpness=0.1)) < 0.8


def test_thousands_of_nats_outweigh_nothing_else():
    """Towards the horizon lines find edges anywhere: what all else speaks against stays untrusted."""
    lost = ConfidenceFeatures(0.07, 7.5, 7500.0, 0.12, 0.0)
    assert success_probability(lost) < 0.5
    assert success_probability(lost) == success_probability(lost._replace(lines=300.0))
