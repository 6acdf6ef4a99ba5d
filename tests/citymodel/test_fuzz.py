"""Mutated real files: whatever the bytes, a city or a ``LodbenchError``, never anything else.

More of it: ``make fuzz``.
"""

import re
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest

from lodbench.citymodel import ReadOptions, mesh_model, parse_city_model, read_city_model
from lodbench.citymodel.checks.report import check_city
from lodbench.citymodel.cityjson.writer import cityjson_text
from lodbench.citymodel.gml.writer import CityGmlWriter
from lodbench.errors import LodbenchError

from .gml_text import box_city, squares
from .test_layers import town, twin
from .twins import documents

_REAL = (
    "city/plateau/64412288_bldg_6697_op.gml",
    "city/ingolstadt_lod3/4018142.xml",
    "city/ingolstadt_lod3/4018302.xml",
    "city/netherlands_other/dh_1.gml",
    "city/switzerland/zurich-lod2-citygml1.xml",
    "city/misc/montreal_b4.city.jsonl",
    "city/misc/palais_de_justice.obj",
)
# Bytes that mean something to one of the formats: random ones seldom reach past the parser.
_WORDS = (
    b"nan", b"1e999", b"-1", b"0", b"99999999", b"<", b">", b'"', b"#", b"&x;", b"{", b"]", b"null",
    b"\xff\xfe", b"\x00", b"EPSG:4979", b'srsDimension="2"', b'xlink:href="#x"', b"f 1 2 9\n", b";",
    b"true", b"[[[]]]", b"<gml:interior/>", b"</gml:Polygon>", b"CityJSONFeature", b'"lod":7', b"1 2 3 ",
    b'"scale":[0,0,0]', b'srsName="EPSG:4326"', b"e5", b" ", b"9",
)  # fmt: skip


def seeds(shared_data: Path | None) -> list[tuple[str, bytes]]:
    """Returns small files of every format, real ones where they are there."""
    found = [(name, text.encode()) for name, text in documents().items()] + [("box.gml", box_city().encode())]
    found += [("town.gml", town().encode()), ("town.city.json", twin().encode())]
    if shared_data is not None:
        found += [(name, (shared_data / name).read_bytes()) for name in _REAL]
    return found


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """Returns a file with a few bytes changed, words put in, or pieces cut, doubled or swapped."""
    content = bytearray(data)
    for _ in range(int(rng.integers(1, 6))):
        size = len(content)
        at, length = int(rng.integers(0, size + 1)), int(rng.integers(1, 200))
        kind = rng.integers(0, 6)
        if kind == 0 and at < size:
            content[at] = int(rng.integers(0, 256))
        elif kind == 1:
            content[at:at] = _WORDS[int(rng.integers(0, len(_WORDS)))]
        elif kind == 2:
            word = _WORDS[int(rng.integers(0, len(_WORDS)))]
            content[at : at + len(word)] = word
        elif kind == 3:
            del content[at : at + length]
        elif kind == 4:
            content[at:at] = content[at : at + length]
        elif rng.random() < 0.1:
            del content[at:]
    return bytes(content)


_CRS_NAMES = (
    b"EPSG:4647", b"EPSG:3857", b"EPSG:4979", b"EPSG:2263", b"EPSG:32662", b"EPSG:99999", b"EPSG:25832+99999",
    b"urn:ogc:def:crs:EPSG::5653", b"urn:adv:crs:*", b"", b" ", b"OGC:CRS84", b"IGNF:LAMB93",
    b"+proj=geocent", b"PROJCS[", b"http://www.opengis.net/def/crs/EPSG/0/", b"CH1903", b"EPSG:5773",
)  # fmt: skip
_CRS_PLACES = re.compile(rb'(srsName=")[^"]*|("referenceSystem": ?")[^"]*')
_IDS = re.compile(rb'gml:id="[^"]*"')
_KEYS = re.compile(rb'"[^"]*":\s*\{\s*"type":\s*"B')
_LINKED = re.compile(rb"<(?:\w+:)?surfaceMember>")
_VALUES = re.compile(rb'"values":\s*\[[^"]{0,4000}?\](?=\s*(?:\}|,\s*"))')
_LABELS = (b"[]", b"[null]", b"[[[[0]]]]", b"[0]", b"[-1, 99, true]", b'["0"]', b"[[0, 1], 0]", b"[{}]")
_LINK = (
    b'<gml:surfaceMember xmlns:gml="http://www.opengis.net/gml" xmlns:xlink="http://www.w3.org/1999/xlink">'
    b'<gml:CompositeSurface gml:id="z%d"><gml:surfaceMember xlink:href="#z%d"/></gml:CompositeSurface>'
    b"</gml:surfaceMember>"
)


def mutate_structure(data: bytes, rng: np.random.Generator) -> bytes:
    """Returns a file as well-formed as before, and wrong in what it says: names, ids, links, labels."""
    kind = int(rng.integers(0, 4))
    if kind == 0:
        name = _CRS_NAMES[int(rng.integers(0, len(_CRS_NAMES)))]
        return _replace_some(_CRS_PLACES, data, rng, lambda m: (m[1] or m[2]) + name)
    if kind == 1:  # one id for two objects, or for all
        pattern = _KEYS if data.lstrip()[:1] == b"{" else _IDS
        ids = pattern.findall(data) or [b'gml:id="x"']
        twin = ids[int(rng.integers(0, len(ids)))]
        return _replace_some(pattern, data, rng, lambda _: twin)
    if kind == 2:  # chains and circles of links
        count = int(rng.integers(1, 400))
        steps = b"".join(_LINK % (k, int(rng.integers(0, count + 2))) for k in range(count))
        return _replace_some(_LINKED, data, rng, lambda m: steps + m[0], share=0.0)
    wrong = _LABELS[int(rng.integers(0, len(_LABELS)))]
    return _replace_some(_VALUES, data, rng, lambda _: b'"values":' + wrong)


def _replace_some(
    pattern: re.Pattern[bytes],
    data: bytes,
    rng: np.random.Generator,
    change: Callable[[re.Match[bytes]], bytes],
    share: float = 0.5,
) -> bytes:
    """Returns the text with one match changed, and a share of the others."""
    matches = list(pattern.finditer(data))
    if not matches:
        return mutate(data, rng)
    chosen = rng.random(len(matches)) < share * rng.random()
    chosen[int(rng.integers(0, len(matches)))] = True
    pieces, last = [], 0
    for match, is_chosen in zip(matches, chosen.tolist(), strict=True):
        if is_chosen:
            pieces += [data[last : match.start()], change(match)]
            last = match.end()
    return b"".join([*pieces, data[last:]])


def fuzz_sidecars(numbers: Iterable[int], folder: Path, seed: int) -> tuple[int, int]:
    """Tries Shapefiles of which one file is cut, lost or changed; returns how many were read and refused.

    Raises:
        AssertionError: Something other than a ``LodbenchError`` came out, or footprints were lost unseen.
    """
    squares(folder / "whole.shp", 20)
    files = {file.suffix: file.read_bytes() for file in folder.glob("whole.*")}
    num_read = num_refused = 0
    for number in numbers:
        rng = np.random.default_rng([seed, number])
        suffix = sorted(files)[int(rng.integers(0, len(files)))]
        data, way = files[suffix], int(rng.integers(0, 3))
        for other, content in files.items():
            (folder / f"cut{other}").write_bytes(content)
        path = folder / f"cut{suffix}"
        if way == 0:
            path.unlink()
        else:
            path.write_bytes(data[: int(rng.integers(0, len(data)))] if way == 1 else mutate(data, rng))
        try:
            model = read_city_model(folder / "cut.shp")
        except LodbenchError:
            num_refused += 1
            continue
        num_read += 1
        is_whole = len(model.building_ids) == 20
        assert way == 2 or is_whole, f"mutation {number}: {suffix} is cut or lost, and nothing was said"
    return num_read, num_refused


def fuzz(numbers: Iterable[int], files: list[tuple[str, bytes]], seed: int) -> tuple[int, int]:
    """Tries mutated files; returns how many were read and how many refused.

    Raises:
        AssertionError: Something other than a ``LodbenchError`` came out; names file and number.
    """
    num_read = num_refused = 0
    for number in numbers:
        rng = np.random.default_rng([seed, number])
        name, data = files[number % len(files)]
        content = (mutate_structure if number // len(files) % 2 else mutate)(data, rng)
        layers = ("bridges", "vegetation", "relief", "interiors") if number % 5 == 0 else ()
        options = ReadOptions(is_strict=number % 4 < 2, has_details=number % 3 == 0, layers=layers)
        try:
            model = parse_city_model(content, name, options)
            for lod in model.lods:
                mesh_model(model, lod)
            if options.has_details:
                check_city(model)
                parse_city_model(cityjson_text(model)[0], "again.json")
                version = ("2.0", "3.0")[number % 2]
                parse_city_model(b"".join(CityGmlWriter(model, version).chunks()), "again.gml", options)
            num_read += 1
        except LodbenchError:
            num_refused += 1
        except Exception as error:
            raise AssertionError(f"mutation {number} of {name} (seed {seed}) raised {error!r}") from error
    return num_read, num_refused


@pytest.mark.filterwarnings("error")
@pytest.mark.slow
def test_mutated_files(shared_data: Path) -> None:
    num_read, num_refused = fuzz(range(500), seeds(shared_data), seed=1)
    assert num_read > 20
    assert num_refused > 100


def test_cut_sidecars(tmp_path: Path) -> None:
    pytest.importorskip("pyogrio")
    num_read, num_refused = fuzz_sidecars(range(40), tmp_path, seed=3)
    assert num_read > 3
    assert num_refused > 10


@pytest.mark.parametrize(
    ("name", "codes"),
    [
        ("v2.gml", {"LB205 DUPLICATE_ID"}),
        ("v20.city.json", {"LB205 DUPLICATE_ID", "LB213 SEMANTICS_MISFIT"}),
        ("seq.city.jsonl", {"LB205 DUPLICATE_ID", "LB213 SEMANTICS_MISFIT"}),
    ],
)
def test_mutations_reach_past_the_parser(name: str, codes: set[str]) -> None:
    data, met = documents()[name].encode(), set[str]()
    for seed in range(24):
        try:
            content = mutate_structure(data, np.random.default_rng(seed))
            met |= parse_city_model(content, name).findings.counts().keys()
        except LodbenchError:
            continue
    assert codes <= met


def test_mutated_twins() -> None:
    assert sum(fuzz(range(160), seeds(None), seed=2)) == 160
