"""Which buildings stand at a date, whose surfaces those of extensions and storeys are."""

from pathlib import Path

import pytest

from lodbench.citymodel import ReadOptions, city_info, mesh_model, read_city_model
from lodbench.citymodel import attributes as module
from lodbench.citymodel.attributes import date_in
from lodbench.citymodel.cache import load_city, open_cached_city
from lodbench.citymodel.convert import convert_city
from lodbench.citymodel.model import CityModel
from lodbench.errors import CityModelError, ConfigError

from .gml_text import (
    bounded_by,
    box_area,
    box_rings,
    city,
    codes,
    member,
    multi_surface,
    polygon,
    solid_of,
    surface_members,
    write,
)
from .test_cityjson import building, document, read, surface


def box(height: float, content: str = "", building_id: str = "b") -> str:
    shape = solid_of(box_rings(height=height), lod=2)
    return member(content + shape, building_id)


def core(**days: str) -> str:
    return "".join(f"<core:{name}>{day}</core:{name}>" for name, day in days.items())


def two_buildings(
    tmp_path: Path, old: str, new: str = "", date: str | None = "2020-01-01", **options: str
) -> CityModel:
    text = city(box(40.0, old, "old") + box(10.0, new, "new"), **options)
    return read_city_model(write(tmp_path / "a.gml", text), options=ReadOptions(date=date))


@pytest.mark.parametrize(
    "days",
    [
        core(creationDate="1970-01-01", terminationDate="2015-06-30"),
        core(validTo="2015-06-30T00:00:00"),
        core(validFrom="1970-01-01", validTo="2015-06-30T12:00:00+02:00"),
        "<bldg:yearOfDemolition>2015</bldg:yearOfDemolition>",
        "<con:dateOfDemolition xmlns:con='http://www.opengis.net/citygml/construction/3.0'>2015-06-30"
        "</con:dateOfDemolition>",
        core(validFrom="2031-01-01"),
    ],
)
@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_what_ended_or_has_not_begun_is_left_out_and_counted(tmp_path, days, version):
    model = two_buildings(tmp_path, days, core(creationDate="2016-01-01"), version=version)
    assert model.building_ids == ("new",)
    assert codes(model) == {"LB412": 1}
    assert float(model.polygons.points[:, 2].max()) == 60.0


@pytest.mark.parametrize(
    ("day", "ids", "found"),
    [
        ("2015-06-29", ("old", "new"), {"LB413": 1}),
        ("2015-06-30", ("new",), {"LB412": 1, "LB413": 1}),
        (None, ("new",), {"LB412": 1}),
    ],
)
def test_the_day_counts_and_a_creation_date_only_informs(tmp_path, day, ids, found):
    model = two_buildings(tmp_path, core(terminationDate="2015-06-30"), core(creationDate="2016-01-01"), day)
    assert model.building_ids == ids
    assert codes(model) == found


@pytest.mark.parametrize("day", ["9999-12-31", "soon", "2015-02-30", ""])
def test_what_is_no_end_ends_nothing(tmp_path, day):
    model = two_buildings(tmp_path, core(terminationDate=day))
    assert (model.building_ids, model.period, codes(model)) == (("old", "new"), None, {})


def test_a_part_that_ended_goes_and_its_building_stays(tmp_path):
    part = solid_of(box_rings(x=500010.0, height=40.0), lod=2)
    inner = f"<bldg:consistsOfBuildingPart><bldg:BuildingPart gml:id='p'>{core(terminationDate='2015-01-01')}"
    text = city(box(10.0, f"{inner}{part}</bldg:BuildingPart></bldg:consistsOfBuildingPart>"))
    options = ReadOptions(has_details=True)
    model = read_city_model(write(tmp_path / "a.gml", text), options=options)
    assert (model.num_parts, len(model.polygons), codes(model)) == (0, 6, {"LB412": 1})
    assert model.solids is not None
    assert len(model.solids.part) == 1


@pytest.mark.parametrize(
    "attributes", [{"terminationDate": "2015-06-30"}, {"validTo": "2015-06-30"}, {"yearOfDemolition": 2014}]
)
def test_cityjson_says_it_in_attributes(tmp_path, attributes):
    shape = surface([0, 1, 2, 3])
    part = {"type": "BuildingPart", "geometry": [shape], "parents": ["old"]}
    old = building(shape, attributes=attributes, children=["p"])
    objects = {"old": old, "p": part, "new": building(shape, attributes={"creationDate": "2016-01-01"})}
    model = read(tmp_path, document(objects), options=ReadOptions(date="2020-01-01"))
    assert (model.building_ids, codes(model)) == (("new",), {"LB412": 1})
    before = read(tmp_path, document(objects), options=ReadOptions(date="2010-01-01"))
    assert before.building_ids == ("old", "new")


def test_a_city_of_which_nothing_stands_says_so(tmp_path):
    text = city(box(40.0, core(terminationDate="2015-06-30")))
    with pytest.raises(CityModelError, match="no building that exists on 2020-01-01; 1 ended") as raised:
        read_city_model(write(tmp_path / "a.gml", text), options=ReadOptions(date="2020-01-01"))
    assert "date=YYYY-MM-DD" in raised.value.hint


@pytest.mark.parametrize("day", ["30.6.2015", "2015", "20150630", "2015-13-01"])
def test_a_date_is_a_day(day):
    with pytest.raises(ConfigError, match="is not a date"):
        ReadOptions(date=day)


def test_a_date_means_nothing_to_a_mesh(tmp_path):
    path = write(tmp_path / "a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert codes(read_city_model(path, options=ReadOptions(date="2020-01-01"))) == {"LB411": 1}


def test_what_is_stored_tells_the_days_it_holds_for(tmp_path, monkeypatch):
    """The cache reads a city anew on the first day on which another house stands, and no sooner."""
    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path / "cache"))
    text = city(
        box(40.0, core(terminationDate="2015-06-30"), "old")
        + box(10.0, core(terminationDate="2031-05-01"), "new")
        + box(5.0, building_id="always")
    )
    path = write(tmp_path / "a.gml", text)
    monkeypatch.setattr(module, "today", lambda: "2026-01-01")
    found = open_cached_city(path)
    assert found.period == ("2015-06-30", "2031-05-01")
    assert found.scene.building_ids == ("new", "always")
    monkeypatch.setattr(module, "today", lambda: "2031-04-30")
    assert open_cached_city(path).scene.stored_digest  # of the cache
    monkeypatch.setattr(module, "today", lambda: "2031-05-01")
    later = open_cached_city(path)
    assert later.scene.building_ids == ("always",)
    assert later.period is not None
    assert date_in(later.period) == "2031-05-01"
    again = open_cached_city(path, options=ReadOptions(date=date_in(found.period)))
    assert again.scene.digest() == found.scene.digest()
    convert_city(read_city_model(path), tmp_path / "a.scene", options=ReadOptions())
    assert load_city(tmp_path / "a.scene").period == later.period
    assert any("as it stood on 2031-05-01" in note for note in later.notes())


def test_a_city_without_ends_has_no_period(tmp_path):
    model = two_buildings(tmp_path, core(creationDate="1970-01-01"))
    assert (model.period, codes(model)) == (None, {})


ENERGY = 'xmlns:energy="http://www.sig3d.org/citygml/2.0/energy/1.0"'


@pytest.mark.parametrize("lod", [2, 3])
@pytest.mark.parametrize("holder", ["{}", "<bldg:adeOfAbstractBuilding>{}</bldg:adeOfAbstractBuilding>"])
@pytest.mark.parametrize("has_details", [False, True])
def test_surfaces_in_a_property_of_an_extension_are_not_the_building_s(tmp_path, lod, holder, has_details):
    """Thermal zones were drawn as the building: a box without a roof, 9 m too low, at its finest level."""
    own = "".join(
        bounded_by("WallSurface", multi_surface(surface_members([polygon(ring)]))) for ring in box_rings()
    )
    inner = "".join(
        bounded_by("WallSurface", multi_surface(surface_members([polygon(ring)]), lod))
        for ring in box_rings(x=500002.0, size=2.0, height=1.0)
    ).replace("bldg:boundedBy", "energy:thermalBoundary")
    room = f"<energy:Zone>{inner}{solid_of(box_rings(z=0.0), lod)}</energy:Zone>"
    zone = f"<energy:thermalZone {ENERGY}>{room}</energy:thermalZone>"
    path = write(tmp_path / "a.gml", city(member(own + holder.format(zone))))
    model = read_city_model(path, options=ReadOptions(has_details=has_details))
    assert (model.lods, len(model.polygons)) == (("2",), 6)
    assert mesh_model(model, "finest").area_m2 == pytest.approx(box_area())
    assert codes(model) == {"LB209": 1}
    assert model.solids is None or len(model.solids.part) == 0


def test_an_object_of_an_extension_in_a_property_of_citygml_is_a_boundary(tmp_path):
    roof = multi_surface(surface_members(map(polygon, box_rings())))
    text = f"<bldg:boundedBy><energy:Roof {ENERGY}>{roof}</energy:Roof></bldg:boundedBy>"
    model = read_city_model(write(tmp_path / "a.gml", city(member(text))))
    assert (len(model.polygons), codes(model)) == (6, {})


def test_objects_of_extensions_in_cityjson_are_no_surfaces_either(tmp_path):
    shape = surface([0, 1, 2, 3])
    objects = {
        "b": building(shape, children=["z", "p"]),
        "z": {"type": "+ThermalZone", "geometry": [shape], "parents": ["b"], "children": ["r"]},
        "r": {"type": "BuildingRoom", "geometry": [shape], "parents": ["z"]},
        "p": {"type": "+NoiseBuildingPart", "geometry": [surface([0, 1, 2])], "parents": ["b"]},
    }
    model = read(tmp_path, document(objects))
    assert (len(model.polygons), codes(model)) == (2, {"LB209": 1})


def storey(rings: list, lod: int = 2, name: str = "Storey") -> str:
    shape = solid_of(rings, lod)
    return (
        f"<bldg:buildingSubdivision><bldg:{name} gml:id='s'>{shape}</bldg:{name}></bldg:buildingSubdivision>"
    )


@pytest.mark.parametrize("name", ["Storey", "BuildingUnit"])
@pytest.mark.parametrize(("lod", "area"), [(2, box_area(height=20.0)), (3, box_area())])
def test_storeys_are_the_inside_where_the_building_has_an_outside(tmp_path, name, lod, area):
    inner = storey(box_rings(height=6.0), lod, name)
    model = read_city_model(write(tmp_path / "a.gml", city(box(20.0, inner), version="3.0")))
    assert mesh_model(model, str(lod)).area_m2 == pytest.approx(area)
    skipped = city_info(model)["findings"].get("LB404 INTERIOR_SKIPPED", 0)
    assert skipped == (1 if lod == 2 else 0)  # at a level of its own the storey is all there is


def test_storeys_of_cityjson_too(tmp_path):
    shape, lower = surface([0, 1, 2, 3]), surface([0, 1, 2])
    objects = {
        "b": building(shape, children=["s"]),
        "s": {"type": "BuildingStorey", "geometry": [lower], "parents": ["b"]},
        "c": {"type": "Building", "children": ["t"]},
        "t": {"type": "BuildingUnit", "geometry": [lower], "parents": ["c"]},
    }
    mesh = mesh_model(read(tmp_path, document(objects)))
    assert mesh.area_m2 == pytest.approx(16.0 + 8.0)
    assert mesh.findings.counts() == {"LB404 INTERIOR_SKIPPED": 1}
