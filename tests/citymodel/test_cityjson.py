import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lodbench.citymodel import mesh_model, read_city_model
from lodbench.citymodel.model import CityModel, SurfaceKind
from lodbench.citymodel.options import ReadOptions
from lodbench.errors import CityModelError

from .gml_text import codes, write

SQUARE = [[0, 0, 0], [4000, 0, 0], [4000, 4000, 0], [0, 4000, 0]]
TRANSFORM = {"scale": [0.001, 0.001, 0.001], "translate": [85000.0, 446000.0, 0.0]}


def document(objects: dict[str, Any], **changes: Any) -> dict[str, Any]:
    base: dict[str, Any] = {
        "type": "CityJSON",
        "version": "1.1",
        "transform": TRANSFORM,
        "metadata": {"referenceSystem": "https://www.opengis.net/def/crs/EPSG/0/7415"},
        "CityObjects": objects,
        "vertices": SQUARE,
    }
    merged = base | changes
    return {key: value for key, value in merged.items() if value is not None}


def surface(*rings: list[int], lod: Any = "1", kind: str = "MultiSurface") -> dict[str, Any]:
    return {"type": kind, "lod": lod, "boundaries": [list(rings)]}


def building(*geometry: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"type": "Building", "geometry": list(geometry), **more}


def read(tmp_path: Path, content: Any, **options: Any) -> CityModel:
    text = content if isinstance(content, str | bytes) else json.dumps(content)
    return read_city_model(write(tmp_path / "x.city.json", text), **options)


class TestReading:
    def test_transform_and_frame(self, tmp_path: Path) -> None:
        model = read(tmp_path, document({"a": building(surface([0, 1, 2, 3]))}))
        assert model.origin.tolist() == [85000, 446000, 0]
        assert model.polygons.points.tolist() == [[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]]
        assert (model.format, model.version, model.crs) == ("CityJSON", "1.1", "EPSG:7415")
        assert model.findings.counts() == {}

    @pytest.mark.parametrize("lod", [1, 1.0, "1", "1.0", "LoD1", "lod 1.0"])
    def test_level_names(self, tmp_path: Path, lod: Any) -> None:
        assert read(tmp_path, document({"a": building(surface([0, 1, 2], lod=lod))})).lods == ("1",)

    def test_parts_go_to_their_building(self, tmp_path: Path) -> None:
        part = {"type": "BuildingPart", "geometry": [surface([0, 1, 2])], "parents": ["a"]}
        orphan = {"type": "BuildingPart", "geometry": [surface([0, 1, 2])]}
        model = read(tmp_path, document({"p": part, "a": building(children=["p", "q"]), "q": orphan}))
        assert (model.building_ids, model.num_parts, len(model.polygons)) == (("a",), 2, 2)

    def test_extensions_and_other_objects(self, tmp_path: Path) -> None:
        square = surface([0, 1, 2])
        objects = {
            "a": {"type": "+NoiseBuilding", "geometry": [square]},
            "b": {"type": "BuildingZ", "geometry": [square]},
            "c": {"type": "Road", "geometry": [square]},
            "d": building(),
        }
        model = read(tmp_path, document(objects))
        assert model.building_ids == ("a", "b", "d")
        assert codes(model) == {"LB209": 1, "LB403": 1}

    def test_circle_of_parents_ends(self, tmp_path: Path) -> None:
        objects = {
            "a": building(surface([0, 1, 2]), parents=["b"]),
            "b": building(surface([0, 1, 2]), parents=["a"]),
        }
        assert len(read(tmp_path, document(objects)).polygons) == 2

    def test_groups_list_buildings_and_own_none(self, tmp_path: Path) -> None:
        square = surface([0, 1, 2])
        objects = {
            "g": {"type": "CityObjectGroup", "children": ["a", "p"]},
            "a": building(square, parents=["g"], children=["p"]),
            "p": {"type": "BuildingPart", "geometry": [square], "parents": ["g", "a"]},
        }
        model = read(tmp_path, document(objects))
        assert (model.building_ids, model.num_parts, len(model.polygons)) == (("a",), 1, 2)
        assert codes(model) == {"LB209": 1}

    def test_parts_in_parts(self, tmp_path: Path) -> None:
        def nested(depth: int) -> dict[str, Any]:
            part = {"type": "BuildingPart", "geometry": [surface([0, 1, 2])]}
            return {"0": building(), **{str(n): part | {"parents": [str(n - 1)]} for n in range(1, depth)}}

        model = read(tmp_path, document(dict(reversed(nested(50).items()))))
        assert (model.building_ids, model.num_parts, len(model.polygons)) == (("0",), 49, 49)
        with pytest.raises(CityModelError, match="nested too deeply"):
            read(tmp_path, document(nested(5000)))

    def test_no_level_is_no_level_of_that_name(self, tmp_path: Path) -> None:
        assert read(tmp_path, document({"a": building(surface([0, 1, 2], lod=None))})).lods == ("",)

    @pytest.mark.parametrize("vertices", [[[0, 0], [4, 0], [4, 4]], [0, 0, 0, 4, 0, 0, 4, 4, 0]])
    def test_points_of_two_coordinates_are_refused(self, tmp_path: Path, vertices: Any) -> None:
        with pytest.raises(CityModelError, match="no three coordinates"):
            read(tmp_path, document({"a": building(surface([0, 1, 2]))}, vertices=vertices))
        templates = {"templates": [surface([0, 1, 2])], "vertices-templates": vertices}
        instance = {"type": "GeometryInstance", "template": 0, "boundaries": [1]}
        instance["transformationMatrix"] = np.eye(4).ravel().tolist()
        with pytest.raises(CityModelError, match="no three coordinates"):
            read(tmp_path, document({"a": building(instance)}, **{"geometry-templates": templates}))

    def test_a_key_that_stands_thousands_of_times(self, tmp_path):
        # Square in their number these would take minutes.
        one = '"a": {"type": "Building"}'
        text = json.dumps(document({"b": building(surface([0, 1, 2]))}))
        text = text.replace('"CityObjects": {', '"CityObjects": {' + f"{one}, " * 20000)
        model = read(tmp_path, text)
        assert model.building_ids[:3] == ("a", "a~2", "a~3")
        assert len(set(model.building_ids)) == 20001

    def test_template(self, tmp_path: Path) -> None:
        templates = {
            "templates": [surface([0, 1, 2], lod="2")],
            "vertices-templates": [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
        }
        turned = [0, -2, 0, 0, 2, 0, 0, 0, 0, 0, 2, 5, 0, 0, 0, 1]
        instance = {
            "type": "GeometryInstance",
            "template": 0,
            "boundaries": [1],
            "transformationMatrix": turned,
        }
        objects = {"a": building(instance, surface([0, 1, 2], lod="2"))}
        model = read(tmp_path, document(objects, **{"geometry-templates": templates}))
        points = model.polygons.points + model.origin - [85000, 446000, 0]
        assert points[:3].tolist() == [[4, 0, 5], [4, 2, 5], [2, 0, 5]]
        assert len(model.polygons) == 2

    def test_template_in_degrees_is_a_finding(self, tmp_path: Path) -> None:
        templates = {"templates": [surface([0, 1, 2])], "vertices-templates": np.eye(3).tolist()}
        instance = {"type": "GeometryInstance", "template": 0, "boundaries": [1]}
        instance["transformationMatrix"] = np.eye(4).ravel().tolist()
        transform = {"scale": [1e-8, 1e-8, 1e-3], "translate": [139.7, 35.6, 0.0]}
        text = document(
            {"a": building(instance, surface([0, 1, 2]))},
            transform=transform,
            metadata={"referenceSystem": "EPSG:6697"},
            **{"geometry-templates": templates},
        )
        model = read(tmp_path, text)
        assert (len(model.polygons), codes(model)["LB206"]) == (1, 1)

    def test_interiors_are_not_meshed(self, tmp_path: Path) -> None:
        room = {"type": "BuildingRoom", "geometry": [surface([0, 1, 2])], "parents": ["a"]}
        model = read(tmp_path, document({"a": building(surface([0, 1, 2, 3])), "r": room}))
        assert mesh_model(model).num_polygons == 1

    def test_semantics_that_do_not_fit_lose_nothing(self, tmp_path: Path) -> None:
        walls = surface([0, 1, 2])
        walls["semantics"] = {"surfaces": [{"type": "WallSurface"}], "values": [0, 0, 0]}
        model = read(tmp_path, document({"a": building(walls)}))
        assert model.polygons.kind.tolist() == [SurfaceKind.UNKNOWN]

    def test_missing_reference_system(self, tmp_path: Path) -> None:
        assert codes(read(tmp_path, document({"a": building(surface([0, 1, 2]))}, metadata=None))) == {
            "LB301": 1
        }

    def test_real_coordinates_of_version_1_0(self, tmp_path: Path) -> None:
        vertices = (np.array(SQUARE) / 1000.0 + [85000.5, 446000.5, 0]).tolist()
        model = read(
            tmp_path,
            document({"a": building(surface([0, 1, 2]))}, version="1.0", transform=None, vertices=vertices),
        )
        assert model.polygons.points[0].tolist() == [0.5, 0.5, 0]


class TestFaults:
    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"type": "CityJSONFeature"}, "without the CityJSON line"),
            ({"type": "FeatureCollection"}, "not CityJSON"),
            ({"version": "3.7"}, "of no version|CityJSON 3.7"),
            ({"version": None}, "of no version"),
            ({"transform": None}, "no transform"),
            ({"transform": {"scale": [1, 2]}}, "malformed transform"),
            ({"vertices": [[0, 0]]}, "malformed vertices"),
            ({"vertices": [["a", 0, 0]]}, "malformed vertices"),
            ({"CityObjects": []}, "no CityJSON object"),
            ({"CityObjects": {}}, "no buildings"),
            ({"CityObjects": {"a": 7}}, "object a is malformed"),
        ],
    )
    def test_structure(self, tmp_path: Path, changes: dict[str, Any], message: str) -> None:
        with pytest.raises(CityModelError, match=message) as caught:
            read(tmp_path, document({"a": building(surface([0, 1, 2]))}, **changes))
        assert caught.value.hint

    @pytest.mark.parametrize(
        "geometry",
        [
            {"type": "Solid", "lod": "1", "boundaries": [[0, 1, 2]]},
            {"type": "MultiSurface", "lod": "1", "boundaries": 5},
            {"type": "MultiSurface", "lod": "1"},
            {"lod": "1"},
            7,
            {"type": "GeometryInstance", "template": 3, "boundaries": [0]},
            {"type": "GeometryInstance", "template": -1, "boundaries": [0]},
        ],
    )
    def test_malformed_geometry_names_the_object(self, tmp_path: Path, geometry: Any) -> None:
        with pytest.raises(CityModelError, match="geometry of Haus-1"):
            read(tmp_path, document({"Haus-1": building(geometry)}))

    @pytest.mark.parametrize(
        "ring", [[0, 1, 4], [0, 1, -1], [0, 1, 2.5], [0, 1, "2"], [0, 1, None], [0, 1, True]]
    )
    def test_bad_index(self, tmp_path: Path, ring: list[Any]) -> None:
        objects = {"Haus-1": building(surface([0, 1, 2]), surface(ring))}
        with pytest.raises(CityModelError, match=r"Haus-1"):
            read(tmp_path, document(objects))
        try:
            model = read(tmp_path, document(objects), options=ReadOptions(is_strict=False))
        except CityModelError:
            assert any(not isinstance(index, int) for index in ring)
        else:
            assert codes(model) == {"LB210": 1}
            assert len(model.polygons) == 1

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ('{"type": "CityJSON"', "not well-formed JSON"),
            ('{"a": NaN}', "NaN is no JSON number"),
            ('{"a": 1e999, "type": "CityJSON", "version": "1.1", "vertices": [[1e999,0,0]], "CityObjects": '
             '{"a": {"type": "Building"}}}', "not finite"),
            ("[" * 200_000, "nested too deeply|not well-formed"),
            (b'{"a": "\xff"}', "not UTF-8"),
            ("[1, 2]", "not CityJSON"),
        ],
    )  # fmt: skip
    def test_json(self, tmp_path: Path, text: Any, message: str) -> None:
        with pytest.raises(CityModelError, match=message):
            read(tmp_path, text)

    def test_fault_in_a_later_line_names_it(self, tmp_path: Path) -> None:
        header = json.dumps(document({}))
        with pytest.raises(CityModelError, match="line 3"):
            read(tmp_path, header + "\n\n{oops\n")

    def test_real_lone_feature(self, shared_data: Path) -> None:
        with pytest.raises(CityModelError, match="without the CityJSON line"):
            read_city_model(shared_data / "city/3dbag/503100000000296.city.jsonl")


class TestLabels:
    """Semantics that are nested otherwise than their surfaces, which nobody may lose unseen."""

    def solid(self, values: Any) -> dict[str, Any]:
        semantics = {"surfaces": [{"type": "WallSurface"}, {"type": "RoofSurface"}], "values": values}
        shell = [[[0, 1, 2, 3]], [[0, 1, 2]]]
        return {"type": "Solid", "lod": "2", "boundaries": [shell], "semantics": semantics}

    @pytest.mark.parametrize(
        ("values", "kinds", "told"),
        [
            ([[0, 1]], [1, 2], None),
            ([0, 1], [1, 2], "nested otherwise, taken in their order"),
            ([[[0], [1]]], [1, 2], "nested otherwise, taken in their order"),
            ([None], [0, 0], None),
            ([[0, None]], [1, 0], None),
            (None, [0, 0], None),
            ([[0]], [0, 0], "1 labels of 2 surfaces: none is taken"),
            ([], [0, 0], "0 labels of 2 surfaces: none is taken"),
            ([[0, 7]], [1, 0], "1 of 2 labels name no surface type"),
        ],
    )
    def test_nesting(self, tmp_path: Path, values: Any, kinds: list[int], told: str | None) -> None:
        model = read(tmp_path, document({"a": building(self.solid(values))}))
        assert model.polygons.kind.tolist() == kinds
        details = [item.detail for item in model.findings.items if item.code.code == "LB213"]
        assert (told is None and not details) or (told is not None and told in details[0])

    def test_text_is_no_vertex(self, tmp_path: Path) -> None:
        with pytest.raises(CityModelError, match="malformed vertices"):
            read(
                tmp_path,
                document({"a": building(surface([0, 1, 2, 3]))}, vertices=[["0", 0, 0], *SQUARE[1:]]),
            )


class TestAppendedSequences:
    """Several sequences in one file, as ``cat`` joins tiles."""

    def lines(self, name: str, east: float, scale: float, system: str) -> str:
        transform = {"scale": [scale] * 3, "translate": [east, 446000.0, 0.0]}
        head = document({}, transform=transform, vertices=[], metadata={"referenceSystem": system})
        vertices = (np.array(SQUARE) * (0.001 / scale)).round().astype(int).tolist()
        feature = {
            "type": "CityJSONFeature",
            "id": name,
            "CityObjects": {name: building(surface([0, 1, 2, 3]))},
            "vertices": vertices,
        }
        return "".join(json.dumps(line) + "\n" for line in (head, feature))

    def test_each_has_its_own_transform(self, tmp_path: Path) -> None:
        text = self.lines("a", 85000.0, 0.001, "urn:ogc:def:crs:EPSG::7415")
        text += self.lines("b", 86000.0, 0.01, "https://www.opengis.net/def/crs/EPSG/0/7415")
        model = read_city_model(write(tmp_path / "both.city.jsonl", text))
        points = model.polygons.points + model.origin
        assert points[:, 0].reshape(2, 4).min(axis=1).tolist() == [85000.0, 86000.0]
        assert points[:, 0].reshape(2, 4).max(axis=1).tolist() == [85004.0, 86004.0]

    def test_two_systems_are_refused(self, tmp_path: Path) -> None:
        text = self.lines("a", 85000.0, 0.001, "EPSG:7415") + self.lines("b", 185000.0, 0.001, "EPSG:31370")
        with pytest.raises(CityModelError, match="joins features in EPSG:7415 and in EPSG:31370"):
            read_city_model(write(tmp_path / "both.city.jsonl", text))


@pytest.mark.parametrize(
    ("metadata", "crs"),
    [({"crs": "EPSG:28992"}, "EPSG:28992"), ({"crs": {"epsg": 7415}}, "EPSG:7415"), ({"crs": None}, None)],
)
def test_old_names_of_systems(tmp_path: Path, metadata: dict[str, Any], crs: str | None) -> None:
    text = json.dumps(document({"b": building(surface([0, 1, 2, 3]))}, metadata=metadata))
    assert read_city_model(write(tmp_path / "old.json", text)).crs == crs


def test_a_system_that_is_no_text_is_told(tmp_path: Path) -> None:
    metadata = {"referenceSystem": {"epsg": 7415}}
    text = json.dumps(document({"b": building(surface([0, 1, 2, 3]))}, metadata=metadata))
    with pytest.raises(CityModelError, match="no text"):
        read_city_model(write(tmp_path / "odd.json", text))


@pytest.mark.parametrize(
    "metadata",
    [
        [{"title": "t", "referenceSystem": "https://www.opengis.net/def/crs/EPSG/0/32734"}],
        [{"title": "t"}, "x", {"referenceSystem": "urn:ogc:def:crs:EPSG::32734"}],
        [{"crs": {"epsg": 32734}}],
    ],
)
def test_metadata_in_a_list_name_the_system(tmp_path: Path, metadata: Any) -> None:
    transform = {"scale": [0.001] * 3, "translate": [262000.0, 6243000.0, 40.0]}
    objects = {"a": building(surface([0, 1, 2, 3]))}
    model = read(tmp_path, document(objects, metadata=metadata, transform=transform))
    assert (model.crs, codes(model)) == ("EPSG:32734", {})


@pytest.mark.parametrize(
    ("scale", "axes"), [([0, 0, 0], "x and y"), ([0.001, 0, 0.001], "y"), ([0.0, 0.001, 0.001], "x")]
)
def test_a_scale_of_zero_is_called_what_it_is(tmp_path: Path, scale: list[float], axes: str) -> None:
    transform = {"scale": scale, "translate": [85000.0, 446000.0, 0.0]}
    with pytest.raises(CityModelError, match=f"leaves nothing of {axes}: the program"):
        read(tmp_path, document({"a": building(surface([0, 1, 2, 3]))}, transform=transform))


def test_what_is_flat_needs_no_scale_of_heights(tmp_path: Path) -> None:
    transform = {"scale": [0.001, 0.001, 0], "translate": [85000.0, 446000.0, 7.0]}
    flat = document({"a": building(surface([0, 1, 2, 3]))}, transform=transform)
    assert set(read(tmp_path, flat).polygons.points[:, 2].tolist()) == {7.0}
    with pytest.raises(CityModelError, match="leaves nothing of z"):
        read(tmp_path, flat | {"vertices": [*SQUARE[:3], [0, 4000, 1000]]})


@pytest.mark.parametrize(
    ("root", "place"),
    [
        (
            {"boundingVolume": {"region": [0.2018, 0.8402, 0.2022, 0.8406, 0, 9]}},
            " at latitude 48.15, longitude 11.57",
        ),
        (
            {"boundingVolume": {"sphere": [0, 0, 0, 90]},
             "transform": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 4177000.0, 855000.0, 4727000.0, 1]},
            " at latitude 48.14, longitude 11.56",
        ),
        ({"boundingVolume": {"box": [0] * 12}}, ""),
        ({}, ""),
    ],
)  # fmt: skip
def test_a_tileset_is_named_and_its_place_told(tmp_path: Path, root: dict[str, Any], place: str) -> None:
    tileset = {"asset": {"version": "1.1"}, "geometricError": 500, "root": root}
    with pytest.raises(CityModelError) as raised:
        read(tmp_path, tileset)
    message = re.sub(r"(\.\d\d)\d+", r"\1", raised.value.message.partition("x.city.json ")[2])
    assert message == f"is a tileset of 3D Tiles{place}, no city model."
    assert ".glb" in raised.value.hint
