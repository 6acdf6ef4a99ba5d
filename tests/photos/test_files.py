"""Photos told apart into flights: by folder, camera and clock; clocks that jump."""

from datetime import datetime, timedelta
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodbench.photos.files import split_flights
from lodbench.photos.metadata import PhotoMetadata

START = datetime(2023, 10, 18, 11, 0, 0)


def photos(*seconds: float | None, folder: str = "card", first: int = 1, **stated):
    """Returns photos named in turn, taken so many seconds after the start; None has no clock."""
    found = []
    for number, second in enumerate(seconds, start=first):
        clock = "" if second is None else f"{START + timedelta(seconds=second):%Y:%m:%d %H:%M:%S}"
        name = f"DJI_{number}.JPG"
        values = {"model": "FC6310R", **stated}
        found.append((Path(folder) / name, PhotoMetadata(name, 4000, 3000, taken_at=clock, **values)))
    return found


def rows(found):
    return [flight.rows for flight in found]


def test_a_quarter_of_an_hour_without_a_photo_parts_two_flights():
    found = split_flights(photos(0, 5, 10, 10 + 901, 10 + 905))
    assert rows(found) == [[0, 1, 2], [3, 4]]
    assert found[1].started == START + timedelta(seconds=911)
    assert found[0].camera == "FC6310R 4000 x 3000"
    assert rows(split_flights(photos(0, 5, 10, 10 + 899))) == [[0, 1, 2, 3]]


@pytest.mark.parametrize("other", [{"model": "FC220"}, {"focal_mm": 24.0}, {"digital_zoom": 2.0}])
def test_another_camera_is_another_flight(other):
    one, two = photos(0, 10, 20), photos(5, 15, 25, first=4, **other)
    mixed = [pair for both in zip(one, two, strict=True) for pair in both]
    assert rows(split_flights(mixed)) == [[0, 2, 4], [1, 3, 5]]


@pytest.mark.parametrize(
    ("seconds", "odd"),
    [
        ((0, 5, -(10**8), 15, 20), [2]),
        ((0, 5, 10**9, 15, 20), [2]),
        ((0, 5, 10, 15, -9000, -8995, -8990), [4, 5, 6]),
        ((-(10**8), 5, 10), []),
    ],
)
def test_a_clock_that_runs_against_the_names_parts_no_flight(seconds, odd):
    found = split_flights(photos(*seconds))
    assert found[0].odd_clocks == odd
    assert len(found) == (1 if odd else 2)


def test_names_are_counted_and_not_spelt():
    # DJI_2 comes before DJI_10.
    found = split_flights(photos(*range(0, 60, 5)))
    assert rows(found) == [list(range(12))]
    assert found[0].odd_clocks == []


def test_a_flight_goes_on_in_the_next_folder():
    both = photos(0, 5, 10, folder="100MEDIA") + photos(15, 20, folder="101MEDIA")
    assert rows(split_flights(both)) == [[0, 1, 2, 3, 4]]
    apart = photos(0, 5, 10, folder="100MEDIA") + photos(5000, 5005, folder="101MEDIA")
    assert rows(split_flights(apart)) == [[0, 1, 2], [3, 4]]


def test_two_drones_of_one_kind_that_fly_at_once_are_two_flights():
    both = photos(0, 10, 20, folder="east") + photos(5, 15, 25, folder="west")
    assert rows(split_flights(both)) == [[0, 1, 2], [3, 4, 5]]


def test_photos_without_a_clock_stay_where_their_names_are():
    assert rows(split_flights(photos(None, 0, None, 2000, None))) == [[0, 1, 2], [3, 4]]
    assert rows(split_flights(photos(None, None))) == [[0, 1]]
    assert split_flights(photos(None))[0].started is None


@given(st.lists(st.one_of(st.none(), st.integers(0, 10**6)), min_size=1, max_size=30))
def test_each_photo_is_in_one_flight(seconds):
    found = split_flights(photos(*seconds))
    assert sorted(row for flight in found for row in flight.rows) == list(range(len(seconds)))


def test_digits_that_are_no_numbers_sort_as_letters():
    (_, first), (_, second) = photos(0, 2)
    (flight,) = split_flights([(Path("1\u00b22.JPG"), first), (Path("1a.JPG"), second)])
    assert flight.rows == [1, 0]
