"""CityGML files as a whole: refused in one line, levels, ids, what is skipped."""

from pathlib import Path

import numpy as np
import pytest

from lodbench.citymodel import city_info, mesh_city, mesh_model, open_scene, read_city_model
from lodbench.citymodel.convert import convert_city
from lodbench.citymodel.options import ReadOptions
from lodbench.errors import CityModelError

from .gml_text import (
    bounded_by,
    box_area,
    box_city,
    box_rings,
    city,
    codes,
    member,
    model_of,
    multi_surface,
    polygon,
    solid,
    solid_of,
    surface_members,
    write,
)

BOX = box_rings()
# As Spain's cadastre publishes buildings.
_INSPIRE = (
    b'<gml:FeatureCollection xmlns:gml="http://www.opengis.net/gml/3.2" '
    b'xmlns:bu-ext2d="http://inspire.jrc.ec.europa.eu/schemas/bu-ext2d/2.0"><gml:featureMember>'
    b'<bu-ext2d:Building gml:id="a"/></gml:featureMember></gml:FeatureCollection>'
)


class TestFiles:
    @pytest.mark.parametrize(
        ("content", "message"),
        [
            (b"", "is empty"),
            (b"  \n", "is empty"),
            (b"<a/>", "root element is <a>"),
            (b"<CityModel/>", "names nothing of CityGML"),
            (_INSPIRE, "names nothing of CityGML"),
            (city("").encode(), "no buildings"),
            (b"\x89PNG\r\n", "no city model that lodbench can read"),
            (b"hello world", "no city model"),
            (box_city().encode()[:900], "not well-formed"),
            (b'<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]><a>&x;</a>', "DOCTYPE"),
        ],
    )
    def test_refusals(self, tmp_path: Path, content: bytes, message: str) -> None:
        with pytest.raises(CityModelError, match=message) as caught:
            read_city_model(write(tmp_path / "x.gml", content))
        assert caught.value.hint

    def test_missing_file_and_folder(self, tmp_path: Path) -> None:
        with pytest.raises(CityModelError, match="There is no city model"):
            read_city_model(tmp_path / "nowhere.gml")

    def test_path_with_spaces_umlauts_and_signs(self, tmp_path: Path) -> None:
        assert open_scene(write(tmp_path / "Stadt (Köln), a=b.gml", box_city())).num_buildings == 1

    def test_absent_level_names_the_levels(self, tmp_path: Path) -> None:
        path = write(tmp_path / "x.gml", box_city())
        with pytest.raises(CityModelError, match="level of detail 2; the file has: 1"):
            open_scene(path, lod="2")

    def test_building_without_the_level_is_a_finding(self, tmp_path: Path) -> None:
        faces = surface_members(map(polygon, BOX))
        text = city(member(solid(faces)) + member(solid(faces, 2), "b2") + member("", "b3"))
        model = model_of(tmp_path, text)
        assert codes(model) == {"LB403": 1}
        mesh = mesh_model(model)
        assert mesh.scene.lod == "1"
        assert [item.object_id for item in mesh.findings.items] == ["b2", "b3"]

    def test_empty_property_and_other_objects(self, tmp_path: Path) -> None:
        other = "<core:cityObjectMember><bldg:Tree/></core:cityObjectMember>" * 3
        text = city(other + member("<bldg:lod4MultiSurface/>" + solid_of(BOX)))
        model = model_of(tmp_path, text)
        assert codes(model) == {"LB207": 1, "LB209": 1}

    def test_an_empty_level_is_none(self, tmp_path: Path) -> None:
        walls = bounded_by("WallSurface", multi_surface(surface_members(map(polygon, BOX))))
        model = model_of(tmp_path, city(member("<bldg:lod1Solid/>" + walls)))
        assert (model.lods, model.polygons_read) == (("2",), (6,))
        assert mesh_city(model).lod == "2"
        assert codes(model) == {"LB207": 1}

    def test_a_polygon_without_a_ring_is_told_and_shifts_no_other(self, tmp_path: Path) -> None:
        faces = [*map(polygon, BOX[:2]), "<gml:Polygon/>", *map(polygon, BOX[2:])]
        model = model_of(tmp_path, city(member(solid(surface_members(faces)))))
        assert np.diff(model.polygons.polygon_starts).tolist() == [1] * 6
        assert model.polygons_read == (7,)
        assert codes(model) == {"LB101": 1}
        assert mesh_model(model).meshed_m2 == pytest.approx(box_area())

    def test_info(self, tmp_path: Path) -> None:
        info = city_info(model_of(tmp_path, box_city()))
        assert info["lods"]["1"]["polygons"] == 6
        assert info["lods"]["1"]["triangles"] == 12
        assert info["lods"]["1"]["area_m2"] == pytest.approx(box_area())
        assert info["extent_m"] == [10, 10, 6]
        assert info["findings"] == {}

    def test_same_bytes_same_scene(self, tmp_path: Path) -> None:
        scenes = [mesh_city(model_of(tmp_path, box_city())) for _ in range(2)]
        assert scenes[0].digest() == scenes[1].digest()


class TestIds:
    def test_two_buildings_of_one_id_stay_two(self, tmp_path: Path) -> None:
        text = city(member(solid_of(BOX)) + member(solid_of(box_rings(x=500020.0))))
        model = model_of(tmp_path, text)
        assert model.building_ids == ("b1", "b1~2")
        assert codes(model) == {"LB205": 1}
        convert_city(model, tmp_path / "a.json")
        assert read_city_model(tmp_path / "a.json").building_ids == ("b1", "b1~2")

    @pytest.mark.parametrize("has_details", [False, True])
    def test_a_building_inside_of_another_is_one_of_its_own(self, tmp_path: Path, has_details: bool) -> None:
        boxes = [solid_of(box_rings(x=500000.0 + 50 * n)) for n in range(2)]
        inner = f'<bldg:Building gml:id="in">{boxes[1]}</bldg:Building>'
        inner = f"<core:generalizesTo>{inner}</core:generalizesTo>"
        options = ReadOptions(has_details=has_details)
        model = model_of(tmp_path, city(member(inner + boxes[0])), options=options)
        assert model.building_ids == ("b1", "in")
        assert np.bincount(model.polygons.building).tolist() == [6, 6]
        assert model.solids is None or model.solids.part.tolist() == [0, 1]


class TestHeights:
    @pytest.mark.parametrize(
        ("unit", "name", "metres"),
        [("m", "", 20.0), ("#m", "", 20.0), ("urn:adv:uom:m", "", 20.0), ("cm", "", 0.2),
         ("[ft_i]", "", 6.096), ("urn:ogc:def:uom:EPSG::9003", "", 20 * 1200 / 3937), ("ell", "_ell", 20.0)],
    )  # fmt: skip
    def test_are_in_metres(self, tmp_path: Path, unit: str, name: str, metres: float) -> None:
        heights = f'<bldg:measuredHeight uom="{unit}">20</bldg:measuredHeight>'
        heights += f'<bldg:storeyHeightsAboveGround uom="{unit}">20 20</bldg:storeyHeightsAboveGround>'
        model = model_of(tmp_path, city(member(heights)), options=ReadOptions(has_details=True))
        assert model.objects is not None
        told = model.objects.attributes[0]
        assert told[f"measuredHeight{name}"] == pytest.approx(metres)
        assert told[f"storeyHeightsAboveGround{name}"] == pytest.approx([metres, metres])

    def test_of_several_the_overall_one_is_the_measured_height(self, tmp_path: Path) -> None:
        heights = "".join(
            f"<con:height><con:Height><con:highReference>{high}</con:highReference>"
            "<con:lowReference>lowestGroundPoint</con:lowReference><con:status>measured</con:status>"
            f'<con:value uom="m">{value}</con:value></con:Height></con:height>'
            for high, value in (("lowestEave", 4), ("highestRoofEdge", 6))
        )
        text = city(member(heights), version="3.0").replace(
            "xmlns:uro=", 'xmlns:con="http://www.opengis.net/citygml/construction/3.0" xmlns:uro=', 1
        )
        model = model_of(tmp_path, text, options=ReadOptions(has_details=True))
        assert model.objects is not None
        told = model.objects.attributes[0]
        assert (told["measuredHeight"], told["height"]["Height"]["value"]) == (6.0, 4.0)


@pytest.mark.parametrize("module", ["", "building/"])
def test_citygml_of_before_the_standard_is_named(tmp_path: Path, module: str) -> None:
    text = f"<CityModel xmlns='http://www.citygml.org/citygml/{module}1/0/0'><cityObjectMember/></CityModel>"
    with pytest.raises(CityModelError, match=r"is CityGML 0\.4 or older"):
        read_city_model(write(tmp_path / "a.gml", text))


def test_profiles_of_that_address_are_of_the_standard(tmp_path: Path) -> None:
    profile = "xmlns:pfx0='http://www.citygml.org/citygml/profiles/base/2.0' xmlns:gml"
    text = box_city().replace("xmlns:gml", profile)
    assert read_city_model(write(tmp_path / "a.gml", text)).version == "2.0"
