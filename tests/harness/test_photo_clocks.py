"""When photos that are tracked were taken: clocks of whole seconds, fractions, and none."""

import pytest

from lodbench.harness.track_frames import photo_clocks
from tests.photos.dji_photo import exif_of, write_photo


@pytest.mark.parametrize(
    ("clocks", "expected", "said"),
    [
        (["19", "20", "22"], [0, 1, 3], None),
        (["19.5", "19.75", "20"], [0, 0.25, 0.5], None),
        (["19.050", "19.55", "20.05"], [0, 0.5, 1.0], None),
        # Two a second, begun and left in the middle of one.
        (["19", "20", "20", "21", "21", "22"], [0, 0.5, 1.0, 1.5, 2.0, 2.5], "whole seconds"),
        (["19", "19", "20", "20"], [0, 0.5, 1.0, 1.5], "whole seconds"),
        (["19.00", "19.00", "20.00", "20.00"], [0, 0.5, 1.0, 1.5], "whole seconds"),
        (["19", "19", "19"], None, "no clock"),
        (["20", "19", "21"], None, "no clock"),
        (["19", "", "21"], [0, 1, 2], "without a clock, 1,"),
        (["", "19", "", "", "22", ""], [0, 1, 2, 3, 4, 5], "without a clock, 4,"),
        (["19", "", ""], None, "no clock"),
        (["", "", ""], None, "no clock"),
        (["19"], None, None),
    ],
)
def test_photos_have_the_times_that_their_clocks_tell(tmp_path, clocks, expected, said):
    photos = []
    for number, clock in enumerate(clocks):
        second, _, fraction = clock.partition(".")
        taken_at = f"2023:10:18 11:46:{second}" if second else ""
        exif = exif_of(taken_at=taken_at, fraction=fraction)
        photos.append(write_photo(tmp_path / f"{number}.jpg", exif=exif))
    found, notes = photo_clocks(photos)
    assert found == (expected if expected is None else pytest.approx(expected, abs=1e-5))
    assert [said in note for note in notes] == ([True] if said else [])


@pytest.mark.parametrize("fraction", ["x", "-5", "\u0663", " "])
def test_a_fraction_that_is_none_is_absent(tmp_path, fraction):
    photo = write_photo(tmp_path / "a.jpg", exif=exif_of(fraction=fraction))
    other = write_photo(tmp_path / "b.jpg", exif=exif_of(taken_at="2023:10:18 11:46:20"))
    assert photo_clocks([photo, other]) == ([0.0, 1.0], [])
