"""Passes over small cities: what the compiled ones give, bit by bit."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from lodbench.citymodel import small_cities
from lodbench.citymodel.coordinates import parse_rings
from lodbench.citymodel.raw import starts_of
from lodbench.kernels import city as city_kernels

ODD_TEXTS = [
    "",
    " \n",
    "1 2.5 -3",
    "-0 -0.0 .5 5. 1e3 1E-3 +7",
    "1e400 2",
    "1e-400",
    "0.1234567890123456789012345 3",
    "123456789012345678901234567890",
    "5e22 5e23 9007199254740993e1",
    "nan 1",
    "1 inf 2",
    "1_000",
    "1e",
    ".",
    "- 2",
    "1..2 4",
    "1,5 2",
    "\x1c1 2",
    "1\t2\r\n3\x0b4\x0c5",
    "00000000000000000000000000000000012.5",
    "x" * 50 + "9" * 5000 + "x",
]


def both(texts: list[str], monkeypatch: pytest.MonkeyPatch) -> list[tuple[bytes, ...]]:
    found = []
    for is_few in (True, False):
        monkeypatch.setattr(small_cities, "is_few", lambda _, is_few=is_few: is_few)
        found.append(tuple(part.tobytes() for part in parse_rings([text.encode() for text in texts])))
    return found


@pytest.mark.parametrize("text", ODD_TEXTS)
def test_texts_are_read_as_the_compiled_reader_reads_them(text, monkeypatch):
    plain, compiled = both([text, "4 5"], monkeypatch)
    assert plain == compiled


def test_texts_of_other_scripts_and_with_separators_are_read_likewise(monkeypatch):
    plain, compiled = both(["1 2", "\u0663 4", "5;6", "7"], monkeypatch)
    assert plain == compiled


def test_many_numbers_are_read_to_the_bit(monkeypatch):
    rng = np.random.default_rng(1)
    values = rng.normal(size=6000) * 10.0 ** rng.integers(-9, 9, 6000)
    forms = ("{!r}", "{:.3f}", "{:.12g}", "{:e}")
    texts = [" ".join(form.format(float(value)) for value in values) for form in forms]
    plain, compiled = both(texts, monkeypatch)
    assert plain == compiled


@pytest.mark.parametrize("count", [0, 1, 60])
def test_points_are_marked_as_by_the_compiled_pass(count):
    rng = np.random.default_rng(count)
    starts = starts_of(rng.integers(0, 7, count))
    points = rng.integers(0, 2, (starts[-1], 3)).astype(np.float64)
    found = []
    for module in (small_cities, city_kernels):
        kept, lengths = np.zeros(len(points), np.bool_), np.zeros(count, np.int64)
        closed, repeated = np.zeros((2, count), np.bool_)
        module.mark_points(points, starts, kept, lengths, closed, repeated)
        found.append([part.tolist() for part in (kept, lengths, closed, repeated)])
    assert found[0] == found[1]
    assert count < 60 or all(0 < sum(part) for part in found[0])


def test_corners_are_hashed_as_by_the_compiled_pass():
    rng = np.random.default_rng(3)
    ring_starts = starts_of(rng.integers(3, 9, 80))
    polygon_starts = starts_of(np.full(40, 2))
    points = rng.normal(size=(ring_starts[-1], 3)).round(1)
    points[rng.integers(0, len(points), 30), 1] = -0.0
    chosen = rng.permutation(40)[:31]
    found = []
    for module in (small_cities, city_kernels):
        hashes = np.zeros((2, len(chosen)), np.uint64)
        module.hash_corners(points.view(np.uint64), ring_starts, polygon_starts, chosen, hashes)
        found.append(hashes)
    assert np.array_equal(*found)
    assert len(np.unique(found[0])) == found[0].size


def test_numba_is_left_out_for_a_small_city_and_loaded_for_a_large_one():
    code = (
        "import sys\nfrom lodbench.citymodel.coordinates import parse_rings\n"
        "parse_rings([b'1.25 2.50 3.75 ' * 1000]); print('numba' in sys.modules)\n"
        "parse_rings([b'1.25 2.50 3.75 ' * 900000]); print('numba' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True"]
