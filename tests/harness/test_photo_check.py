import warnings

import pytest
from PIL import Image

from lodbench.datasets.query import Dataset, Entry
from lodbench.findings import Findings
from lodbench.harness.photo.check import check_photos


@pytest.mark.parametrize(
    ("size", "problem"),
    [
        # Between Pillow's warning, from 89 megapixels on, and its error, from 179 on.
        ((12288, 8192), None),
        ((20000, 10000), "too many pixels"),
    ],
)
def test_a_large_photo_is_read_in_silence_and_a_bomb_is_a_finding(tmp_path, size, problem):
    photo = tmp_path / "a.png"
    Image.new("1", size).save(photo)
    entry = Entry("a.png", "data", None, None, photo, None)
    findings = Findings()
    with warnings.catch_warnings(action="error"):
        check_photos(Dataset("own", "", tmp_path, None, None, ("data",), (entry,), {}), True, findings)
    details = [item.detail for item in findings.items]
    assert len(details) == (problem is not None)
    assert all(str(problem) in detail for detail in details)
