from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodbench.citymodel.coordinates import parse_rings

decimals = st.from_regex(r"\A[+-]?(\d{1,25}(\.\d{0,25})?|\.\d{1,20})([eE][+-]?\d{1,2})?\Z").filter(
    str.isascii
)


@pytest.mark.slow
@given(st.lists(st.lists(decimals, max_size=6), max_size=6))
def test_equals_float_to_the_last_bit(rings: list[list[str]]) -> None:
    values, counts, is_bad = parse_rings([" ".join(ring).encode() for ring in rings])
    assert counts.tolist() == [len(ring) for ring in rings]
    assert not is_bad.any()
    assert values.tolist() == [float(text) for ring in rings for text in ring]


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_repr_round_trip(value: float) -> None:
    assert parse_rings([repr(value).encode()])[0].tolist() == [value]


@given(st.lists(st.text(max_size=30), min_size=1, max_size=5))
def test_never_raises_and_counts_texts(texts: list[str]) -> None:
    values, counts, is_bad = parse_rings([text.encode("utf-8", "surrogatepass") for text in texts])
    assert len(counts) == len(is_bad) == len(texts)
    assert counts.sum() == len(values)


@pytest.mark.parametrize(
    "text",
    ["nan", "inf", "-Infinity", "1e400", "1_000", "٣", "1.2.3", "1,5", "--1", "1e", ".", "0x10", "1;2", "+"],
)
def test_refuses_what_is_no_plain_finite_decimal(text: str) -> None:
    values, _, is_bad = parse_rings([b"1 2 3", text.encode(), b"4 5"])
    assert is_bad.tolist() == [False, True, False]
    assert values[:3].tolist() == [1, 2, 3]
    assert values[-2:].tolist() == [4, 5]


def test_white_space_of_every_kind() -> None:
    assert parse_rings([b" 1\t2\r\n3 ", b"", b"\n"])[0].tolist() == [1, 2, 3]
    assert parse_rings([])[1].tolist() == []
    assert np.isclose(parse_rings([b"35.75599827822895"])[0][0], 35.75599827822895, rtol=0, atol=0)
