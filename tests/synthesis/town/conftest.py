"""Towns for the tests of the demo, each grown once: that takes a second."""

from __future__ import annotations

from functools import cache

import pytest

from lodbench.synthesis.town.town import grow_town

_town = cache(grow_town)


@pytest.fixture(scope="session")
def town_of():
    """Returns a function from a seed to its town."""
    return _town


@pytest.fixture(scope="session")
def town():
    return _town(0)
