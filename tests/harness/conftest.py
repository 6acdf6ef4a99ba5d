"""What tests of runs share: three views of the tests' town, and a cache of their own."""

import pytest

from lodbench.datasets.folder import FolderParams, open_folder
from tests.town import write_dataset


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    root, city = write_dataset(tmp_path_factory.mktemp("town"), count=3)
    return open_folder(FolderParams(str(root), str(city)))


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path / "cache"))
