"""The tests' tiny town, as of the tests of methods."""

from tests.methods.conftest import city_map, scene, truths

__all__ = ["city_map", "scene", "truths"]
