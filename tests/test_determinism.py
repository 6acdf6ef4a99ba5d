"""A slice of `python -m tests.determinism`."""

import pytest

from tests.determinism import compare


@pytest.mark.nightly
def test_all_that_may_differ_at_once_changes_no_byte() -> None:
    assert compare(["all at once"], "lodlocv2,region") == 0
