"""Towns for the tests of the demo, each grown once a process: that takes seconds."""

import pytest

from tests import town as towns


@pytest.fixture(scope="session")
def town_of():
    """Returns a function from a seed to its town."""
    return towns.town_of


@pytest.fixture(scope="session")
def town():
    return towns.town_of(0)
