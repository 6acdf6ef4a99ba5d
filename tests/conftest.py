"""Fixtures shared by all tests."""

import gc
from pathlib import Path
from zlib import crc32

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


def pytest_addoption(parser: pytest.Parser) -> None:
    """Adds the option that takes a slice of the nightly tests."""
    parser.addoption("--nightly", metavar="PART/PARTS", default="0/1", help="one of so many slices")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leaves out the nightly tests of other slices; which one a test is in depends on its name alone."""
    part, parts = (int(word) for word in config.getoption("--nightly").split("/"))
    kept, left_out = [], []
    for item in items:
        is_mine = not item.get_closest_marker("nightly") or crc32(item.nodeid.encode()) % parts == part
        (kept if is_mine else left_out).append(item)
    config.hook.pytest_deselected(items=left_out)
    items[:] = kept


def pytest_collection_finish() -> None:
    """Takes all objects that importing the tests leaves out of every garbage collection."""
    gc.collect()
    gc.freeze()
