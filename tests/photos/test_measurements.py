"""What photos and datasets state of measurements, and what their altitudes are above."""

import math
from dataclasses import replace

import numpy as np
import pytest

from lodbench.errors import LodbenchError
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.measurements import (
    FRAME_M,
    Measurements,
    measured_of,
    parse_measurements,
    place_notes,
    refused_notes,
)
from lodbench.photos.metadata import PhotoMetadata, read_photo_metadata
from lodbench.photos.pose import HeightOptions, height_doubt, is_above_ellipsoid
from lodbench.photos.xmp import LaserRange
from tests.photos.dji_photo import PROPERTIES, exif_of, packet_around, write_photo, xmp_packet

RTK = {"RtkFlag": "50", "RtkStdLon": "0.012", "RtkStdLat": "0.034", "RtkStdHgt": "0.056"}


def photo_of(folder, properties) -> PhotoMetadata:
    packet = xmp_packet({**PROPERTIES, **properties})
    return read_photo_metadata(write_photo(folder / "a.jpg", exif=exif_of(), xmp=packet))


def with_frame(sigma: float) -> float:
    return math.sqrt(sigma**2 + FRAME_M**2)


def test_a_receiver_s_deviations_are_those_of_its_coordinates(tmp_path):
    photo = photo_of(tmp_path, RTK)
    assert photo.sigmas == (0.012, 0.034, 0.056, None, None, None)
    measured = measured_of(photo, HeightOptions(geoid_m=46.0))
    assert measured.sigmas[:3] == pytest.approx([with_frame(s) for s in (0.012, 0.034, 0.056)])
    assert measured.sigmas[3:] == (None,) * 3
    assert measured.takeoff_height_m == 80.1
    assert "east 1 m, north 1 m, up 1 m" in measured.note


@pytest.mark.parametrize(
    ("changed", "known", "reason"),
    [
        ({"RtkFlag": "0"}, (None, None, None), "RtkFlag 0"),
        ({"RtkFlag": "17"}, (None, None, None), "RtkFlag 17"),
        ({"RtkStdLon": "-1"}, (None, 0.034, 0.056), "RtkStdLon '-1' is no standard deviation"),
        ({"RtkStdHgt": "nan"}, (0.012, 0.034, None), "RtkStdHgt 'nan'"),
        ({"RtkStdLat": "0"}, (0.012, None, 0.056), "RtkStdLat '0'"),
        ({"RtkStdLat": "5000"}, (0.012, None, 0.056), "RtkStdLat '5000'"),
        ({"LRFStatus": "Too far", "LRFTargetDistance": "12"}, (0.012, 0.034, 0.056), "LRFStatus 'Too far'"),
        ({"LRFStatus": "Normal", "LRFTargetDistance": "-3"}, (0.012, 0.034, 0.056), "LRFTargetDistance '-3'"),
    ],
    ids=str,
)
def test_what_is_no_measurement_is_refused_with_its_reason(tmp_path, changed, known, reason):
    photo = photo_of(tmp_path, RTK | changed)
    assert (photo.sigmas[:3], photo.laser) == (known, None)
    assert all(reason in note for note in refused_notes([photo])[:1])
    assert "not used" in refused_notes([photo])[0]
    assert "(2 of 2 photos)" in refused_notes([photo, photo])[0]


def test_photos_without_such_properties_say_nothing(tmp_path):
    photo = photo_of(tmp_path, {"RtkFlag": "0"})
    assert (photo.sigmas, photo.refused) == ((None,) * 6, ())
    assert measured_of(replace(photo, relative_altitude_m=None), HeightOptions()) is None


def test_pix4d_s_terms_are_read_of_any_maker_and_go_behind_the_receiver_s(tmp_path):
    names = {
        "GPSXYAccuracy": "2.5",
        "GPSZAccuracy": "7/2",
        "IMUYawAccuracy": "1.5",
        "IMUPitchAccuracy": "0.2",
    }
    listed = " ".join(f'c:{name}="{value}"' for name, value in names.items())
    body = f'<rdf:Description rdf:about="" xmlns:c="http://pix4d.com/camera/1.0/" {listed}/>'
    path = write_photo(tmp_path / "a.jpg", exif=exif_of(51.0, 5.0, 99.0), xmp=packet_around(body))
    photo = read_photo_metadata(path)
    assert photo.sigmas == (2.5, 2.5, 3.5, 0.2, None, 1.5)
    # Its angles are of no gimbal that is read: nor are their deviations of the prior's.
    assert measured_of(photo, HeightOptions()).sigmas[3:] == (None,) * 3


def test_deviations_are_of_the_photo_s_own_numbers_only(tmp_path):
    photo = photo_of(tmp_path, RTK)
    assert measured_of(photo, HeightOptions(takeoff_m=50.0)).sigmas[2] is None
    assert measured_of(photo, HeightOptions(), [0, 2]).sigmas == (None, with_frame(0.034), *(None,) * 4)
    without = replace(photo, has_rtk=False, is_single_point=True)  # nobody says what its height is above
    assert measured_of(without, HeightOptions()).sigmas[2] is None


def test_words_restore_what_was_measured():
    measured = Measurements(
        (0.1, None, 0.3, 0.25, None, 1.0), LaserRange(81.25, stated_sigma_m=0.3), -4.5, 0.7, 1.75e9
    )
    assert parse_measurements(measured.words()) == measured
    assert parse_measurements([]) == Measurements()
    assert parse_measurements(["range=100"]).laser.sigma_m == pytest.approx(0.35)
    np.testing.assert_array_equal(measured.over(np.full(6, 9.0)), [0.1, 9.0, 0.3, 0.25, 9.0, 1.0])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["east=-0.1"], "east=-0.1 is not above 0"),
        (["up=0"], "up=0 is not above 0"),
        (["range=nan"], "range=nan"),
        (["heading=x"], "heading=x"),
        (["nort=1"], "'nort=1' is no measurement"),
        (["east=1", "east=2"], "east is given twice"),
        (["sigma_range=1"], "sigma_range is of no range"),
        (["takeoff=inf"], "takeoff=inf"),
        (["time=nan"], "time=nan"),
    ],
    ids=str,
)
def test_words_that_state_no_measurement_are_faults(words, said):
    with pytest.raises(LodbenchError, match=said.replace(".", r"\.")):
        parse_measurements(words)


NRW = MapFrame("EPSG:25832+7837")
SKYDIO, PIX4D = "https://www.skydio.com/drone-skydio/1.0/", "http://pix4d.com/camera/1.0/"


def read(folder, xmp: bytes | None = None, altitude: float = 203.4, **exif) -> PhotoMetadata:
    tags = exif_of(51.0479, 5.869, altitude, **{"make": "Other", "model": "", **exif})
    return read_photo_metadata(write_photo(folder / "a.jpg", exif=tags, xmp=xmp))


def says(reference: str) -> bytes:
    return packet_around(f'<rdf:Description xmlns:Camera="{PIX4D}" Camera:VertCS="{reference}"/>')


@pytest.mark.parametrize(
    ("reference", "version", "altitude", "is_doubted"),
    [
        (0, "0232", 203.4, False),
        (1, "0232", -203.4, False),
        # 3.0 made 0 and 1 the ellipsoid's, and has 2 and 3 for sea level.
        (0, "0300", 203.4, True),
        (1, "0300", -203.4, True),
        (2, "0300", 203.4, False),
        (3, "0300", -203.4, False),
        (2, "0232", 203.4, False),
        (0, "", 203.4, False),
    ],
)
def test_the_reference_of_exif_s_altitude(tmp_path, reference, version, altitude, is_doubted):
    photo = read(tmp_path, altitude_ref=reference, version=version)
    assert photo.altitude_m == altitude
    assert not is_above_ellipsoid(photo)
    assert bool(height_doubt(photo)) == is_doubted
    notes = place_notes(NRW, [photo])
    assert any("EXIF 3.0" in note and "--heights says which" in note for note in notes) == is_doubted
    assert place_notes(NRW, [photo], HeightOptions("sea_level")) == ()


def test_exif_s_reference_is_not_that_of_xmp_s_altitude(tmp_path):
    xmp = xmp_packet({"AbsoluteAltitude": "150.0"})
    photo = read(tmp_path, xmp, altitude_ref=0, version="0300")
    assert (photo.altitude_m, height_doubt(photo)) == (150.0, "")


@pytest.mark.parametrize(
    ("make", "model", "xmp", "above", "doubt"),
    [
        ("Parrot", "ANAFI Ai", None, True, ""),
        ("Parrot", "anafiai", None, True, ""),
        ("Parrot", "ANAFI USA", None, False, ""),
        ("senseFly", "", says("ellipsoidal"), True, ""),
        ("senseFly", "", says("EPSG:5773"), False, ""),
        ("Skydio", "X10", says("ellipsoidal"), True, ""),
        ("Skydio", "X2", None, False, "Skydio"),
        # Older ones write it of heights above sea level, too.
        ("Autel Robotics", "XT705", says("ellipsoidal"), False, "Autel"),
        ("Autel Robotics", "XT705", xmp_packet({"RtkFlag": "50"}), True, ""),
        ("DJI", "FC6310R", xmp_packet({"RtkFlag": "16"}), False, "RtkFlag 16"),
    ],
)
def test_the_maker_s_word(tmp_path, make, model, xmp, above, doubt):
    photo = read(tmp_path, xmp, make=make, model=model)
    assert is_above_ellipsoid(photo) == above
    assert HeightOptions().source_for(photo) == ("ellipsoid" if above else "sea_level")
    assert doubt in height_doubt(photo)
    assert bool(doubt) == bool(height_doubt(photo))


def test_doubts_of_several_kinds_are_one_note(tmp_path):
    autel = read(tmp_path, make="Autel")
    photos = [autel, autel, read(tmp_path, make="Skydio"), read(tmp_path, make="Canon")]
    (note,) = place_notes(NRW, photos)
    assert "heights of 3 of 4 photos" in note
    assert "(Autel's drones differ; Skydio's drones differ)" in note
