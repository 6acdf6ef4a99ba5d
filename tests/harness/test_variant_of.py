"""What rows of one method are told apart by in tables."""

import pytest

from lodbench.harness.runs.artefacts import variant_of


@pytest.mark.parametrize(
    ("method", "variant"),
    [
        ({"name": "prior_only"}, ""),
        ({"name": "lodlocv2", "variant": "full"}, "full"),
        ({"name": "uavd4l", "matcher": "sift_nn"}, "sift_nn"),
        ({"name": "mcloc", "features": "hog", "variant": "full"}, "hog"),
        ({"name": "mcloc", "features": "hog", "variant": "no_select"}, "hog no_select"),
    ],
)
def test_a_variant_names_what_differs(method, variant):
    assert variant_of(method) == variant
