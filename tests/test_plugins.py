"""Entry points by name: unknown ones and ones that do not load are one line each."""

from __future__ import annotations

from importlib.metadata import EntryPoint

import pytest

from lodbench import plugins
from lodbench.errors import ConfigError
from lodbench.methods.lodlocv2 import LodLocV2


def test_a_plug_in_is_what_its_entry_point_names():
    assert plugins.load_plugin("methods", "lodlocv2") is LodLocV2


def test_an_unknown_name_gets_the_nearest():
    with pytest.raises(ConfigError, match="There is no method 'lodlocv3'") as caught:
        plugins.find_plugin("methods", "lodlocv3")
    assert "lodlocv2" in caught.value.hint


def test_one_that_does_not_load_is_told_in_one_line(monkeypatch):
    point = EntryPoint("torn", "no_such_module:Torn", "lodbench.methods")
    monkeypatch.setattr(plugins, "entry_points", lambda group: [point])
    with pytest.raises(ConfigError, match="method 'torn' does not load: no_such_module:Torn: ModuleNotFound"):
        plugins.load_plugin("methods", "torn")
