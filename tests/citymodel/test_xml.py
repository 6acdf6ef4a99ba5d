import io

import pytest

from lodbench.citymodel.gml.xml import XmlMembers, local_name, namespace_of
from lodbench.errors import CityModelError
from lodbench.findings import Findings


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
