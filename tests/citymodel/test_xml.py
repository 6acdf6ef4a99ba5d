"""Surfaces taken out of the bytes of CityGML: the same city comes out as from the parser alone."""

import io
import random
from dataclasses import fields

import numpy as np
import pytest

from lodbench.citymodel.gml import folding, xml
from lodbench.citymodel.gml.reader import read_citygml
from lodbench.citymodel.gml.xml import XmlMembers, local_name, namespace_of
from lodbench.citymodel.options import LAYERS, ReadOptions
from lodbench.errors import CityModelError
from lodbench.findings import Findings
from tests.citymodel.gml_text import city, member, multi_surface, polygon, solid, surface_members


def names(data: bytes, findings: Findings | None = None) -> list[str]:
    members = XmlMembers(io.BytesIO(data), "f.gml", ("m",), findings or Findings())
    return [element[0].tag if len(element) else "" for element in members]


def bomb() -> bytes:
    entities = b"".join(
        b'<!ENTITY e%d "%s">' % (i, (b"&e%d;" % (i - 1)) * 10 if i else b"lol") for i in range(12)
    )
    return b"<!DOCTYPE a [" + entities + b"]><a><m>&e11;</m></a>"


XXE = b'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]><a><m>&x;</m></a>'


class TestMembers:
    def test_yields_members_in_order(self) -> None:
        assert names(b"<a><m><b/></m><n><m><x/></m></n><m><c/></m></a>") == ["b", "c"]

    def test_members_below_a_wrapped_city_model_count(self) -> None:
        assert names(b"<wfs><CityModel><m><b/></m></CityModel></wfs>") == ["b"]

    def test_root_is_known_without_members(self) -> None:
        members = XmlMembers(io.BytesIO(b"<a/>"), "f", ("m",), Findings())
        assert list(members) == []
        assert members.root is not None
        assert members.root.tag == "a"

    def test_frees_members(self) -> None:
        data = b"<a>" + (b"<m>" + b"<b/>" * 10_000 + b"</m>") * 20 + b"</a>"
        members = XmlMembers(io.BytesIO(data), "f", ("m",), Findings())
        sizes = [len(members.root) for _ in members if members.root is not None]
        assert len(sizes) == 20
        assert max(sizes) <= 4

    def test_byte_order_mark_and_declared_encodings(self) -> None:
        assert names(b"\xef\xbb\xbf<a><m><b/></m></a>") == ["b"]
        text = '<?xml version="1.0" encoding="{}"?><a><m><b/>äß</m></a>'
        for encoding in ("cp1252", "iso-8859-15", "utf-16"):
            assert names(text.format(encoding).encode(encoding)) == ["b"]

    def test_large_text_is_read(self) -> None:
        assert names(b"<a><m><b/>" + b"1 " * 6_000_000 + b"</m></a>") == ["b"]


class TestRefusals:
    @pytest.mark.parametrize(
        "data",
        [
            XXE,
            bomb(),
            bomb().decode().encode("utf-16"),
            b'<!DOCTYPE a SYSTEM "http://127.0.0.1/x.dtd"><a><m/></a>',
            b"<!-- c --><?pi?><!DOCTYPE a><a/>",
            b'<?xml version="1.0"?>' + b" " * 70_000 + b'<!DOCTYPE a [<!ENTITY x "1">]><a><m>&x;</m></a>',
        ],
        ids=["external", "bomb", "bomb-utf16", "remote-dtd", "plain", "late"],
    )
    def test_any_doctype(self, data: bytes) -> None:
        with pytest.raises(CityModelError, match="DOCTYPE"):
            names(data)

    @pytest.mark.parametrize(
        ("data", "message"),
        [
            (b"", "is empty"),
            (b"hello", "not well-formed"),
            (b"<a><m></a>", "line 1"),
            (b"<a><m/>\n<m>", "line 2"),
            (b"<a>" * 3000, "depth"),
            (b"<a><m>&x;</m></a>", "not well-formed"),
        ],
        ids=["empty", "text", "mismatch", "truncated", "deep", "entity"],
    )
    def test_malformed(self, data: bytes, message: str) -> None:
        with pytest.raises(CityModelError, match=message):
            names(data)

    def test_wrong_bytes_name_line_and_place(self) -> None:
        with pytest.raises(CityModelError, match=r"line 2.*byte") as caught:
            names(b'<?xml version="1.0" encoding="UTF-8"?>\n<a><m>\xff\xfe</m></a>')
        assert "encoding" in caught.value.hint

    @pytest.mark.parametrize("behind", [0, 40_000], ids=["one-chunk", "many-chunks"])
    def test_an_undefined_entity_is_the_reason(self, behind: int) -> None:
        data = b"<a>\n<m>&foo;</m>" + b"<m>x</m>" * behind + b"</a>"
        with pytest.raises(CityModelError, match=r"line 2, .*Entity 'foo' not defined") as caught:
            names(data)
        assert caught.value.hint == "City models need no entities."

    def test_an_undeclared_prefix_before_an_undefined_entity(self) -> None:
        data = b"<a><m><q:x/></m>" + b"<m>x</m>" * 20_000 + b"<m>&foo;</m>" + b"<m>x</m>" * 20_000 + b"</a>"
        with pytest.raises(CityModelError, match="Entity 'foo' not defined"):
            names(data)

    def test_the_entities_of_xml_itself_are_read(self) -> None:
        assert names(b"<a><m><b/>&amp;&lt;&#228;</m></a>") == ["b"]

    def test_a_mere_warning_is_no_fault(self) -> None:
        assert names(b'<a xmlns:r="relative"><m><b/></m>' + b"<m><b/></m>" * 10_000 + b"</a>")[0] == "b"

    def test_oversized_member(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("lodbench.citymodel.gml.xml._MAX_MEMBER_BYTES", 100_000)
        with pytest.raises(CityModelError, match="larger than"):
            names(b"<a><m>" + b"1 " * 200_000 + b"</m></a>")


class TestUndeclaredPrefix:
    def test_is_a_finding(self) -> None:
        findings = Findings()
        assert names(b"<a><m><b/><q:x/></m></a>", findings) == ["b"]
        assert findings.counts() == {"LB201 UNDECLARED_PREFIX": 1}

    def test_does_not_hide_a_cut(self) -> None:
        with pytest.raises(CityModelError, match="not well-formed"):
            names(b"<a><m><q:x/></m><m>")


def test_tag_parts() -> None:
    assert local_name("{urn:x}b") == "b"
    assert local_name("b") == "b"
    assert namespace_of("b") == ""


@pytest.mark.parametrize("gap", ["", "\n", "\n\n  "])
@pytest.mark.parametrize("label", ["UTF-16", "utf-16le", "UTF-32"])
def test_single_bytes_that_call_themselves_wide(label: str, gap: str) -> None:
    text = f'<?xml version="1.0" encoding="{label}"?>{gap}<a><m><b/></m></a>'
    with pytest.raises(CityModelError, match="not well-formed") as fault:
        names(text.encode())
    assert "not in the encoding" in fault.value.hint


TRIANGLES = [[(n, 0.0, 0.0), (n + 1, 0.5, 0.0), (n, 0.0, 2.5)] for n in range(4)]
LOOSE = surface_members(polygon(each) for each in TRIANGLES)
NAMED = surface_members(polygon(each, gml_id=f"p{n}") for n, each in enumerate(TRIANGLES))


def wall(inside: str, name: str = "WallSurface", lod: int = 2) -> str:
    return (
        f'<bldg:boundedBy><bldg:{name} gml:id="w{len(inside)}">'
        "<core:creationDate>2020-12-18</core:creationDate>\n"
        f"{multi_surface(inside, lod)}</bldg:{name}></bldg:boundedBy>\n"
    )


WALLS = "".join(
    wall(surface_members([polygon(each, gml_id=f"p{n}")]), name)
    for n, (each, name) in enumerate(
        zip(TRIANGLES, ("WallSurface", "RoofSurface", "GroundSurface", "OuterFloorSurface"), strict=True)
    )
)
LINKED = f'<bldg:boundedBy xlink:href="#w{WALLS.split(chr(34))[1][1:]}"/>'
LINKS = "".join(f'<gml:surfaceMember xlink:href="#p{n}"/>' for n in range(4))
PART = (
    '<bldg:consistsOfBuildingPart><bldg:BuildingPart gml:id="part">{}</bldg:BuildingPart>'
    "</bldg:consistsOfBuildingPart>"
)
PLAIN = {
    "a solid": member(solid(LOOSE)),
    "a solid with ids": member(solid(NAMED)),
    "walls, and a solid that borrows them": member(solid(LINKS, 2) + WALLS),
    "walls of a part": member(PART.format(WALLS) + solid(LOOSE)),
    "a building without surfaces between two": member(solid(LOOSE)) + member("", "b2") + member(WALLS, "b3"),
    "an extension with a solid": member(f"{solid(LOOSE)}<uro:other>{solid(LOOSE)}</uro:other>"),
    "dimensions": member(solid(LOOSE.replace("<gml:posList>", '<gml:posList srsDimension="3">', 2))),
    "a surface turned round": member(
        multi_surface(f'<gml:surfaceMember><gml:OrientableSurface orientation="-"><gml:baseSurface>'
                      f"<gml:CompositeSurface>{LOOSE}</gml:CompositeSurface></gml:baseSurface>"
                      "</gml:OrientableSurface></gml:surfaceMember>")
    ),
    "the dimension around": member(multi_surface(LOOSE, attributes=' srsDimension="3"')),
}  # fmt: skip
ODD = {
    "a hole": solid(LOOSE + surface_members([polygon(TRIANGLES[0], [TRIANGLES[1]])])),
    "a comment in a row": solid(LOOSE.replace("</gml:surfaceMember>", "</gml:surfaceMember><!-- -->", 1)),
    "a comment in a list": solid(LOOSE.replace("<gml:posList>", "<gml:posList><!-- <gml:posList>-->", 1)),
    "characters by number": solid(LOOSE.replace("0.5", "0&#46;5")),
    "a number that is none": solid(LOOSE.replace("0.5", "0,5")),
    "a separator of ours": solid(LOOSE.replace("0.5", ";", 1)),
    "a form feed": solid(LOOSE.replace("0.5", "\x0c0.5", 1)),
    "an entity": solid(LOOSE.replace("0.5", "&half;", 1)),
    "text of another script": solid(LOOSE.replace("0.5", "\u0663", 1)),
    "a tag that does not end": solid(LOOSE).replace("</gml:posList>", "", 1),
    "an undeclared prefix": solid(LOOSE) + "<foo:a>1</foo:a>",
    "a reference system of its own": multi_surface(LOOSE, attributes=' srsName="EPSG:25833"'),
    "links to walls": LINKED + WALLS,
    "links to what holds polygons": solid('<gml:surfaceMember xlink:href="#c"/>')
    + multi_surface(surface_members([f'<gml:CompositeSurface gml:id="c">{LOOSE}</gml:CompositeSurface>'])),
    "twice the same id": WALLS + WALLS,
    "walls of no CityGML": WALLS.replace("bldg:", "uro:"),
    "a wall in an extension": f"<uro:other>{WALLS}</uro:other>" + solid(LOOSE),
    "a polygon of an ignored object": solid(NAMED)
    + "</bldg:Building></core:cityObjectMember><core:cityObjectMember><uro:Tree>"
    + LOOSE.replace("0.5", "&half;", 1)
    + "</uro:Tree></core:cityObjectMember><core:cityObjectMember><bldg:Building>"
    + solid(LOOSE),
}  # fmt: skip


def result(data: bytes, **options: object) -> object:
    try:
        raw = read_citygml(lambda: io.BytesIO(data), "city.gml", ReadOptions(**options))  # type: ignore[arg-type]
    except CityModelError as error:
        return str(error), error.hint
    values = {each.name: getattr(raw, each.name) for each in fields(raw)}
    values["findings"] = [str(item) for item in raw.findings.items]
    return {
        name: (value.dtype.str, value.tolist()) if isinstance(value, np.ndarray) else repr(value)
        for name, value in values.items()
    }


def both(data: bytes, monkeypatch: pytest.MonkeyPatch, **options: object) -> tuple[object, object]:
    folded = result(data, **options)
    with monkeypatch.context() as patch:
        patch.setattr(folding, "_is_single_bytes", lambda head: False)
        return folded, result(data, **options)


@pytest.mark.parametrize("chunk_bytes", [1 << 16, 333])
@pytest.mark.parametrize("name", PLAIN)
def test_what_is_folded_is_the_same_city(name, chunk_bytes, monkeypatch):
    monkeypatch.setattr(xml, "_CHUNK_BYTES", chunk_bytes)
    folded, plain = both(city(PLAIN[name]).encode(), monkeypatch)
    assert folded == plain
    assert isinstance(folded, dict)
    assert len(folded["building"][1]) >= 4


@pytest.mark.parametrize("is_strict", [True, False])
@pytest.mark.parametrize("chunk_bytes", [1 << 16, 333])
@pytest.mark.parametrize("name", ODD)
def test_what_is_written_in_another_way_is_read_or_refused_as_ever(name, chunk_bytes, is_strict, monkeypatch):
    monkeypatch.setattr(xml, "_CHUNK_BYTES", chunk_bytes)
    folded, plain = both(city(member(ODD[name])).encode(), monkeypatch, is_strict=is_strict)
    assert folded == plain


def test_every_plain_surface_is_folded_and_what_is_left_is_small():
    data = city(PLAIN["walls, and a solid that borrows them"] + member(solid(LOOSE), "b2")).encode()
    folder = folding.Folding()
    left = folder.feed(data) + folder.feed(b"")
    assert b"posList" not in left
    assert left.count(b"boundedBy ") == 1
    assert not folder.has_links  # but those of members, which need no look at objects
    assert sum(len(rings.texts) for rings in folder.rings.values()) == 4
    assert [each.polygon_id for row in folder.surfaces.values() for each in row] == ["p0", "p1", "p2", "p3"]
    folder.forget(folder.count)
    assert not folder.rings
    assert not folder.surfaces


def test_encodings_where_a_byte_may_be_part_of_a_character_are_left_alone():
    for encoding, is_folded in (
        ("iso-8859-1", True),
        ("us-ascii", True),
        ("iso-2022-jp", False),
        ("gbk", False),
    ):
        folder = folding.Folding()
        folder.feed(city(PLAIN["a solid"], encoding=encoding).encode())
        assert folder.has_folded == is_folded, encoding
    folder = folding.Folding()
    assert folder.feed(city(PLAIN["a solid"]).encode("utf-16")) == city(PLAIN["a solid"]).encode("utf-16")


BITS = (
    b"<!-- x -->", b"-->", b"<![CDATA[ 1 2 3 ]]>", b"]]>", b"&amp;", b"\x0b", b"\x01", b"\xff", b";", b">",
    b"<", b' xlink:href="#p1"', b' srsName="EPSG:25833"', b' srsDimension="2"', b"<gml:surfaceMember/>",
    b"nan", b"<?p x?>", b' gml:id="p1"', b"</gml:Polygon>", b"<gml:surfaceMember>", b"<bldg:boundedBy>",
    b"</bldg:boundedBy>", b"foo:",
)  # fmt: skip


def test_documents_changed_at_random_are_read_or_refused_as_ever(monkeypatch):
    rng = random.Random(7)  # noqa: S311 - of tests
    base = city("".join(PLAIN.values())).encode()
    places = [n for n, byte in enumerate(base) if byte in b"<> "]
    outcomes = set()
    for _ in range(150):
        data = base
        for _ in range(rng.choice((1, 1, 2))):
            at = rng.choice(places)
            size = rng.choice((0, 0, 1, 60))
            data = data[:at] + rng.choice(BITS) + data[at + size :]
        monkeypatch.setattr(xml, "_CHUNK_BYTES", rng.choice((400, 1 << 16)))
        options = {"is_strict": rng.random() < 0.5, "layers": rng.choice(((), tuple(LAYERS)))}
        folded, plain = both(data, monkeypatch, **options)
        assert folded == plain
        outcomes.add(type(folded))
    assert outcomes == {dict, tuple}
