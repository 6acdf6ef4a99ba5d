"""What XMP states of a photo: the makers' properties, read by the one XML module; damaged ones are absent.

Makers are read whose angles are, by documentation or name, those of DJI's gimbals: yaw clockwise from true
north, pitch 0 at the horizon and -90 straight down, roll about the optical axis, in that order, in a
north-east-down frame.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from lodbench.citymodel.gml.xml import Element, XmlMembers, local_name, namespace_of
from lodbench.errors import CityModelError, DatasetError
from lodbench.findings import Findings
from lodbench.photos.tags import exif_values, number_of, place_of, tags_in_xmp

# A JPEG segment holds at most 64 kB; other formats could carry anything.
_MAX_XMP_BYTES = 1 << 20
_DJI = "drone-dji"
# By a part of a namespace's URI: what its properties are called, by the names of ``PhotoMetadata``; a field
# of a structure follows its name and a slash. The first namespace that states something counts.
_PROPERTIES: dict[str, dict[str, tuple[str, ...]]] = {
    # Autel's newer drones write the same, by another prefix.
    _DJI: {
        "latitude_deg": ("GpsLatitude",),
        # Older firmware, and Autel's, misspells the longitude.
        "longitude_deg": ("GpsLongitude", "GpsLongtitude"),
        "altitude_m": ("AbsoluteAltitude",),
        "relative_altitude_m": ("RelativeAltitude",),
        "gimbal_yaw_deg": ("GimbalYawDegree",),
        "gimbal_pitch_deg": ("GimbalPitchDegree",),
        "gimbal_roll_deg": ("GimbalRollDegree",),
        "calibrated_focal_px": ("CalibratedFocalLength",),
        "optical_center_x_px": ("CalibratedOpticalCenterX",),
        "optical_center_y_px": ("CalibratedOpticalCenterY",),
    },
    # Place and height are in Parrot's EXIF.
    "drone-parrot": {
        "gimbal_yaw_deg": ("CameraYawDegree",),
        "gimbal_pitch_deg": ("CameraPitchDegree",),
        "gimbal_roll_deg": ("CameraRollDegree",),
    },
    "drone-skydio": {
        "latitude_deg": ("Latitude",),
        "longitude_deg": ("Longitude",),
        "altitude_m": ("AbsoluteAltitude",),
        "gimbal_yaw_deg": ("CameraOrientationNED/Yaw",),
        "gimbal_pitch_deg": ("CameraOrientationNED/Pitch",),
        "gimbal_roll_deg": ("CameraOrientationNED/Roll",),
        "calibrated_focal_px": ("CalibratedFocalLength/X", "CalibratedFocalLength"),
        "calibrated_focal_y_px": ("CalibratedFocalLength/Y",),
        "optical_center_x_px": ("CalibratedOpticalCenter/X", "CalibratedOpticalCenterX"),
        "optical_center_y_px": ("CalibratedOpticalCenter/Y", "CalibratedOpticalCenterY"),
    },
}
# What programs repeat of EXIF, in its own terms.
_REPEATED = ("ns.adobe.com/exif/", "ns.adobe.com/tiff/")
_PANORAMA = "ns.google.com/photos/1.0/panorama"
# Stitched pictures that are as flat as a photo.
_FLAT = ("perspective", "rectilinear")
_PIX4D = ("pix4d.com/camera", "sensefly.com/camera")
# Of any maker; names of the diagonal or of nothing are not read, for they are used for either.
_FIELD_OF_VIEW = re.compile(
    r"(?:camera|picture|lens|sensor)?(?:(h|v)(?:oriz|ert)?(?:ontal|ical)?_?(?:fov|fieldofview)"
    r"|(?:fov|fieldofview)_?(h|v)(?:oriz|ert)?(?:ontal|ical)?)(?:deg|degrees?)?",
    re.IGNORECASE,
)
# Where a packet begins, behind whatever a program has put before it.
_BEGINS = re.compile(rb"<\?xpacket|<\?xml|<(?:\w+:)?xmpmeta|<(?:\w+:)?RDF")
_ANGLES = ("gimbal_yaw_deg", "gimbal_pitch_deg", "gimbal_roll_deg")
_FIELD_LIMITS = {"latitude_deg": 90.0, "longitude_deg": 180.0, **dict.fromkeys(_ANGLES, 360.0)}
# Angles of other makers. Pitch in Pix4D's Camera: is 0 straight down by its definition and in some makers'
# photos, 0 at the horizon or relative to the aircraft in others'; roll has either sign. Others are of the
# aircraft.
_OTHER_ANGLE = re.compile(
    r"(camera|gimbal|mav|platform|flight|drone)?(yaw|pitch|roll)(degree)?", re.IGNORECASE
)
_ZEROS = "its XMP states zeros for all angles, as drones do that do not know them"
_WRITTEN_NUMBER = re.compile(r"[-+]?[\d./]{1,16}")
# Of a light sensor on the roof.
_LIGHT_SENSOR = "/dls/"
# DJI's RtkFlag: 32 to 49 are float solutions, 50 is a fixed one, 16 a single point without corrections.
_RTK_FLOAT, _RTK_FIXED, _SINGLE_POINT = 32, 50, 16
# Standard deviations, metres and degrees, and which of x, y, z, pitch, roll, yaw they are of: DJI's RTK
# receiver's, and those of Pix4D's terms, of any maker.
_SIGMAS = {
    **{
        "RtkStdLon": (0,),
        "RtkStdLat": (1,),
        "RtkStdHgt": (2,),
        "GPSXYAccuracy": (0, 1),
        "GPSZAccuracy": (2,),
    },
    **{"IMUPitchAccuracy": (3,), "IMURollAccuracy": (4,), "IMUYawAccuracy": (5,)},
}
_MOST_SIGMA = 100.0
# What a height is said to be by (AltitudeType) if the RTK receiver has measured it; drones without one write
# it too.
_BY_RTK = "RtkAlt"
# What Pix4D and Skydio call the reference of heights.
_VERTICAL_REFERENCE = "VertCS"
# Elements that hold properties, and are none themselves.
_FRAMES = ("http://www.w3.org/1999/02/22-rdf-syntax-ns#", "adobe:ns:meta/")


@dataclass(frozen=True, slots=True)
class Dewarp:
    """DJI's calibration of one camera (``DewarpData``), of the full-size picture."""

    date: str  # when it was made, as written
    fx: float  # focal length along x, pixels
    fy: float  # along y
    cx: float  # offset of the principal point from the picture's centre, pixels
    cy: float  # likewise
    distortion: tuple[float, float, float, float, float]  # (k1, k2, p1, p2, k3) of OpenCV's formula


@dataclass(frozen=True, slots=True)
class LaserRange:
    """A range that a drone's laser measured as the photo was taken, along the ray of the photo's centre."""

    range_m: float  # from the camera to what the beam met, metres
    # Of what it met, by the drone's own place and angles, WGS 84; None where not stated
    latitude_deg: float | None = None
    longitude_deg: float | None = None  # likewise
    altitude_m: float | None = None  # likewise, its absolute altitude, metres
    relative_altitude_m: float | None = None  # likewise, its height above the take-off point, metres
    stated_sigma_m: float | None = None  # standard deviation of the range where somebody states one, metres

    @property
    def sigma_m(self) -> float:
        """Returns the standard deviation of the range, metres: as stated, or by the maker's data sheets."""
        return 0.2 + 0.0015 * self.range_m if self.stated_sigma_m is None else self.stated_sigma_m


class _Property(NamedTuple):
    namespace: str
    prefix: str
    name: str
    value: str


def xmp_values(path: Path, packet: bytes) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns what an XMP packet states, by the names of ``PhotoMetadata``; nothing for what it does not.

    The first has what makers say in their own terms, the second what is there of EXIF's, which a program may
    have copied long ago.

    Raises:
        DatasetError: It is no well-formed XML, holds a DOCTYPE, or is too large.
    """
    properties = _properties(path, packet)
    values: dict[str, Any] = {}
    for part in _PROPERTIES:
        stated = _numbers(properties, part)
        if not values.keys().isdisjoint(_ANGLES):  # those of two makers are never mixed
            stated = _without_angles(stated)
        values = stated | values
    # Some drones of DJI (Mini 2, some P1) and of Autel write zeros wherever they look.
    if all(values.get(name) == 0 for name in _ANGLES):
        values = _without_angles(values) | {"why_no_angles": _ZEROS}
    elif not {"gimbal_yaw_deg", "gimbal_pitch_deg"} <= values.keys():
        values["why_no_angles"] = _other_angles(properties)
    dji = _of(properties, _DJI)
    values["dewarp"] = _dewarp(dji.get("DewarpData"))
    values["is_dewarped"] = dji.get("DewarpFlag", "0").strip() == "1"
    values["laser"], no_laser = _laser(dji)
    values |= _rtk(dji) | _sigmas(properties, dji, no_laser)
    values = _pix4d(properties) | _field_of_view(properties) | values
    values["projection"] = _projection(properties)
    references = [each.value.strip() for each in properties if each.name == _VERTICAL_REFERENCE]
    values["vertical_reference"] = references[0] if references else ""
    repeated = {name: value for part in _REPEATED for name, value in _of(properties, part).items()}
    return _known(values), _known(exif_values(tags_in_xmp(repeated)))


def _known(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None and value != ""}


def _projection(properties: list[_Property]) -> str:
    """Returns how a stitched panorama is laid flat; "" for a picture that a lens has made."""
    stated = _of(properties, _PANORAMA)
    is_one = "FullPanoWidthPixels" in stated or stated.get("UsePanoramaViewer", "").strip().lower() == "true"
    name = stated.get("ProjectionType", "equirectangular" if is_one else "").strip().lower()
    return "" if name in _FLAT else name


def _field_of_view(properties: list[_Property]) -> dict[str, float]:
    """Returns the fields of view that XMP states, degrees, across and down."""
    fields_deg: dict[str, float] = {}
    for each in properties:
        match = _FIELD_OF_VIEW.fullmatch(each.name.rpartition("/")[2])
        number = number_of(each.value.rstrip(" \N{DEGREE SIGN}degrs")) if match else None
        if match and number is not None and 0 < number < 180:
            axis = (match[1] or match[2]).lower()
            fields_deg.setdefault("field_across_deg" if axis == "h" else "field_down_deg", number)
    return fields_deg


def _pix4d(properties: list[_Property]) -> dict[str, float]:
    """Returns the focal length in Pix4D's terms: in millimetres, or in pixels where it says so."""
    stated = {name: value for part in _PIX4D for name, value in _of(properties, part).items()}
    number = number_of(stated.get("PerspectiveFocalLength"))
    if number is None or number <= 0 or stated.get("ModelType", "perspective").strip() != "perspective":
        return {}
    unit = stated.get("PerspectiveFocalLengthUnits", "mm").strip().lower()
    return {"focal_mm": number} if unit == "mm" else {"calibrated_focal_px": number} if "pix" in unit else {}


def _of(properties: list[_Property], part: str) -> dict[str, str]:
    """Returns the properties of the namespaces whose URI has a part; the first of a name.

    DJI's count wherever they stand: it writes no structures, but programs may put all into one.
    """
    own = [each for each in reversed(properties) if part in each.namespace]
    return {each.name.rpartition("/")[2] if part == _DJI else each.name: each.value for each in own}


def _numbers(properties: list[_Property], part: str) -> dict[str, float]:
    """Returns the numbers of a maker's namespace by the names of ``PhotoMetadata``."""
    own = _of(properties, part)
    numbers: dict[str, float] = {}
    for name, keys in _PROPERTIES[part].items():
        number = next((n for key in keys if (n := number_of(own.get(key))) is not None), None)
        if number is not None and abs(number) <= _FIELD_LIMITS.get(name, math.inf):
            numbers[name] = number
    return numbers | place_of(numbers.pop("latitude_deg", None), numbers.pop("longitude_deg", None))


def _without_angles(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if name not in _ANGLES}


def _other_angles(properties: list[_Property]) -> str:
    """Returns a clause that quotes the angles of namespaces that are not read; "" where there are none."""
    angles: dict[str, str] = {}
    for each in properties:
        is_read = any(part in each.namespace for part in _PROPERTIES)
        is_angle = _OTHER_ANGLE.fullmatch(each.name.rpartition("/")[2])
        if is_angle and not is_read and _LIGHT_SENSOR not in each.namespace.lower():
            number = _WRITTEN_NUMBER.fullmatch(each.value.strip())
            name = f"{each.prefix[:20]}:{each.name[:40]}" if each.prefix else each.name[:40]
            angles.setdefault(name, f"{name} {number[0]}" if number else name)
    listed = ", ".join([*angles.values()][:6])
    return f"its XMP states {listed}, which makers mean differently" if listed else ""


def _laser(properties: Mapping[str, str]) -> tuple[LaserRange | None, str]:
    """Returns the range of DJI's laser (``LRF...``), or why one that is stated is none."""
    stated = {
        name.lower().removeprefix("lrf"): text for name, text in properties.items() if "LRF" in name.upper()
    }
    distance = number_of(stated.get("targetdistance"))
    status = stated.get("status", "").strip()
    if status.lower() != "normal" or distance is None or distance <= 0:
        reason = f"LRFStatus {status[:20]!r}, LRFTargetDistance {stated.get('targetdistance', '')[:20]!r}"
        return None, f"the laser measured nothing: {reason}" if stated else ""
    place = place_of(number_of(stated.get("targetlat")), number_of(stated.get("targetlon")))
    heights = (number_of(stated.get(name)) for name in ("targetabsalt", "targetalt"))
    return LaserRange(distance, place.get("latitude_deg"), place.get("longitude_deg"), *heights), ""


def _rtk(properties: Mapping[str, str]) -> dict[str, bool]:
    """Returns whether a height is an RTK receiver's, and whether nobody says if it is."""
    flag = number_of(properties.get("RtkFlag")) or 0.0
    is_single = flag == _SINGLE_POINT
    is_rtk = is_single and properties.get("AltitudeType", "").strip() == _BY_RTK
    return {
        "has_rtk": is_rtk or _RTK_FLOAT <= flag <= _RTK_FIXED,
        "is_single_point": is_single and not is_rtk,
    }


def _sigmas(properties: list[_Property], dji: Mapping[str, str], no_laser: str) -> dict[str, Any]:
    """Returns how well place and angles are known, as ``PhotoMetadata`` has it, and what is refused and why.

    DJI's RTK receiver goes before what Pix4D's terms state; without a position it has no deviation.
    """
    sigmas: list[float | None] = [None] * 6
    refused = [no_laser] if no_laser else []
    flag = number_of(dji.get("RtkFlag")) or 0.0
    has_position = flag == _SINGLE_POINT or _RTK_FLOAT <= flag <= _RTK_FIXED
    pix4d = {name: value for part in _PIX4D for name, value in _of(properties, part).items()}
    for name, axes in _SIGMAS.items():
        text = dji.get(name) if name.startswith("Rtk") else pix4d.get(name)
        number = number_of(text)
        if text is None:
            continue
        if number is None or not 0 < number <= _MOST_SIGMA:
            refused.append(f"{name} {text.strip()[:20]!r} is no standard deviation")
        elif name.startswith("Rtk") and not has_position:
            refused.append(f"{name} is of no position: RtkFlag {flag:g}")
        else:
            sigmas = [number if k in axes and own is None else own for k, own in enumerate(sigmas)]
    return {"sigmas": tuple(sigmas), "refused": tuple(refused)}


def _properties(path: Path, packet: bytes) -> list[_Property]:
    """Returns all properties of a packet with a namespace, written as attributes or as elements."""
    if len(packet) > _MAX_XMP_BYTES:
        raise DatasetError(f"{path}: its XMP is larger than {_MAX_XMP_BYTES >> 20} MiB.")
    stream = io.BytesIO(_trimmed(packet))
    members = XmlMembers(stream, f"{path}, XMP", ("RDF", "Description"), Findings())
    try:
        return [each for member in members for each in _stated_in(member)]
    except CityModelError as error:
        raise DatasetError(
            error.message, "Remove the XMP, or copy the photo from the drone again."
        ) from error


def _trimmed(packet: bytes) -> bytes:
    """Returns a packet without what programs put around it: a name (GDAL), white space, zeros."""
    packet = packet.strip(b"\0 \r\n\t")
    begins = _BEGINS.search(packet)
    if begins is None or packet.startswith((b"<", b"\xef\xbb\xbf<", b"\xfe\xff", b"\xff\xfe")):
        return packet
    return packet[begins.start() : packet.rfind(b">") + 1]


def _stated_in(member: Element) -> Iterator[_Property]:
    """Yields the properties that elements and their attributes are; a structure's fields after its name."""
    owners: dict[Element | None, str] = {}
    prefixes: dict[str, str] = {}
    for element in member.iter():
        above = owners.get(element.getparent(), "")
        is_frame = namespace_of(element.tag) in _FRAMES
        owners[element] = above if is_frame else local_name(element.tag)
        pairs = [(owners[element], name, value) for name, value in element.items()]
        for owner, tag, value in [*pairs, (above, element.tag, element.text)]:
            namespace, name = namespace_of(str(tag)), local_name(str(tag))
            if not namespace and ":" in name:  # a prefix that nothing declares, as some programs leave it
                namespace, name = name.split(":", 1)
            if isinstance(value, str) and namespace and namespace not in _FRAMES:
                if namespace not in prefixes:
                    prefixes[namespace] = next(
                        (prefix for prefix, uri in element.nsmap.items() if prefix and uri == namespace), ""
                    )
                full = f"{owner}/{name}" if owner else name
                yield _Property(namespace, prefixes[namespace], full, value)


def _dewarp(text: str | None) -> Dewarp | None:
    """Returns ``date;fx,fy,cx,cy,k1,k2,p1,p2,k3`` taken apart, or None where it is anything else."""
    date, _, listed = (text or "").rpartition(";")
    numbers = [number_of(word) for word in listed.split(",")]
    values = [number for number in numbers if number is not None]
    if len(values) != 9 or len(numbers) != 9 or values[0] <= 0 or values[1] <= 0:
        return None
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = values
    return Dewarp(date, fx, fy, cx, cy, (k1, k2, p1, p2, k3))
