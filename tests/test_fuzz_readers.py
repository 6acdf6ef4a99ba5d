"""A slice of ``make fuzz``."""

import pytest

from tests.fuzz_readers import fuzz


@pytest.mark.filterwarnings("ignore")
def test_mutated_files_are_read_or_refused() -> None:
    seen = fuzz(range(400), seed=1)
    assert seen["read"] > 50
    assert seen["refused"] > 150
