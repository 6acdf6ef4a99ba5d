"""Which buildings have pitched roofs, as each kind of source tells, and that the scene knows."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lodbench.citymodel import ReadOptions, mesh_city, mesh_model, open_scene, read_city_model
from lodbench.citymodel.attributes import is_pitched
from lodbench.citymodel.derive import choose_buildings
from lodbench.citymodel.polygons import finish_model
from lodbench.citymodel.read import read_source
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.scene_file import read_scene, scene_folder, write_scene
from lodbench.citymodel.source import open_sources
from lodbench.cli import main
from lodbench.errors import CityModelError
from lodbench.harness.city import city_digests, compile_tiles
from lodbench.storage.digest import write_arrays

from .gml_text import box_rings, city, member, solid_of, write
from .test_cityjson import document, surface


def box(n: int) -> str:
    return solid_of(box_rings(500000.0 + 20.0 * n))


def roof(code: str) -> str:
    return f"<bldg:roofType>{code}</bldg:roofType>"


def parts_of(n: int, codes: tuple[str, ...]) -> str:
    """Returns a building of parts, each with a roof of its own."""
    parts = "".join(
        f'<bldg:consistsOfBuildingPart><bldg:BuildingPart gml:id="p{n}-{k}">{roof(code)}{box(n + k)}'
        "</bldg:BuildingPart></bldg:consistsOfBuildingPart>"
        for k, code in enumerate(codes)
    )
    return member(parts, f"b{n}")


def town(*codes: str) -> str:
    """Returns a city of boxes; an empty code tells of no roof."""
    return city("".join(member(box(n) if not code else roof(code) + box(n), f"b{n}")
                        for n, code in enumerate(codes)))  # fmt: skip


@pytest.mark.parametrize(
    ("told", "expected"),
    [
        ("1000", False), ("2100", True), ("3100", True), ("3200", True), ("5000", True), ("9999", False),
        ("1010", True), ("1130", False), (" 3100 ", True), ("http://x/roofType.xml#3100", True),
        ("SATTELDACH", True), ("Krüppelwalmdach", True), ("FLACHDACH", False), ("slanted", True),
        ("multiple horizontal", False), ("half-hipped", True), ("flat", False), ("dome", False), ("", False),
        ("BU_3100", True), ("13100", False), ("flat (no pitch)", False), ("unpitched", False), ("cone", True),
        ("http://x/2012/roofType.xml#1000", False), ("3100.0", True),
    ],
)  # fmt: skip
def test_words_and_codes(told: str, expected: bool) -> None:
    assert is_pitched(told) == expected


class TestCityGML:
    def test_buildings(self, tmp_path: Path) -> None:
        model = read_city_model(write(tmp_path / "a.gml", town("3100", "1000", "", "2100")))
        assert model.pitched is not None
        assert model.pitched.tolist() == mesh_city(model).pitched.tolist() == [True, False, False, True]

    def test_info_counts_them(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        told = ["roofs      2 buildings pitched (from the file)"]
        for codes, expected in ((("3100", "1000", "2100"), told), (("1000",), [])):
            path = write(tmp_path / "a.gml", town(*codes))
            assert main(["city", "info", str(path)]) == 0
            lines = capsys.readouterr().out.splitlines()
            assert [line for line in lines if line.startswith("roofs")] == expected
            assert main(["city", "convert", str(path), str(tmp_path / f"{len(expected)}.scene")]) == 0
            assert main(["city", "info", str(tmp_path / f"{len(expected)}.scene")]) == 0
            lines = capsys.readouterr().out.splitlines()
            assert [line for line in lines if line.startswith("roofs")] == expected

    def test_nothing_told_and_nothing_pitched(self, tmp_path: Path) -> None:
        for codes in (("", ""), ("1000", "9999")):
            assert open_scene(write(tmp_path / "a.gml", town(*codes))).pitched is None

    def test_half_of_the_parts_decide(self, tmp_path: Path) -> None:
        members = parts_of(0, ("3100", "1000")) + parts_of(10, ("3100", "1000", "1000"))
        model = read_city_model(write(tmp_path / "a.gml", city(members)))
        assert model.pitched is not None
        assert model.pitched.tolist() == [True, False]

    def test_with_details_the_same(self, tmp_path: Path) -> None:
        path = write(tmp_path / "a.gml", town("3100", "1000"))
        model = read_city_model(path, options=ReadOptions(has_details=True))
        assert model.pitched is not None
        assert model.pitched.tolist() == [True, False]


@pytest.mark.parametrize("attribute", ["roofType", "b3_dak_type", "dak_type", "roof:shape", "roof_shape"])
def test_cityjson(tmp_path: Path, attribute: str) -> None:
    told: tuple[Any, ...] = ("slanted", "horizontal", None, ["slanted"], 3100.0, True)
    objects = {
        f"b{n}": {"type": "Building", "attributes": {attribute: value}, "geometry": [surface([0, 1, 2])]}
        for n, value in enumerate(told)
    }
    path = tmp_path / "a.city.json"
    path.write_text(json.dumps(document(objects)))
    model = read_city_model(path)
    assert model.pitched is not None
    assert model.pitched.tolist() == [True, False, False, False, True, False]


def test_an_empty_attribute_leaves_it_to_the_next(tmp_path: Path) -> None:
    attributes = {"roofType": " ", "b3_dak_type": "slanted"}
    objects = {"b": {"type": "Building", "attributes": attributes, "geometry": [surface([0, 1, 2])]}}
    path = tmp_path / "a.city.json"
    path.write_text(json.dumps(document(objects)))
    pitched = read_city_model(path).pitched
    assert pitched is not None
    assert pitched.all()
    # Written as CityGML, where they have names of others.
    assert main(["city", "convert", str(path), str(tmp_path / "a.gml")]) == 0
    again = read_city_model(tmp_path / "a.gml").pitched
    assert again is not None
    assert again.all()


@pytest.mark.parametrize("column", ["b3_dak_typ", "RoofType"])
def test_surfaces_of_vector_files(tmp_path: Path, column: str) -> None:
    pytest.importorskip("pyogrio", reason="it comes with the extra [vector]")
    wall = [[0, 0, 0], [1e-4, 0, 0], [1e-4, 0, 6], [0, 0, 6], [0, 0, 0]]
    features = [
        {
            "type": "Feature",
            "properties": {column: shape, "roof:shape": "gabled"},
            "geometry": {
                "type": "MultiPolygon",
                "coordinates": [[np.add(wall, [8 + n * 1e-3, 50, 0]).tolist()]],
            },
        }
        for n, shape in enumerate(("slanted", None, "horizontal"))
    ]
    path = tmp_path / "a.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    model = read_city_model(path)
    assert model.format == "surfaces"
    assert model.pitched is not None
    assert model.pitched.tolist() == [True, True, False]


def test_footprints(tmp_path: Path) -> None:
    """Of OpenStreetMap; one without a height is no building of the city."""
    pytest.importorskip("pyogrio", reason="it comes with the extra [vector]")
    rows = [("gabled", 6.0), ("hipped", None), ("flat", 6.0), (None, 6.0), ("skillion", 6.0)]
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]]) * 1e-4 + [8.0, 50.0]
    features = [
        {
            "type": "Feature",
            "properties": {"roof:shape": shape, "height": height},
            "geometry": {"type": "Polygon", "coordinates": [np.add(corners, [n * 1e-3, 0.0]).tolist()]},
        }
        for n, (shape, height) in enumerate(rows)
    ]
    path = tmp_path / "a.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    scene = open_scene(path)
    assert scene.num_buildings == 4
    assert scene.pitched is not None
    assert scene.pitched.tolist() == [True, False, False, True]


class TestOnTheWay:
    def test_tiles_at_once_and_one_by_one(self, tmp_path: Path) -> None:
        (folder := tmp_path / "tiles").mkdir()
        for n, codes in enumerate((("", "1000"), ("3100", ""), ("1000", "2100"))):
            write(folder / f"{n}.gml", town(*codes).replace('gml:id="b', f'gml:id="t{n}-b'))
        compile_tiles(folder, tmp_path / "a.scene")
        for scene in (open_scene(folder), read_scene(tmp_path / "a.scene")[0]):
            assert scene.pitched is not None
            assert scene.pitched.tolist() == [False, False, True, False, False, True]

    def test_chosen_buildings(self, tmp_path: Path) -> None:
        model = read_city_model(write(tmp_path / "a.gml", town("3100", "1000", "2100")))
        chosen = choose_buildings(model, ids=["b1", "b2"])
        assert chosen.pitched is not None
        assert chosen.pitched.tolist() == [False, True]

    def test_derived_blocks(self, shared_data: Path) -> None:
        """The file tells 48 of 83 buildings to have pitched roofs, some by their parts."""
        model = read_city_model(shared_data / "city/germany_lod2/LoD2_32_280_5657_1_NW.gml")
        scene = mesh_model(model, "1", roof_height="median").scene
        assert scene.pitched is not None
        assert int(scene.pitched.sum()) == 48

    def test_blocks_that_end_at_eaves_are_not_too_high(self, shared_data: Path) -> None:
        model = read_city_model(shared_data / "city/germany_lod2/LoD2_32_280_5657_1_NW.gml")
        assert mesh_model(model, "1", roof_height="eave").scene.pitched is None

    def test_a_reader_that_tells_of_other_buildings_is_named(self, tmp_path: Path) -> None:
        raw = read_source(open_sources(write(tmp_path / "a.gml", town("3100")))[0], ReadOptions())
        raw.pitched = np.ones(2, np.bool_)
        with pytest.raises(CityModelError, match="gives roofs for buildings that it did not read"):
            finish_model(raw, ReadOptions())

    def test_it_is_the_same_city_with_other_roofs(self, tmp_path: Path) -> None:
        """A run names it anew; who compares runs sees the same geometry."""
        told = [city_digests(open_scene(write(tmp_path / "a.gml", town(code, "1000"))))
                for code in ("3100", "2100", "1000")]  # fmt: skip
        assert told[0] == told[1] == {"scene": told[2]["scene"], "roofs": told[0]["roofs"]}
        assert "roofs" not in told[2]


class TestFolders:
    @pytest.fixture
    def scene(self, tmp_path: Path) -> Scene:
        return open_scene(write(tmp_path / "a.gml", town("3100", "1000", "2100")))

    def test_comes_back(self, tmp_path: Path, scene: Scene) -> None:
        for pitched in (scene.pitched, None):
            write_scene(replace(scene, pitched=pitched), tmp_path / "a.scene")
            again, _ = read_scene(tmp_path / "a.scene")
            np.testing.assert_array_equal(again.pitched, pitched)

    @pytest.mark.parametrize("number", [-1, 3, 2**70, "x", [0, 1], 0.7, True])
    def test_numbers_of_no_building_are_refused(self, tmp_path: Path, scene: Scene, number: object) -> None:
        with pytest.raises(CityModelError, match="is damaged"):
            read_scene(stored(scene, tmp_path, pitched=[0, number]))

    def test_a_folder_that_is_older_tells_nothing(self, tmp_path: Path, scene: Scene) -> None:
        assert read_scene(stored(scene, tmp_path))[0].pitched is None


def stored(scene: Scene, folder: Path, **told: object) -> Path:
    """Writes a scene as a folder that tells only so much of it."""
    about = {"building_ids": scene.building_ids, "lod": "1", "crs": None, "origin": [0, 0, 0], "extra": {}}
    names = ("vertices", "triangles", "vertex_starts", "triangle_starts")
    arrays = {name: getattr(scene, name) for name in names}
    scene_folder(folder / "a.scene", about | told, lambda partial: write_arrays(partial, arrays))
    return folder / "a.scene"
