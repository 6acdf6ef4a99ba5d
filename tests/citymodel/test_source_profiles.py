from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import yaml

from lodbench.citymodel import ReadOptions, read_city_model
from lodbench.errors import ConfigError

from .gml_text import box_city, city, member, polygon, solid, surface_members, write

_ROOT = Path(__file__).resolve().parents[2]
_PROFILES = sorted((_ROOT / "conf" / "source").glob("*.yaml"))


def profile(name: str) -> dict[str, Any]:
    return yaml.safe_load((_ROOT / "conf" / "source" / f"{name}.yaml").read_text())  # type: ignore[no-any-return]


def test_all_sources_are_there() -> None:
    assert {path.stem for path in _PROFILES} == {
        "plateau", "swissbuildings3d", "threedbag", "open_city_model", "adv_lod1", "adv_lod2", "clsm",
        "gable", "folder",
    }  # fmt: skip


@pytest.mark.parametrize("path", _PROFILES, ids=[path.stem for path in _PROFILES])
def test_profile_and_card(path: Path) -> None:
    values = yaml.safe_load(path.read_text())
    assert set(values) == {"name", "lod", "options"}
    assert values["name"] == path.stem
    assert values["lod"] is None or isinstance(values["lod"], str)
    ReadOptions.from_mapping(values["options"])
    card = (_ROOT / "data_cards" / f"{path.stem}.md").read_text()
    head = yaml.safe_load(card.split("---")[1])
    assert set(head) == {"id", "kind", "title", "publisher", "licence", "format", "lods", "crs"}
    assert head["id"] == path.stem
    assert all(head[key] for key in ("title", "publisher", "licence", "format", "crs"))
    assert "## How to get it" in card
    assert "## What to know" in card


class TestFromMapping:
    def test_unknown_names_get_a_hint(self) -> None:
        with pytest.raises(ConfigError, match="heigth_column") as caught:
            ReadOptions.from_mapping({"heigth_column": "h"})
        assert "height_column" in caught.value.hint

    @pytest.mark.parametrize(
        "values",
        [
            {"sunk_m": "3"},
            {"is_strict": 1},
            {"origin": [1, 2]},
            {"origin": ["a", 1, 2]},
            {"ground_m": math.nan},
        ],
    )
    def test_wrong_types(self, values: dict[str, Any]) -> None:
        with pytest.raises(ConfigError, match="wrong type"):
            ReadOptions.from_mapping(values)

    def test_unknown_words(self) -> None:
        with pytest.raises(ConfigError, match="axis_order=east is unknown") as caught:
            ReadOptions.from_mapping({"axis_order": "east"})
        assert "east_first" in caught.value.hint

    def test_a_column_may_be_called_by_a_number(self) -> None:
        assert ReadOptions.from_mapping({"height_column": 2020}).height_column == "2020"

    def test_values(self) -> None:
        options = ReadOptions.from_mapping({"origin": [1, 2, 3], "ground_m": 4, "terrain": "a.asc"})
        assert (options.origin, options.ground_m, options.terrain) == ((1.0, 2.0, 3.0), 4.0, "a.asc")


def test_open_city_model_as_published(tmp_path: Path) -> None:
    """Longitude first under EPSG:4979, zero base, walls of four points, roof a turned footprint."""
    west, south, step, height = -71.0601, 42.3555, 0.0001, 7.5
    plan = [(west, south), (west + step, south), (west + step, south + step), (west, south + step)]
    rings = [[(*p, 0.0) for p in plan], [(*p, height) for p in plan[::-1]]]
    walls = [
        polygon("<gml:posList>" + " ".join(f"{x} {y} {z}" for x, y, z in wall) + "</gml:posList>")
        for a, b in zip(plan, plan[1:] + plan[:1], strict=True)
        for wall in [[(*a, 0.0), (*a, height), (*b, height), (*b, 0.0)]]
    ]
    members = surface_members([polygon(ring) for ring in rings] + walls)
    path = write(tmp_path / "Massachusetts-25-000.gml", city(member(solid(members)), srs="EPSG:4979"))
    values = profile("open_city_model")
    model = read_city_model(path, options=ReadOptions.from_mapping(values["options"] | {"ground_m": 12.0}))
    assert model.crs == "EPSG:32619"
    assert model.findings.counts() == {
        "LB103 RING_NOT_CLOSED": 4,
        "LB305 CRS_PROJECTED": 1,
        "LB310 HEIGHTS_ELLIPSOIDAL": 1,
        "LB407 BASE_MOVED": 1,
    }
    points = model.polygons.points
    assert (points[:, 2].min(), points[:, 2].max()) == (12.0, 19.5)
    assert points[:, 0].max() == pytest.approx(9, abs=1)
    assert points[:, 1].max() == pytest.approx(11.5, abs=1)


def test_swissbuildings3d_as_published(tmp_path: Path) -> None:
    rings = [[(2600000.0 + x, 1200000.0 + y, z) for x, y, z in ring] for ring in _box()]
    text = city(member(solid(surface_members(map(polygon, rings)), 2)), srs="CH1903")
    path = write(tmp_path / "SWISSBUILDINGS3D_2_0_CHLV95LN02_1047-32.gml", text)
    values = profile("swissbuildings3d")
    model = read_city_model(path, options=ReadOptions.from_mapping(values["options"]))
    assert model.crs == "EPSG:2056+5728"
    assert model.polygons.points[:, 2].min() == 453.0


def _box() -> list[list[tuple[float, float, float]]]:
    low, high = 450.0, 462.0
    plan = [(0.0, 0.0), (8.0, 0.0), (8.0, 6.0), (0.0, 6.0)]
    walls = [
        [(*a, low), (*b, low), (*b, high), (*a, high)] for a, b in zip(plan, plan[1:] + plan[:1], strict=True)
    ]
    return [[(*p, low) for p in plan[::-1]], [(*p, high) for p in plan], *walls]


@pytest.mark.parametrize(
    ("words", "count"),
    [
        ({"ground_m": 400.0, "terrain": "nowhere.tif"}, 2),
        ({"height_column": "H", "default_height_m": 9.0, "layer": "houses"}, 3),
        ({"base": "ground", "ground_m": 400.0}, 0),
        ({"up_axis": "y"}, 1),
        ({"storey_height_m": 3.0, "axis_order": "east_first"}, 0),
    ],
)
def test_options_that_say_nothing_to_citygml_are_told(
    tmp_path: Path, words: dict[str, Any], count: int
) -> None:
    model = read_city_model(write(tmp_path / "a.gml", box_city()), options=ReadOptions.from_mapping(words))
    assert model.findings.counts().get("LB411 OPTION_UNUSED", 0) == count
