"""One town for all tests of the demo: growing it takes a second."""

from __future__ import annotations

import pytest

from lodbench.datasets.demo.town import grow_town


@pytest.fixture(scope="session")
def town():
    return grow_town(0)
