"""Subtitles as DJI's drones write them beside videos, of several years; every file is written here."""

import pytest

from lodbench.photos.metadata import PhotoMetadata, find_subtitles, stated_at_start

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
