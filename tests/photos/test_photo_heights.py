"""What the altitude of a photo is above, by EXIF, XMP and the maker's word."""

import pytest

from lodbench.photos.map_frame import MapFrame
from lodbench.photos.metadata import PhotoMetadata, read_photo_metadata
from lodbench.photos.notes import place_notes
from lodbench.photos.pose import HeightOptions, height_doubt, is_above_ellipsoid
from tests.photos.dji_photo import exif_of, packet_around, write_photo, xmp_packet

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
