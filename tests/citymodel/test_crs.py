import re
from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS, Transformer

from lodbench.citymodel import read_city_model
from lodbench.citymodel.crs import crs_label, require_crs, resolve_crs
from lodbench.citymodel.derive import reproject
from lodbench.citymodel.frame import to_metres
from lodbench.citymodel.read import mesh_model
from lodbench.errors import CityModelError
from lodbench.findings import Findings

from .gml_text import box_rings, city, member, polygon, solid, solid_of, surface_members, write


def points(*rows: tuple[float, float, float]) -> np.ndarray:
    return np.array(rows, np.float64)


def convert(
    rows: np.ndarray, name: str | None, override: str | None = None
) -> tuple[np.ndarray, str | None, list[str]]:
    findings = Findings()
    metres = rows.copy()
    label = to_metres(metres, name, override, findings)
    return metres, label, [item.code.code for item in findings.items]


@pytest.mark.parametrize(
    ("rows", "name", "said", "hint"),
    [
        (points((4.0e6, 8.0e5, 4.9e6)), "urn:ogc:def:crs:EPSG::4978", "is geocentric", ""),
        (points((690953, 5335962, 500)), "EPSG:4326", "no degrees", ""),
        (np.column_stack([np.linspace(0, 250, 60)] * 3), "EPSG:4326", "no degrees", ""),
        (points((35.7, 139.5, 0), (35.71, 139.51, 9)), None, "look like degrees", "crs="),
    ],
)
def test_what_no_map_has_is_refused(rows: np.ndarray, name: str | None, said: str, hint: str) -> None:
    with pytest.raises(CityModelError, match=said) as caught:
        convert(rows, name)
    assert hint in caught.value.hint


class TestLabel:
    @pytest.mark.parametrize(
        ("name", "label"),
        [
            ("EPSG:25832", "EPSG:25832"),
            ("epsg:25832+7837", "EPSG:25832+7837"),
            ("urn:ogc:def:crs:EPSG::25832+7837", "EPSG:25832+7837"),
            ("http://www.opengis.net/def/crs/EPSG/0/25832+7837", "EPSG:25832+7837"),
            ("urn:ogc:def:crs:EPSG::25832,5783", "EPSG:25832+5783"),
            ("EPSG:25832,7837", "EPSG:25832+7837"),
            ("urn:ogc:def:crs:EPSG::7415", "EPSG:7415"),
            ("urn:ogc:def:crs:EPSG:6.12:28992", "EPSG:28992"),
            ("urn:ogc:def:crs,crs:EPSG:6.12:25833,crs:EPSG:6.12:5783", "EPSG:25833+5783"),
            ("urn:ogc:def:crs,crs:EPSG::25832,crs:EPSG::5783", "EPSG:25832+5783"),
            ("http://www.opengis.net/def/crs/EPSG/0/6697", "EPSG:6697"),
            ("https://www.opengis.net/def/crs/EPSG/0/7415", "EPSG:7415"),
            ("http://www.opengis.net/gml/srs/epsg.xml#4326", "EPSG:4326"),
            ("urn:adv:crs:ETRS89_UTM32*DE_DHHN2016_NH", "EPSG:25832+7837"),
            ("urn:adv:crs:ETRS89_UTM32*DE_DHHN2016_NH*GCG2016", "EPSG:25832+7837"),
            ("urn:adv:crs:ETRS89_UTM33*DE_DHHN92_NH", "EPSG:25833+5783"),
            ("urn:adv:crs:DE_DHDN_3GK3*DE_DHHN92_NH", "EPSG:31467+5783"),
            ("urn:adv:crs:ETRS89_UTM31", "EPSG:25831"),
            ("CH1903", "EPSG:21781+5728"),
            ("CH1903+ / LV95", "EPSG:2056+5728"),
            ("CH1903+_LV95", "EPSG:2056+5728"),
        ],
    )
    def test_known_names(self, name: str, label: str) -> None:
        assert crs_label(name)[0] == label
        assert resolve_crs(name) is not None

    def test_a_projection_that_proj_has_not_is_unknown(self) -> None:
        text = CRS.from_epsg(25832).to_wkt("WKT1_GDAL")
        assert resolve_crs(text) is not None
        assert resolve_crs(text.replace("Transverse_Mercator", "Transverse_Mercatoo")) is None

    @pytest.mark.parametrize("name", ["", "unknown", "EPSG:99999", "urn:adv:crs:MARS*X", "EPSG:5783"])
    def test_unknown_names(self, name: str) -> None:
        assert resolve_crs(name) is None
        with pytest.raises(CityModelError, match="Unknown coordinate reference system"):
            require_crs(name)


@pytest.mark.parametrize(
    ("name", "stated", "east", "north", "codes"),
    [
        ("EPSG:25832", (690953, 5335962), 690953, 5335962, []),
        ("EPSG:25832", (280847, 5657118), 280847, 5657118, []),  # at the rim of its zone
        ("EPSG:25832", (5335962, 690953), 690953, 5335962, ["LB304"]),  # north first against the declaration
        ("EPSG:31468", (4467593, 5334499), 4467593, 5334499, ["LB304"]),  # east first against it
        ("EPSG:31468", (5334499, 4467593), 4467593, 5334499, []),
        ("EPSG:3414", (28000, 38000), 28000, 38000, ["LB308"]),  # either order is plausible
        ("EPSG:7415", (3000, 5340000), 3000, 5340000, ["LB303"]),  # declared wrongly
        ("EPSG:25832", (32690953, 5335962), 690953, 5335962, ["LB306"]),  # the zone's number is put before
        ("EPSG:25833", (33392000, 5820000), 392000, 5820000, ["LB306"]),
        ("EPSG:4647", (550000, 5800000), 32550000, 5800000, ["LB306"]),  # lacks the number its system has
    ],
)
def test_axes_and_prefixes(name, stated, east, north, codes):
    metres, label, found = convert(points((*stated, 500)), name)
    assert metres.tolist() == [[east, north, 500]]
    assert (label, found) == (name, codes)


class TestDegrees:
    @pytest.mark.parametrize(
        ("latitude", "longitude", "code"),
        [
            (35.756, 139.555, 6677),  # Nishitokyo
            (43.06, 141.35, 6680),  # Sapporo
            (34.69, 135.50, 6674),  # Osaka
            (33.59, 130.40, 6670),  # Fukuoka
            (26.21, 127.68, 6683),  # Naha
            (38.27, 140.87, 6678),  # Sendai
            (35.18, 136.91, 6675),  # Nagoya
            (34.39, 132.46, 6671),  # Hiroshima
        ],
    )
    def test_japan(self, latitude: float, longitude: float, code: int) -> None:
        metres, label, codes = convert(
            points((latitude, longitude, 55)), "http://www.opengis.net/def/crs/EPSG/0/6697"
        )
        assert label == f"EPSG:{code}+6695"
        assert codes == ["LB305"]
        expected = Transformer.from_crs("EPSG:6668", f"EPSG:{code}", always_xy=True).transform(
            longitude, latitude
        )
        assert metres[0].tolist() == pytest.approx([*expected, 55], abs=1e-6)

    def test_swapped_against_the_area_of_use(self) -> None:
        _, label, codes = convert(points((139.555, 35.756, 55)), "EPSG:6697")
        assert label == "EPSG:6677+6695"
        assert codes == ["LB304", "LB305"]

    @pytest.mark.parametrize("longitude", [-122.4, -75.2])
    def test_open_city_model_writes_longitude_first(self, longitude: float) -> None:
        metres, label, codes = convert(points((longitude, 39.9, 0)), "EPSG:4979")
        assert codes == ["LB304", "LB310", "LB305"]
        assert label == f"EPSG:{32600 + int((longitude + 180) // 6) + 1}"
        assert 4.3e6 < metres[0, 1] < 4.5e6

    def test_other_datums(self) -> None:
        assert convert(points((48.1, 11.5, 0)), "EPSG:4258")[1] == "EPSG:25832"
        assert convert(points((40.7, -74.0, 0)), "EPSG:4269")[1] == "EPSG:26918"
        assert convert(points((-33.9, 151.2, 0)), "EPSG:4326")[1] == "EPSG:32756"

    def test_a_file_that_names_no_system_has_longitudes_first_where_both_may_be(self) -> None:
        metres, label, codes = convert(points((8.5, 47.3, 400)), None, "EPSG:4326")
        assert (label, codes) == ("EPSG:32632", ["LB308", "LB305"])
        assert 5.2e6 < metres[0, 1] < 5.3e6
        declared = convert(points((8.5, 47.3, 400)), "EPSG:4326")
        assert (declared[1], declared[2]) == ("EPSG:32638", ["LB305"])
        assert convert(points((48.1, 130.0, 9)), None, "EPSG:4326")[2] == ["LB305"]  # no latitude is 130

    def test_a_stray_point_and_the_antimeridian_are_degrees(self) -> None:
        osaka = np.column_stack(
            [np.linspace(34.70, 34.71, 300), np.linspace(135.50, 135.51, 300), np.zeros(300)]
        )
        convert(np.vstack([osaka, np.zeros((1, 3))]), "EPSG:4326")
        east = np.linspace(179.98, 180.02, 200)
        fiji = np.column_stack([np.full(200, -16.8), np.where(east > 180, east - 360, east), np.zeros(200)])
        convert(fiji, "EPSG:4326")


def test_two_systems_in_one_file_meet(tmp_path: Path) -> None:
    to_next = Transformer.from_crs("EPSG:25832", "EPSG:25833", always_xy=True)
    rings = [[(*to_next.transform(x, y), z) for x, y, z in ring] for ring in box_rings(x=712000.0)]
    envelope = '<gml:boundedBy><gml:Envelope srsName="EPSG:25833"/></gml:boundedBy>'
    text = city(member(solid_of(box_rings(x=712000.0))) + member(envelope + solid_of(rings), "b2"))
    model = read_city_model(write(tmp_path / "a.gml", text))
    assert model.crs == "EPSG:25832"
    assert [item.code.code for item in model.findings.items] == ["LB307"]
    first, second = np.split(model.polygons.points, 2)
    assert np.allclose(first, second, atol=1e-3)


class TestOthers:
    def test_feet_become_metres(self) -> None:
        metres, label, codes = convert(points((988000, 190000, 100)), "EPSG:2263")
        assert label == "EPSG:26918"
        assert codes == ["LB305"]
        assert metres[0, 2] == pytest.approx(30.48006, abs=1e-4)

    @pytest.mark.parametrize(
        ("east", "label"), [(683270.0, "EPSG:21781+5728"), (2683270.0, "EPSG:2056+5728")]
    )
    def test_swiss_name_on_metres(self, east: float, label: str) -> None:
        north = 247425.0 if east < 1e6 else 1247425.0
        metres, found, codes = convert(points((east, north, 400)), "CH1903")
        assert (found, codes) == (label, ["LB306"])
        assert metres[0, 0] == east

    def test_override(self) -> None:
        metres, label, codes = convert(points((3000, 340000, 180)), "EPSG:7415", "EPSG:31256")
        assert (label, codes) == ("EPSG:31256", ["LB304"])
        assert metres[0].tolist() == [3000, 340000, 180]

    @pytest.mark.parametrize(("name", "code"), [(None, "LB301"), ("nonsense", "LB302")])
    def test_missing_or_unknown(self, name: str | None, code: str) -> None:
        metres, label, codes = convert(points((1, 2, 3), (900, 800, 3)), name)
        assert (label, codes) == (None, [code])
        assert metres.tolist() == [[1, 2, 3], [900, 800, 3]]


class TestZonePrefixes:
    """EPSG:4647 and its kin put the zone number into the false easting; Germany delivers cities in them."""

    @pytest.mark.parametrize("code", [4647, 5652, 5650, 5653])
    def test_read_and_placed(self, code: int) -> None:
        zone = 32 if code in (4647, 5652) else 33
        plain, longitude = f"EPSG:{25800 + zone}", {32: 9.7, 33: 13.4}[zone]
        east, north = Transformer.from_crs("EPSG:4326", plain, always_xy=True).transform(longitude, 52.4)
        prefixed = zone * 1e6 + east
        metres, label, codes = convert(points((prefixed, north, 1), (prefixed + 9, north, 1)), f"EPSG:{code}")
        assert metres[:, :2].tolist() == [[prefixed, north], [prefixed + 9, north]]
        assert label == f"EPSG:{code}"
        assert codes in ([], ["LB304"])

    @pytest.mark.parametrize(
        ("code", "place"), [(26906, (-149.9, 61.2)), (32607, (-142.0, 64.0)), (32707, (-139.0, -21.0))]
    )
    def test_northings_that_begin_with_the_number_of_their_zone(self, code, place):
        crs = f"EPSG:{code}"
        east, north = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(*place)
        metres, _, codes = convert(points((east, north, 1), (east + 9, north, 1)), crs)
        assert metres[:, :2].tolist() == [[east, north], [east + 9, north]]
        assert codes == []


class TestScale:
    def place(self, code: int, longitude: float = 9.9, latitude: float = 52.4) -> np.ndarray:
        x, y = Transformer.from_crs("EPSG:4326", code, always_xy=True).transform(longitude, latitude)
        return points((x, y, 1), (x + 100, y, 1))

    @pytest.mark.parametrize("code", [3857, 3395, 6933])
    def test_systems_of_the_whole_world_are_projected_anew(self, code: int) -> None:
        rows = self.place(code)
        metres, label, codes = convert(rows, f"EPSG:{code}")
        assert label == "EPSG:32632"
        assert {"LB309", "LB305"} <= set(codes)
        back = Transformer.from_crs(code, 32632, always_xy=True).transform(rows[:, 0], rows[:, 1])
        assert np.allclose(metres[:, :2], np.stack(back, axis=1), atol=1e-6)

    @pytest.mark.parametrize(("code", "place"), [(3035, (-9.1, 38.7)), (3034, (10.0, 51.0))])
    def test_continental_systems_are_told(self, code: int, place: tuple[float, float]) -> None:
        findings = Findings()
        to_metres(self.place(code, *place), f"EPSG:{code}", None, findings)
        told = [item.detail for item in findings.items if item.code.code == "LB309"]
        assert len(told) == 1
        assert re.search(r"to the east is [01]\.\d{4} m", told[0])

    @pytest.mark.parametrize("code", [25832, 4647])
    def test_utm_in_its_zone_is_true(self, code: int) -> None:
        assert convert(self.place(code), f"EPSG:{code}")[2] == []

    def test_areas_of_a_city_in_web_mercator(self, tmp_path: Path) -> None:
        x, y = self.place(3857)[0, :2].tolist()
        rings = box_rings(x=x, y=y, size=16.3893)  # 10 m at 52.4 degrees north
        text = city(member(solid_of(rings)), srs="EPSG:3857")
        model = read_city_model(write(tmp_path / "a.gml", text))
        corners = model.polygons.points[:4, :2]
        edges = np.linalg.norm(np.diff(corners, axis=0), axis=1)
        assert edges == pytest.approx(10.0, rel=5e-3)


@pytest.mark.parametrize("code", [4979, 4937])
def test_ellipsoidal_heights_are_told(code: int) -> None:
    assert "LB310" in convert(points((52.4, 9.9, 90.0)), f"EPSG:{code}")[2]


def test_many_unknown_names_end_quickly(tmp_path: Path) -> None:
    members = "".join(
        member(solid_of(box_rings()), f"b{i}").replace("<gml:Solid>", f'<gml:Solid srsName="urn:nobody:{i}">')
        for i in range(2000)
    )
    with pytest.raises(CityModelError, match="more than 32 reference systems"):
        read_city_model(write(tmp_path / "a.gml", city(members)))


def test_heights_out_of_this_world_are_no_fault_of_the_plane(tmp_path: Path) -> None:
    text = city(member(solid_of(box_rings(z=4e9))))
    with pytest.raises(CityModelError, match="has 24 of 24 heights nowhere on Earth") as raised:
        read_city_model(write(tmp_path / "a.gml", text))
    assert "not at fault" in raised.value.hint


@pytest.mark.parametrize(
    "name",
    [
        "urn:ogc:def:crs,crs:EPSG::28992,crs:EPSG::5109",
        "EPSG:28992+5109",
        "urn:ogc:def:crs,crs:EPSG::99999,crs:EPSG::28992",
        "urn:ogc:def:crs,crs:EPSG::28992,crs:EPSG::99999",
    ],
)
def test_a_code_that_names_no_heights_leaves_the_plane_its_system(tmp_path: Path, name: str) -> None:
    """5109 is the datum of Amsterdam, 5709 the heights above it: the plane's system was dropped, too."""
    rings = box_rings(x=85000.0, y=447000.0)
    text = city(member(solid_of(rings)), srs=name)
    model = read_city_model(write(tmp_path / "a.gml", text))
    assert model.crs == "EPSG:28992"
    (found,) = model.findings.items
    assert found.code.code == "LB306"
    assert "names no system of heights" in found.detail


def test_two_codes_of_which_neither_is_a_plane_stay_unknown() -> None:
    assert resolve_crs("EPSG:99999+99998") is None


def test_a_building_at_zero_is_told_and_leaves_the_frame_at_the_city(tmp_path: Path) -> None:
    """The frame began at 0, 0, where float32 has a place every half metre."""
    houses = [
        member(solid_of(box_rings(x=x, y=y)), f"b{n}")
        for n, (x, y) in enumerate([(0.0, 0.0), (500000.37, 5600000.0), (500200.0, 5600100.0)])
    ]
    model = read_city_model(write(tmp_path / "a.gml", city("".join(houses))))
    assert model.origin.tolist() == [500000.0, 5600000.0, 0.0]
    assert [(f.code.code, f.object_id) for f in model.findings.items] == [("LB311", "b0")]
    easts = mesh_model(model).scene.vertices[:, 0]
    assert float(easts[easts > 0].min()) == pytest.approx(0.37, abs=1e-6)
    assert reproject(model, "EPSG:25833").origin[1] > 5e6


def test_a_file_whose_polygons_all_fall_keeps_its_system(tmp_path: Path) -> None:
    line = "<gml:posList>500000 5600000 0 500001 5600000 0 500000 5600000 0</gml:posList>"
    model = read_city_model(write(tmp_path / "a.gml", city(member(solid(surface_members([polygon(line)]))))))
    assert model.crs == "EPSG:25832"
    assert model.findings.counts() == {"LB101 RING_TOO_SHORT": 1}
    assert not model.findings.has_errors()  # it had no area that could be lost


@pytest.mark.parametrize(("code", "longitude", "latitude"), [(2048, 18.42, -33.92), (5513, 14.42, 50.09)])
@pytest.mark.parametrize("is_swapped", [False, True])
def test_westings_and_southings_become_eastings_and_northings(code, longitude, latitude, is_swapped):
    degrees = np.array([(longitude, latitude), (longitude + 1e-3, latitude), (longitude, latitude + 1e-3)])
    declared = Transformer.from_crs(4326, code).transform(degrees[:, 1], degrees[:, 0])
    rows = np.column_stack([*(declared[::-1] if is_swapped else declared), np.zeros(3)])
    metres, label, found = convert(rows, f"EPSG:{code}")
    assert label not in (None, f"EPSG:{code}")
    back = Transformer.from_crs(label, 4326, always_xy=True).transform(metres[:, 0], metres[:, 1])
    assert np.abs(np.stack(back, axis=1) - degrees).max() < 1e-5
    assert metres[1, 0] > metres[0, 0] + 50
    assert metres[2, 1] > metres[0, 1] + 100
    assert found == (["LB304", "LB305"] if is_swapped else ["LB305"])


def test_a_system_to_the_west_is_no_target(tmp_path: Path) -> None:
    model = read_city_model(write(tmp_path / "c.gml", city(member(solid_of(box_rings())))))
    with pytest.raises(CityModelError, match="east and north"):
        reproject(model, "EPSG:5513")


@pytest.mark.parametrize("nameless", ["a.gml", "c.gml"])
def test_a_tile_without_a_system_takes_none_from_the_others(tmp_path: Path, nameless: str) -> None:
    def tile(x: float, srs: str | None) -> str:
        return city(member(solid_of(box_rings(x=x))), srs=srs)

    write(tmp_path / nameless, tile(500000.0, None))
    write(tmp_path / "b1.gml", tile(500100.0, "EPSG:25832"))
    write(tmp_path / "b2.gml", tile(100000.0, "EPSG:25833"))
    model = read_city_model(tmp_path)
    assert model.crs == "EPSG:25832"
    zone_33 = Transformer.from_crs(25833, 25832, always_xy=True).transform(100000.0, 5600000.0)
    assert (model.polygons.points + model.origin)[:, 0].max() == pytest.approx(
        max(500110.0, zone_33[0]), abs=20
    )
    assert {"LB301", "LB307"} <= {item.code.code for item in model.findings.items}


def test_heights_of_a_second_system_are_told_to_stay(tmp_path: Path) -> None:
    rings = surface_members(map(polygon, box_rings()))
    other = solid(rings).replace("<gml:Solid>", '<gml:Solid srsName="EPSG:25832+5783">')
    model = read_city_model(
        write(tmp_path / "c.gml", city(member(solid(rings)) + member(other, "b2"), srs="EPSG:25832+7837"))
    )
    details = [item.detail for item in model.findings.items if item.code.code == "LB307"]
    assert details == ["EPSG:25832+5783 brought to EPSG:25832+7837; its heights stay as they are"]
