"""Fixtures shared by all tests."""

from __future__ import annotations

import gc
from pathlib import Path

import pytest
from hypothesis import settings

# Compiled functions take a second on their first call; examples come from a fixed seed.
settings.register_profile("lodbench", deadline=None, derandomize=True)
settings.load_profile("lodbench")

_SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real sample data beside the checkout; tests that need it skip where it is absent."""
    if not _SHARED_DATA.is_dir():
        pytest.skip("the sample data is not beside this checkout (../shared/data)")
    return _SHARED_DATA


def pytest_collection_finish() -> None:
    """Takes all objects that importing the tests leaves out of every garbage collection."""
    gc.collect()
    gc.freeze()
