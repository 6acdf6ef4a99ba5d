"""Mutated real files: whatever the bytes, a city or a ``LodbenchError``, never anything else.

More of it: ``python -m tests.citymodel.test_fuzz 20000`` from the checkout.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
import pytest

from lodbench.citymodel import mesh_model, parse_city_model
from lodbench.errors import LodbenchError

from .gml_text import box_city
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


def fuzz(count: int, files: list[tuple[str, bytes]], seed: int) -> tuple[int, int]:
    """Tries mutated files; returns how many were read and how many refused.

    Raises:
        AssertionError: Something other than a ``LodbenchError`` came out; names file and number.
    """
    num_read = num_refused = 0
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        name, data = files[number % len(files)]
        content = mutate(data, rng)
        try:
            model = parse_city_model(content, name)
            for lod in model.lods:
                mesh_model(model, lod)
            num_read += 1
        except LodbenchError:
            num_refused += 1
        except Exception as error:
            raise AssertionError(f"mutation {number} of {name} (seed {seed}) raised {error!r}") from error
    return num_read, num_refused


@pytest.mark.filterwarnings("error")
def test_mutated_files(shared_data: Path) -> None:
    num_read, num_refused = fuzz(500, seeds(shared_data), seed=1)
    assert num_read > 20
    assert num_refused > 100


def test_mutated_twins() -> None:
    assert sum(fuzz(160, seeds(None), seed=2)) == 160


if __name__ == "__main__":
    folder = Path(__file__).resolve().parents[3] / "shared" / "data"
    start = time.perf_counter()
    counts = fuzz(int(sys.argv[1]), seeds(folder if folder.is_dir() else None), seed=int(time.time()))
    sys.stdout.write(f"read {counts[0]}, refused {counts[1]}, {time.perf_counter() - start:.0f} s\n")
