import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodbench.storage import hide_formula, show_formula


@pytest.mark.parametrize("text", ["=1+1", "+49", "-x", "@SUM(A1)", "'=1", "''@x"])
def test_what_a_spreadsheet_would_compute_gets_an_apostrophe(text):
    assert hide_formula(text) == f"'{text}"


@pytest.mark.parametrize("text", ["", "a=b", "'quoted'", "DJI_0001.JPG"])
def test_other_texts_stay(text):
    assert hide_formula(text) == text


@given(st.text(alphabet="'=+-@ab", max_size=8))
def test_every_text_comes_back(text):
    assert show_formula(hide_formula(text)) == text
    assert not hide_formula(text).startswith(("=", "+", "-", "@"))
