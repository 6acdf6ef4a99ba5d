import pytest

from tests.training.squares import write_views


@pytest.fixture(scope="module")
def views(tmp_path_factory):
    """Twelve pictures with masks, see ``write_views``."""
    return write_views(tmp_path_factory.mktemp("views"))
