"""What photos state, whole and damaged, and subtitles beside videos of several years."""

import contextlib
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from lodbench.errors import DatasetError
from lodbench.photos.measurements import xmp_note
from lodbench.photos.metadata import PhotoMetadata, find_subtitles, read_photo_metadata, stated_at_start
from lodbench.photos.pose import RoughPlace, require_stated
from tests.photos.dji_photo import PROPERTIES, exif_of, write_photo, xmp_packet

DEWARP = "2019-08-07;3666.66,3660.12,-12.3,8.5,-0.2651,0.1123,0.0002,-0.0004,-0.0331"


@pytest.mark.parametrize("as_elements", [False, True])
def test_everything_a_dji_photo_states(tmp_path, as_elements):
    properties = {**PROPERTIES, "DewarpData": DEWARP, "DewarpFlag": "0", "RtkFlag": "50"}
    path = write_photo(
        tmp_path / "DJI_0001.JPG",
        exif=exif_of(51.0479, 5.869, 203.4, size=(5472, 3648), orientation=3),
        xmp=xmp_packet(properties, as_elements),
    )
    photo = read_photo_metadata(path)
    assert (photo.name, photo.width, photo.height) == ("DJI_0001.JPG", 64, 48)
    assert (photo.make, photo.model, photo.taken_at) == ("DJI", "FC6310R", "2023:10:18 11:46:19")
    assert (photo.orientation, photo.size_when_taken) == (3, (5472, 3648))
    # DJI's own digits go before EXIF's seconds.
    assert (photo.latitude_deg, photo.longitude_deg) == (51.0479012, 5.8690021)
    assert (photo.altitude_m, photo.relative_altitude_m) == (203.41, 80.1)
    assert (photo.gimbal_yaw_deg, photo.gimbal_pitch_deg, photo.gimbal_roll_deg) == (-43.6, -45.3, 0.3)
    assert (photo.focal_mm, photo.focal_35mm) == (pytest.approx(8.8), 24)
    assert photo.has_rtk
    assert not photo.is_dewarped
    assert photo.dewarp is not None
    assert (photo.dewarp.fx, photo.dewarp.fy, photo.dewarp.cx, photo.dewarp.cy) == (
        3666.66,
        3660.12,
        -12.3,
        8.5,
    )
    assert photo.dewarp.distortion == (-0.2651, 0.1123, 0.0002, -0.0004, -0.0331)


@pytest.mark.parametrize(
    ("flag", "kind", "has_rtk", "is_single_point"),
    [
        ("34", "", True, False),
        ("48", "", True, False),  # newer drones' float solutions
        ("50", "RtkAlt", True, False),
        ("16", "RtkAlt", True, False),
        ("16", "", False, True),
        ("16", "GpsFusionAlt", False, True),
        ("0", "RtkAlt", False, False),
        (None, "RtkAlt", False, False),  # drones without a receiver write it
        ("?", "", False, False),
    ],
)
def test_whose_height_it_is(tmp_path, flag, kind, has_rtk, is_single_point):
    properties = {"RtkFlag": flag, "AltitudeType": kind}
    packet = xmp_packet({key: value for key, value in properties.items() if value})
    photo = read_photo_metadata(write_photo(tmp_path / "a.jpg", xmp=packet))
    assert (photo.has_rtk, photo.is_single_point) == (has_rtk, is_single_point)


def test_angles_that_are_none_are_absent(tmp_path):
    packet = xmp_packet({"GimbalYawDegree": "999", "GimbalRollDegree": "-999", "GimbalPitchDegree": "-90"})
    photo = read_photo_metadata(write_photo(tmp_path / "a.jpg", xmp=packet))
    assert (photo.gimbal_yaw_deg, photo.gimbal_pitch_deg, photo.gimbal_roll_deg) == (None, -90.0, None)


def test_exif_alone(tmp_path):
    photo = read_photo_metadata(write_photo(tmp_path / "a.jpg", exif=exif_of(-33.865143, -70.5, -12.25)))
    assert photo.latitude_deg == pytest.approx(-33.865143, abs=3e-8)
    assert photo.longitude_deg == pytest.approx(-70.5, abs=3e-8)
    assert photo.altitude_m == -12.25
    assert photo.gimbal_yaw_deg is None
    assert photo.has_position


@pytest.mark.parametrize(("written", "zoom"), [(2.5, 2.5), (1, 1.0), (0, 1.0), (0.5, 1.0), (None, 1.0)])
def test_a_digital_zoom_where_one_was_used(tmp_path, written, zoom):
    photo = read_photo_metadata(write_photo(tmp_path / "a.jpg", exif=exif_of(zoom=written)))
    assert photo.digital_zoom == zoom


def test_a_photo_that_says_nothing(tmp_path):
    assert read_photo_metadata(write_photo(tmp_path / "a.jpg")) == PhotoMetadata("a.jpg", 64, 48)


def test_the_misspelt_longitude_of_older_firmware(tmp_path):
    properties = {"GpsLatitude": "51.5", "GpsLongtitude": "5.25"}
    photo = read_photo_metadata(write_photo(tmp_path / "a.jpg", xmp=xmp_packet(properties)))
    assert (photo.latitude_deg, photo.longitude_deg) == (51.5, 5.25)


def test_no_fix_is_no_place(tmp_path):
    zero = {"GpsLatitude": "0.0", "GpsLongitude": "+0.0000"}
    assert not read_photo_metadata(write_photo(tmp_path / "a.jpg", xmp=xmp_packet(zero))).has_position


def test_png_and_tiff_carry_the_same(tmp_path):
    pixels = Image.fromarray(np.zeros((5, 7), np.uint8))
    xmp = xmp_packet(PROPERTIES)
    pixels.save(tmp_path / "a.tif", tiffinfo={700: xmp})
    assert read_photo_metadata(tmp_path / "a.tif").gimbal_yaw_deg == -43.6
    from PIL.PngImagePlugin import PngInfo

    text = PngInfo()
    text.add_itxt("XML:com.adobe.xmp", xmp.decode())
    pixels.save(tmp_path / "a.png", pnginfo=text, exif=exif_of(51.0, 5.0, 7.0))
    photo = read_photo_metadata(tmp_path / "a.png")
    assert (photo.width, photo.height, photo.gimbal_yaw_deg) == (7, 5, -43.6)


def test_a_raw_photo_is_not_taken_for_its_preview(tmp_path):
    tags = ImageFileDirectory_v2()
    tags.tagtype[0xC612] = 1
    tags[0xC612] = b"\x01\x04\x00\x00"
    Image.new("RGB", (256, 192)).save(tmp_path / "DJI_0001.DNG", format="TIFF", tiffinfo=tags)
    with pytest.raises(DatasetError, match="is a raw photo"):
        read_photo_metadata(tmp_path / "DJI_0001.DNG")


class TestHostile:
    @pytest.mark.parametrize(
        ("key", "value", "field"),
        [
            ("GimbalYawDegree", "nan", "gimbal_yaw_deg"),
            ("GimbalYawDegree", "inf", "gimbal_yaw_deg"),
            ("GimbalYawDegree", "north", "gimbal_yaw_deg"),
            ("GpsLatitude", "191.0", "latitude_deg"),
            ("AbsoluteAltitude", "", "altitude_m"),
            ("DewarpData", "2019;1,2,3", "dewarp"),
            ("DewarpData", "2019;" + "x," * 9, "dewarp"),
            ("DewarpData", DEWARP.replace("3666.66", "-1"), "dewarp"),
        ],
    )
    def test_numbers_that_are_none_are_absent(self, tmp_path, key, value, field):
        path = write_photo(tmp_path / "a.jpg", xmp=xmp_packet({**PROPERTIES, key: value}))
        assert getattr(read_photo_metadata(path), field) is None

    def test_rationals_over_zero_are_absent(self, tmp_path):
        exif = exif_of(51.0, 5.0, 100.125)
        whole = struct.pack(">LL" if exif[6:8] == b"MM" else "<LL", 801, 8)
        assert exif.count(whole) == 1
        at = exif.index(whole)
        path = write_photo(tmp_path / "a.jpg", exif=exif[: at + 4] + bytes(4) + exif[at + 8 :])
        assert read_photo_metadata(path).altitude_m is None
        assert read_photo_metadata(path).latitude_deg == 51.0

    def test_an_entity_is_refused(self, tmp_path):
        packet = b'<!DOCTYPE x [<!ENTITY e SYSTEM "file:///etc/passwd">]>' + xmp_packet({"Model": "&e;"})
        photo = read_photo_metadata(write_photo(tmp_path / "a.jpg", xmp=packet))
        assert "DOCTYPE" in photo.xmp_fault
        assert photo.gimbal_yaw_deg is None

    def test_broken_xmp_is_named(self, tmp_path):
        path = write_photo(tmp_path / "a.jpg", None, exif_of(51.0, 5.0, 90.0), xmp_packet(PROPERTIES)[:-60])
        photo = read_photo_metadata(path)
        assert photo.xmp_fault.startswith(f"{path}, XMP is not well-formed XML")
        with pytest.raises(DatasetError, match=r"where its camera looked .*: .*a\.jpg, XMP is not") as fault:
            require_stated(photo)
        assert "--heading and --pitch" in fault.value.hint
        # What it would say of angles is given, all else is in EXIF.
        require_stated(photo, given=RoughPlace(heading_deg=10.0, pitch_deg=-60.0), knows_camera=False)
        assert xmp_note([photo]) == f"its XMP cannot be read, and nothing of it was used: {photo.xmp_fault}"

    @pytest.mark.parametrize("content", [b"", b"hello", b"\xff\xd8\xff\xe1", b"\x89PNG\r\n\x1a\n"])
    def test_what_is_no_picture(self, tmp_path, content):
        (tmp_path / "a.jpg").write_bytes(content)
        with pytest.raises(DatasetError, match=r"a\.jpg"):
            read_photo_metadata(tmp_path / "a.jpg")

    def test_missing_files_and_folders(self, tmp_path):
        for path in (tmp_path / "no.jpg", tmp_path):
            with pytest.raises(DatasetError, match="cannot be read"):
                read_photo_metadata(path)

    def test_a_picture_too_large_is_refused_before_it_is_decoded(self, tmp_path):
        header = write_photo(tmp_path / "a.jpg").read_bytes()
        # The frame header of a baseline JPEG: marker, length, precision, height, width.
        at = header.index(b"\xff\xc0")
        (tmp_path / "b.jpg").write_bytes(header[: at + 5] + b"\xff\xff\xff\xff" + header[at + 9 :])
        with pytest.raises(DatasetError, match="too many pixels"):
            read_photo_metadata(tmp_path / "b.jpg")

    def test_a_hundred_megapixels_are_a_photo(self, tmp_path):
        header = write_photo(tmp_path / "a.jpg").read_bytes()
        at = header.index(b"\xff\xc0")
        size = struct.pack(">HH", 8192, 12288)  # a Mavic 4 Pro's
        (tmp_path / "b.jpg").write_bytes(header[: at + 5] + size + header[at + 9 :])
        photo = read_photo_metadata(tmp_path / "b.jpg")
        assert (photo.width, photo.height) == (12288, 8192)

    @settings(max_examples=150)
    @given(st.integers(0, 2**32 - 1))
    def test_bytes_changed_at_random_give_metadata_or_a_clear_error(self, tmp_path_factory, seed):
        folder = tmp_path_factory.getbasetemp()
        content = bytearray(_photo(folder))
        generator = np.random.default_rng(seed)
        for _ in range(int(generator.integers(1, 12))):
            content[int(generator.integers(2, len(content)))] = int(generator.integers(256))
        path = folder / "mutant.jpg"
        path.write_bytes(bytes(content[: int(generator.integers(100, len(content)))]))
        # Anything but metadata or a DatasetError is a failure.
        with contextlib.suppress(DatasetError):
            photo = read_photo_metadata(path)
            assert photo.latitude_deg is None or abs(photo.latitude_deg) <= 90


def _photo(folder):
    path = folder / "whole.jpg"
    if not path.exists():
        write_photo(
            path, exif=exif_of(51.0, 5.0, 100.0), xmp=xmp_packet({**PROPERTIES, "DewarpData": DEWARP})
        )
    return path.read_bytes()


VIDEO = PhotoMetadata("DJI_0001.MP4", 1920, 1080)
TIMES = "00:00:00,000 --> 00:00:00,033\n"
NEW = (
    '<font size="28">FrameCnt: 1, DiffTime: 33ms\n2024-05-06 10:11:12.123\n[iso: 110] [shutter: 1/1000.0] '
    "[fnum: 2.8] [ev: 0] [focal_len: 24.00] [dzoom_ratio: 1.00], [latitude: 51.0479] [longitude: 5.8690] "
    "[rel_alt: 80.100 abs_alt: 203.400] [ct: 5500] [gb_yaw: -43.6 gb_pitch: -45.3 gb_roll: 0.3] </font>"
)
OLDER = "[iso : 100] [latitude : 51.0479] [longtitude : 5.8690] [gimbal_yaw : -43.6] [gimbal_pitch : -45.3]"
LISTS = "F/2.8, SS 206, ISO 100, EV 0, GPS (5.8690, 51.0479, 19), G.PRY (-45.3°, 0.3°, -43.6°)"
PHANTOM = (
    "HOME(5.8690,51.0479) 2018.01.02 10:11:12\nGPS(5.8690,51.0479,19) BAROMETER:80.1\nISO:100 Shutter:60"
)


def stated(folder, *cues: str) -> PhotoMetadata:
    text = "".join(f"{number}\n{TIMES}{cue}\n\n" for number, cue in enumerate(cues, start=1))
    (folder / "DJI_0001.SRT").write_text(text, encoding="utf-8")
    return stated_at_start(folder / "DJI_0001.SRT", VIDEO)


@pytest.mark.parametrize("cue", [NEW, OLDER, LISTS, PHANTOM])
def test_where_the_first_frame_was_taken(tmp_path, cue):
    found = stated(tmp_path, cue, cue.replace("51.04", "52.04").replace("-43.6", "11.0"))
    assert (found.latitude_deg, found.longitude_deg, found.make) == (51.0479, 5.869, "DJI")
    looks = None if cue == PHANTOM else (-43.6, -45.3)
    assert looks is None or (found.gimbal_yaw_deg, found.gimbal_pitch_deg) == looks
    assert (found.name, found.width, found.height) == ("DJI_0001.MP4", 1920, 1080)


def test_heights(tmp_path):
    found = stated(tmp_path, NEW)
    assert (found.altitude_m, found.relative_altitude_m) == (203.4, 80.1)
    assert stated(tmp_path, PHANTOM).relative_altitude_m == 80.1


def test_what_is_not_known_at_first_is_taken_as_soon_as_it_is(tmp_path):
    early = NEW.replace("51.0479", "0.000000").replace("5.8690", "0.000000")
    assert stated(tmp_path, early).has_position is False
    assert stated(tmp_path, early, early, NEW).latitude_deg == 51.0479
    assert stated(tmp_path, *[early] * 60, NEW).has_position is False


def test_zeros_are_no_direction(tmp_path):
    zeros = NEW.replace("-43.6", "0.0").replace("-45.3", "0.0").replace("gb_roll: 0.3", "gb_roll: 0.0")
    assert stated(tmp_path, zeros).gimbal_yaw_deg is None


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\xff\xfe\0",
        b"no times",
        b"1\n-->\n[latitude: ] [abs_alt: x]",
        b"-->\n[abs_alt: " + b"9" * 400 + b"]",
    ],
)
def test_what_states_nothing(tmp_path, content):
    (tmp_path / "v.srt").write_bytes(content)
    assert stated_at_start(tmp_path / "v.srt", VIDEO) == VIDEO


def test_which_file_it_is(tmp_path):
    assert find_subtitles(tmp_path / "v.mp4") is None
    (tmp_path / "v.srt").write_text("")
    assert find_subtitles(tmp_path / "v.mp4") == tmp_path / "v.srt"
