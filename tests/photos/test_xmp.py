"""XMP of other makers than DJI, as their photos have it: what is read, and what is told but not believed."""

import numpy as np
import pytest

from lodbench.errors import DatasetError
from lodbench.geometry.angles import rotation_from_dji
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.metadata import PhotoMetadata, read_photo_metadata
from lodbench.photos.pose import pose_from_photo
from lodbench.photos.xmp import LaserRange
from tests.photos.dji_photo import PROPERTIES, exif_of, packet_around, write_photo, xmp_packet

NRW = MapFrame("EPSG:25832+7837")
PARROT = "http://www.parrot.com/drone-parrot/1.0/"
SKYDIO = "https://www.skydio.com/drone-skydio/1.0/"
PIX4D = "http://pix4d.com/camera/1.0/"
# An example of Parrot's documentation states one attitude in both conventions.
ANAFI = f"""<rdf:Description rdf:about="" xmlns:Camera="{PIX4D}" xmlns:drone-parrot="{PARROT}">
 <Camera:Roll>-0.041258</Camera:Roll><Camera:Pitch>38.011101</Camera:Pitch><Camera:Yaw>146.781036</Camera:Yaw>
 <drone-parrot:CameraRollDegree>-0.052789</drone-parrot:CameraRollDegree>
 <drone-parrot:CameraPitchDegree>-51.988888</drone-parrot:CameraPitchDegree>
 <drone-parrot:CameraYawDegree>146.848038</drone-parrot:CameraYawDegree></rdf:Description>"""
_FIELDS = {"Roll": "0.186841", "Pitch": "-7.468572", "Yaw": "127.444323"}
_AS_ELEMENTS = "".join(f"<s:{key}>{value}</s:{key}>" for key, value in _FIELDS.items())
_AS_ATTRIBUTES = " ".join(f's:{key}="{value}"' for key, value in _FIELDS.items())
# The three ways in which RDF writes a structure.
STRUCTURES = {
    "resource": f'<s:CameraOrientationNED rdf:parseType="Resource">{_AS_ELEMENTS}</s:CameraOrientationNED>',
    "node": f"<s:CameraOrientationNED><rdf:Description {_AS_ATTRIBUTES}/></s:CameraOrientationNED>",
    "attributes": f"<s:CameraOrientationNED {_AS_ATTRIBUTES}/>",
}


def photo_of(folder, body: str, **exif: str) -> PhotoMetadata:
    tags = exif_of(51.0479, 5.869, 203.4, **{"make": "Other", "model": "", **exif})
    return read_photo_metadata(write_photo(folder / "a.jpg", exif=tags, xmp=packet_around(body)))


def camera_xmp(yaw: str, pitch: str, roll: str = "0", uri: str = PIX4D) -> str:
    return (
        f'<rdf:Description rdf:about="" xmlns:Camera="{uri}" Camera:Yaw="{yaw}" Camera:Pitch="{pitch}" '
        f'Camera:Roll="{roll}"/>'
    )


def test_parrot_s_own_angles_are_those_of_gimbals_and_its_place_is_in_exif(tmp_path):
    photo = photo_of(tmp_path, ANAFI, make="Parrot", model="ANAFI USA")
    angles = (photo.gimbal_yaw_deg, photo.gimbal_pitch_deg, photo.gimbal_roll_deg)
    assert angles == (146.848038, -51.988888, -0.052789)
    assert photo.latitude_deg == pytest.approx(51.0479, abs=3e-8)
    assert photo.altitude_m == 203.4
    assert photo.why_no_angles == ""
    pose = pose_from_photo(photo, NRW)
    east, north = pose.center[:2]
    looks = pose.rotation[2]
    assert np.degrees(np.arcsin(looks[2])) == pytest.approx(-51.988888, abs=1e-6)
    bearing = np.degrees(np.arctan2(looks[0], looks[1])) + NRW.convergence_deg(east, north)
    assert bearing == pytest.approx(146.848038, abs=0.2)


@pytest.mark.parametrize("structure", STRUCTURES.values(), ids=STRUCTURES)
def test_skydio_s_structures_in_every_form_of_rdf(tmp_path, structure):
    flight = structure.replace("CameraOrientationNED", "VehicleOrientationNED").replace("127.4", "99.9")
    body = (
        f'<rdf:Description rdf:about="" xmlns:s="{SKYDIO}" s:Latitude="32.518935" s:Longitude="-110.924547" '
        f's:AbsoluteAltitude="1034.441910">{flight}{structure}</rdf:Description>'
    )
    photo = photo_of(tmp_path, body, make="Skydio")
    assert (photo.latitude_deg, photo.longitude_deg) == (32.518935, -110.924547)
    assert photo.altitude_m == 1034.44191
    assert (photo.gimbal_yaw_deg, photo.gimbal_pitch_deg) == (127.444323, -7.468572)
    assert photo.gimbal_roll_deg == 0.186841


def test_autel_s_newer_photos_have_dji_s_properties_by_another_prefix(tmp_path):
    packet = xmp_packet({**PROPERTIES, "GpsLongtitude": "5.25"}).replace(b"drone-dji:", b"drone:")
    packet = packet.replace(b"xmlns:drone-dji=", b"xmlns:drone=").replace(b"drone:GpsLongitude", b"drone:X")
    photo = read_photo_metadata(write_photo(tmp_path / "a.jpg", exif=exif_of(make="Autel"), xmp=packet))
    assert (photo.longitude_deg, photo.gimbal_yaw_deg, photo.gimbal_pitch_deg) == (5.25, -43.6, -45.3)


@pytest.mark.parametrize(("roll", "expected"), [("+0.00", None), ("-0.10", 0.0)])
def test_three_zeros_are_no_direction(tmp_path, roll, expected):
    level = {"GimbalYawDegree": "+0.00", "GimbalPitchDegree": "+0.00", "GimbalRollDegree": roll}
    path = write_photo(tmp_path / "a.jpg", exif=exif_of(), xmp=xmp_packet({**PROPERTIES, **level}))
    photo = read_photo_metadata(path)
    assert (photo.gimbal_yaw_deg, photo.gimbal_pitch_deg) == (expected, expected)
    if expected is None:
        with pytest.raises(DatasetError, match="states zeros for all angles") as fault:
            pose_from_photo(photo, NRW)
        assert "--heading and --pitch" in fault.value.hint


def test_angles_of_two_makers_are_not_mixed(tmp_path):
    packet = xmp_packet({"GpsLatitude": "51.5", "GpsLongitude": "5.5", "GimbalPitchDegree": "-30"})
    body = packet[packet.index(b"<rdf:Description") : packet.index(b"</rdf:RDF>")].decode()
    photo = photo_of(tmp_path, body + ANAFI)
    assert photo.latitude_deg == 51.5
    assert (photo.gimbal_yaw_deg, photo.gimbal_pitch_deg) == (None, -30.0)
    # A program that adds a place by DJI's names leaves the maker's angles.
    packet = xmp_packet({"GpsLatitude": "51.5", "GpsLongitude": "5.5"})
    body = packet[packet.index(b"<rdf:Description") : packet.index(b"</rdf:RDF>")].decode()
    photo = photo_of(tmp_path, body + ANAFI)
    assert (photo.latitude_deg, photo.gimbal_pitch_deg) == (51.5, -51.988888)


@pytest.mark.parametrize(
    ("body", "told"),
    [
        (camera_xmp("12.5", "1.25", "-0.5"), "Camera:Yaw 12.5, Camera:Pitch 1.25, Camera:Roll -0.5"),
        (camera_xmp("12.5", "-90", uri="http://ns.sensefly.com/Camera/1.0/"), "Camera:Pitch -90"),
        (
            '<rdf:Description xmlns:FLIR="http://ns.flir.com/xmp/1.0/"><FLIR:MAVYaw>1250/100</FLIR:MAVYaw>'
            "<FLIR:MAVYawRate>3/100</FLIR:MAVYawRate></rdf:Description>",
            "states FLIR:MAVYaw 1250/100, which",
        ),
        (camera_xmp("north", "&lt;b&gt;"), "states Camera:Yaw, Camera:Pitch, Camera:Roll 0, which"),
    ],
)
def test_angles_that_makers_mean_differently_are_reported_and_not_guessed(tmp_path, body, told):
    photo = photo_of(tmp_path, body)
    assert (photo.gimbal_yaw_deg, photo.gimbal_pitch_deg, photo.gimbal_roll_deg) == (None, None, None)
    with pytest.raises(DatasetError, match="where its camera looked") as fault:
        pose_from_photo(photo, NRW)
    assert told in fault.value.message
    assert "makers mean differently" in fault.value.message
    assert "--heading and --pitch" in fault.value.hint
    assert "\n" not in str(fault.value)


@pytest.mark.parametrize(
    "around",
    [
        "<d:Photo {} {}/>",
        "<rdf:Description {}><d:Shot><rdf:Description {}/></d:Shot></rdf:Description>",
        "<rdf:Description {}><d:Shots><rdf:Bag><rdf:li {}/></rdf:Bag></d:Shots></rdf:Description>",
    ],
)
def test_dji_s_properties_count_within_other_elements_too(tmp_path, around):
    written = " ".join(f'd:{key}="{value}"' for key, value in {**PROPERTIES, "RtkFlag": "50"}.items())
    photo = photo_of(tmp_path, around.format('xmlns:d="http://www.dji.com/drone-dji/1.0/"', written))
    assert (photo.gimbal_yaw_deg, photo.gimbal_pitch_deg, photo.has_rtk) == (-43.6, -45.3, True)


def test_a_light_sensor_s_angles_are_none_of_the_camera(tmp_path):
    body = '<rdf:Description xmlns:DLS="http://micasense.com/DLS/1.0/" DLS:Yaw="1.2" DLS:Pitch="0.1"/>'
    assert photo_of(tmp_path, body).why_no_angles == ""


def test_frames_within_frames_take_no_time(tmp_path):
    deep = "<rdf:Description>" * 1500 + '<rdf:li xmlns:q="urn:q" q:Yaw="1"/>' * 20000
    body = f"{deep}{'</rdf:Description>' * 1500}"
    assert "states q:Yaw 1, which" in photo_of_long(tmp_path, body).why_no_angles


def photo_of_long(folder, body: str) -> PhotoMetadata:
    """Returns what a PNG says: it may hold more than a JPEG's segment."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    text = PngInfo()
    text.add_itxt("XML:com.adobe.xmp", packet_around(body).decode())
    Image.new("L", (8, 6)).save(folder / "a.png", pnginfo=text)
    return read_photo_metadata(folder / "a.png")


@pytest.mark.parametrize("yaw", [100.0, -30.0])
def test_past_straight_down_yaw_and_roll_turn_together(yaw):
    # Gimbals that tilt a little past the nadir write the other half turn: 180 degrees of yaw and of roll.
    before = rotation_from_dji(yaw, -89.9, 0.0)
    past = rotation_from_dji(yaw + 180.0, -89.9, 180.0)
    apart = np.degrees(np.arccos((np.trace(before @ past.T) - 1) / 2))
    assert apart == pytest.approx(0.2, abs=1e-6)


LASER = {
    "LRFStatus": "Normal",
    "LRFTargetDistance": "123.400",
    "LRFTargetLon": "5.8710000",
    "LRFTargetLat": "51.0490000",
    "LRFTargetAlt": "12.300",
    "LRFTargetAbsAlt": "89.100",
}


@pytest.mark.parametrize("as_elements", [False, True])
def test_a_laser_s_range_is_read(tmp_path, as_elements):
    packet = xmp_packet({**PROPERTIES, **LASER}, as_elements)
    laser = read_photo_metadata(write_photo(tmp_path / "a.jpg", exif=exif_of(), xmp=packet)).laser
    assert laser == LaserRange(123.4, 51.049, 5.871, 89.1, 12.3)
    assert laser.sigma_m == pytest.approx(0.2 + 0.0015 * 123.4)


@pytest.mark.parametrize(
    "changed",
    [
        {"LRFStatus": "Too far"},
        {"LRFStatus": ""},
        {"LRFTargetDistance": "0.000"},
        {"LRFTargetDistance": "far"},
    ],
    ids=str,
)
def test_a_laser_that_did_not_measure_is_not_believed(tmp_path, changed):
    packet = xmp_packet({**PROPERTIES, **LASER, **changed})
    assert read_photo_metadata(write_photo(tmp_path / "a.jpg", exif=exif_of(), xmp=packet)).laser is None


def test_a_range_without_a_place_of_its_target_is_one(tmp_path):
    packet = xmp_packet(
        {"LRFStatus": "normal", "LRFTargetDistance": "80", "LRFTargetLat": "0", "LRFTargetLon": "0"}
    )
    laser = read_photo_metadata(write_photo(tmp_path / "a.jpg", exif=exif_of(), xmp=packet)).laser
    assert laser == LaserRange(80.0)
