"""Entry points by name: found once, loaded when chosen, and broken only for those who choose them."""

import sys

import pytest

from lodbench.cli.options import segmenter_of
from lodbench.datasets.registry import open_dataset
from lodbench.errors import ConfigError, LodbenchError
from lodbench.methods.lodlocv2 import LodLocV2
from lodbench.methods.registry import make_method
from lodbench.plugins import (
    KINDS,
    config_folders,
    find_plugin,
    installed,
    load_plugin,
    plugin_names,
    unreadable,
)
from tests.site_packages import write_package


@pytest.fixture
def site(tmp_path, monkeypatch):
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(folder)
    return folder


def refused(group: str, name: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load_plugin(group, name)
    return caught.value.message


def test_a_plug_in_is_what_its_entry_point_names():
    assert load_plugin("methods", "lodlocv2") is LodLocV2
    assert find_plugin("methods", "lodlocv2").is_ours


def test_an_unknown_name_gets_the_nearest_those_of_others_too(site):
    write_package(site, "far-fits", {"fits": {"hausdorff": "far_fits:Hausdorff"}})
    with pytest.raises(ConfigError, match="There is no fit 'hausdorf'") as caught:
        find_plugin("fits", "hausdorf")
    assert caught.value.hint == "Did you mean hausdorff?"


def test_all_of_ours_load():
    for group in KINDS:
        for plug_in in installed(group):
            if plug_in.is_ours:
                assert callable(plug_in.load()), plug_in


@pytest.mark.parametrize(
    ("module", "reason"),
    [
        ("import no_such_module", "ModuleNotFoundError: No module named 'no_such_module'"),
        ("1 / 0", "ZeroDivisionError: division by zero"),
        ("raise SystemExit(3)", "SystemExit: 3"),
        ("x = (", "SyntaxError"),
        ("", "AttributeError"),
        ("Part = 7", "is no class or function, but of type int"),
        ("class Part:\n    name = 'torn'", "has no params_type and no localize"),
    ],
)
def test_a_broken_one_is_told_with_its_package_to_those_who_choose_it(site, monkeypatch, module, reason):
    monkeypatch.delitem(sys.modules, "torn_kit", raising=False)
    write_package(site, "torn-kit", {"methods": {"torn": "torn_kit:Part"}}, {"torn_kit.py": module})
    told = refused("methods", "torn")
    assert told.startswith("The method 'torn' of the package torn-kit 1.0 is broken: torn_kit:Part ")
    assert reason in told
    assert "\n" not in told
    assert load_plugin("methods", "lodlocv2") is LodLocV2


def test_a_name_of_ours_stays_ours(site):
    write_package(site, "rival", {"methods": {"lodlocv2": "rival:Rival"}})
    assert load_plugin("methods", "lodlocv2") is LodLocV2
    (theirs,) = [plug_in for plug_in in installed("methods") if not plug_in.is_ours]
    assert theirs.package == "rival 1.0"
    assert "lodbench" in theirs.fault


def test_a_name_that_two_others_have_is_nobodys(site):
    for name in ("first", "second"):
        write_package(site, name, {"fits": {"same": f"{name}:Fit", name: "math:sqrt"}})
    assert "first 1.0 is broken: second 1.0 has one of that name" in refused("fits", "same")
    assert load_plugin("fits", "second")(4.0) == 2.0


def test_damaged_metadata_of_one_package_hides_no_other(site):
    write_package(site, "whole", {"fits": {"root": "math:sqrt"}})
    damaged = write_package(site, "damaged", {"fits": {"other": "math:sqrt"}})
    (damaged / "entry_points.txt").write_text("[lodbench.fits]\nno value here\n")
    assert plugin_names("fits")[-1] == "root"
    (line,) = unreadable()
    assert "entry points cannot be read" in line


def test_folders_of_configuration_are_found_without_an_import(site):
    files = {"kit/__init__.py": "1 / 0", "kit/conf/source/grid.yaml": "name: grid\n"}
    write_package(site, "kit", {"config_sources": {"kit": "kit.conf", "gone": "kit_gone.conf"}}, files)
    found = {module: folder for _, module, folder in config_folders()}
    assert found["kit.conf"] == site / "kit" / "conf"
    assert found["kit_gone.conf"] is None
    assert next(iter(found)) == "lodbench.conf"


KIT = """
from dataclasses import dataclass
from lodbench.errors import DatasetError

@dataclass(frozen=True)
class Params:
    name: str = "kit"
    size: int = 1

    def __post_init__(self):
        if self.size < 0:
            raise ValueError("size is negative")

class Part:
    name, params_type, requires = "kit", Params, ()

    def __init__(self, params):
        if params.size > 1:
            raise SystemExit("gone")
        import kit_that_is_not_there

    def localize(self, query, city_map, streams): ...
    def segment(self, entry): ...
    def fingerprint(self, entries): ...

def opened(params: Params):
    if params.size > 1:
        raise DatasetError("in its own words")
    return 7 if params.size else {}["gone"]
"""


MAKERS = {
    "method": lambda size: make_method("kit", size=size),
    "segmenter": lambda size: segmenter_of("kit", [f"size={size}"]),
    "dataset": lambda size: open_dataset({"name": "kit", "size": size}),
}


@pytest.mark.parametrize(
    ("kind", "size", "told"),
    [
        ("method", -1, "The method 'kit' cannot take its settings: ValueError: size is negative"),
        ("method", 1, "The method 'kit' cannot be made: ModuleNotFoundError: No module named"),
        ("method", 2, "The method 'kit' cannot be made: SystemExit: gone"),
        ("segmenter", -1, "The segmenter 'kit' cannot be made: ValueError: size is negative"),
        ("segmenter", 1, "The segmenter 'kit' cannot be made: ModuleNotFoundError: No module named"),
        ("dataset", -1, "The dataset 'kit' cannot take its settings: ValueError: size is negative"),
        ("dataset", 0, "The dataset 'kit' cannot be opened: KeyError: 'gone'"),
        ("dataset", 1, "The dataset 'kit' cannot be opened: TypeError: int came out instead of Dataset"),
        ("dataset", 2, "in its own words"),
    ],
)
def test_what_a_part_raises_when_it_is_made_is_told_in_a_line(site, monkeypatch, kind, size, told):
    parts = {"methods": "Part", "segmenters": "Part", "datasets": "opened"}
    points = {group: {"kit": f"kit_parts:{part}"} for group, part in parts.items()}
    write_package(site, "kit", points, {"kit_parts.py": KIT})
    monkeypatch.delitem(sys.modules, "kit_parts", raising=False)
    with pytest.raises(LodbenchError) as caught:
        MAKERS[kind](size)
    message = caught.value.message
    assert message.replace(" of the package kit 1.0 ", " ").startswith(told)
    assert ("package kit 1.0" in message) == told.startswith("The ")
    assert ("kit_parts.py, line " in message) == (told.startswith("The ") and "came out" not in told)
    assert "\n" not in message
