"""The tags in a photo's header: EXIF by Pillow, DJI's XMP by the one XML module; damaged ones are absent."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lodbench.citymodel.xml import XmlMembers, local_name, namespace_of
from lodbench.datasets.pictures import stored_size
from lodbench.errors import CityModelError, DatasetError
from lodbench.findings import Findings

# Multi-picture JPEGs, as some drones write, are opened as JPEG.
_FORMATS = ("JPEG", "PNG", "TIFF")
# A JPEG segment holds at most 64 kB; other formats could carry anything.
_MAX_XMP_BYTES = 1 << 20
_DJI_NAMESPACE = "drone-dji"
# EXIF 3.0 tags.
_MAKE, _MODEL, _ORIENTATION = 0x010F, 0x0110, 0x0112
_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_DNG_VERSION = 0xC612
_TAKEN_AT, _TAKEN_FRACTION = 0x9003, 0x9291
_FOCAL_MM, _FOCAL_35MM, _WIDTH, _HEIGHT = 0x920A, 0xA405, 0xA002, 0xA003
_PLANE_X, _PLANE_Y, _PLANE_UNIT, _ZOOM = 0xA20E, 0xA20F, 0xA210, 0xA404
_LAT_REF, _LAT, _LON_REF, _LON, _ALT_REF, _ALT = 1, 2, 3, 4, 5, 6
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0}
# Older firmware misspells the longitude.
_XMP_NUMBERS = {
    "latitude_deg": ("GpsLatitude",),
    "longitude_deg": ("GpsLongitude", "GpsLongtitude"),
    "altitude_m": ("AbsoluteAltitude",),
    "relative_altitude_m": ("RelativeAltitude",),
    "gimbal_yaw_deg": ("GimbalYawDegree",),
    "gimbal_pitch_deg": ("GimbalPitchDegree",),
    "gimbal_roll_deg": ("GimbalRollDegree",),
    "calibrated_focal_px": ("CalibratedFocalLength",),
    "optical_center_x_px": ("CalibratedOpticalCenterX",),
    "optical_center_y_px": ("CalibratedOpticalCenterY",),
}
# DJI's RtkFlag: 32 to 49 are float solutions, 50 is a fixed one, 16 a single point without corrections.
_RTK_FLOAT, _RTK_FIXED, _SINGLE_POINT = 32, 50, 16
# What a height is said to be by (AltitudeType) if the RTK receiver has measured it; drones without one write
# it too.
_BY_RTK = "RtkAlt"
_FIELD_LIMITS = {
    "latitude_deg": 90.0,
    "longitude_deg": 180.0,
    **dict.fromkeys(("gimbal_yaw_deg", "gimbal_pitch_deg", "gimbal_roll_deg"), 360.0),
}


@dataclass(frozen=True, slots=True)
class Dewarp:
    """DJI's calibration of one camera (``DewarpData``), of the full-size picture.

    Attributes:
        date: When it was made, as written.
        fx: Focal length along x, pixels.
        fy: Along y.
        cx: Offset of the principal point from the picture's centre, pixels.
        cy: Likewise.
        distortion: (k1, k2, p1, p2, k3) of OpenCV's formula.
    """

    date: str
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float]


def read_header(path: Path) -> tuple[tuple[int, int], dict[int, Any], bytes]:
    """Returns the size, the EXIF tags (sub-directories as dicts) and the XMP packet.

    Raises:
        DatasetError: The file cannot be read, is no JPEG, PNG or TIFF, raw, or has too many pixels.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        # Drones take 100 and 150 megapixels: Pillow's warning is not heeded, its error from 179 on is.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path, formats=_FORMATS) as image:
                xmp = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or b""
                exif = image.getexif()
                if image.format == "TIFF" and _DNG_VERSION in exif:
                    raise DatasetError(
                        f"{path} is a raw photo (DNG), of which only the preview could be read.",
                        "Take the JPEG beside it, or export it as JPEG or TIFF.",
                    )
                tags = {**exif, _EXIF_IFD: exif.get_ifd(_EXIF_IFD), _GPS_IFD: exif.get_ifd(_GPS_IFD)}
                size = stored_size(image)
    except Image.DecompressionBombError as error:
        raise DatasetError(f"{path} has too many pixels for a photo.", "Scale it down.") from error
    except (FileNotFoundError, PermissionError, IsADirectoryError) as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}.", "Check the path.") from error
    except UnidentifiedImageError as error:
        raise DatasetError(f"{path} is no JPEG, PNG or TIFF picture.", "Export it again.") from error
    except DatasetError:
        raise
    except Exception as error:  # a damaged header makes Pillow raise anything from struct.error to KeyError
        raise DatasetError(f"{path}: its header is damaged ({type(error).__name__}).") from error
    return size, tags, xmp.encode() if isinstance(xmp, str) else bytes(xmp)


def exif_values(tags: Mapping[int, Any]) -> dict[str, Any]:
    """Returns what EXIF tags state, by the names of ``PhotoMetadata``; None for what they do not."""
    exif, gps = tags[_EXIF_IFD], tags[_GPS_IFD]
    altitude = _number(gps.get(_ALT))
    below = gps.get(_ALT_REF) in (1, b"\x01", 3, b"\x03")
    orientation = _number(tags.get(_ORIENTATION))
    width, height = _positive(exif.get(_WIDTH)), _positive(exif.get(_HEIGHT))
    return {
        "make": _text(tags.get(_MAKE)),
        "model": _text(tags.get(_MODEL)),
        "orientation": int(orientation) if orientation is not None else 1,
        "size_when_taken": None if width is None or height is None else (round(width), round(height)),
        "taken_at": _text(exif.get(_TAKEN_AT)),
        "taken_fraction_s": _fraction(exif.get(_TAKEN_FRACTION)),
        **_position(_degrees(gps.get(_LAT), gps.get(_LAT_REF)), _degrees(gps.get(_LON), gps.get(_LON_REF))),
        "altitude_m": -altitude if altitude is not None and below else altitude,
        "focal_mm": _positive(exif.get(_FOCAL_MM)),
        "focal_35mm": _positive(exif.get(_FOCAL_35MM)),
        "pixel_mm": _pixel_mm(exif),
        "digital_zoom": _zoom(exif),
    }


def _fraction(digits: Any) -> float | None:
    """Returns the part of a second whose digits EXIF writes, as many as the camera knows."""
    text = _text(digits)
    return float(f"0.{text}") if text.isascii() and text.isdecimal() else None


def _zoom(exif: Mapping[int, Any]) -> float | None:
    """Returns how much of a digital zoom was used; EXIF writes 0 for none, and less than 1 is none either."""
    ratio = _positive(exif.get(_ZOOM))
    return None if ratio is None or ratio <= 1.0 else ratio


def xmp_values(path: Path, packet: bytes) -> dict[str, Any]:
    """Returns what an XMP packet states, by the names of ``PhotoMetadata``; nothing for what it does not.

    Raises:
        DatasetError: It is no well-formed XML, holds a DOCTYPE, or is too large.
    """
    properties = _dji_properties(path, packet)
    values: dict[str, Any] = {}
    for name, keys in _XMP_NUMBERS.items():
        number = next((n for key in keys if (n := _number(properties.get(key))) is not None), None)
        if number is not None and abs(number) <= _FIELD_LIMITS.get(name, math.inf):
            values[name] = number
    values |= _position(values.pop("latitude_deg", None), values.pop("longitude_deg", None))
    values["dewarp"] = _dewarp(properties.get("DewarpData"))
    values["is_dewarped"] = properties.get("DewarpFlag", "0").strip() == "1"
    values |= _rtk(properties)
    return {name: value for name, value in values.items() if value is not None}


def _rtk(properties: Mapping[str, str]) -> dict[str, bool]:
    """Returns whether a height is an RTK receiver's, and whether nobody says if it is."""
    flag = _number(properties.get("RtkFlag")) or 0.0
    is_single = flag == _SINGLE_POINT
    is_told = is_single and properties.get("AltitudeType", "").strip() == _BY_RTK
    return {
        "has_rtk": is_told or _RTK_FLOAT <= flag <= _RTK_FIXED,
        "is_single_point": is_single and not is_told,
    }


def _position(latitude_deg: float | None, longitude_deg: float | None) -> dict[str, float]:
    """Returns the position, or nothing where it is incomplete, off the globe, or DJI's 0, 0 for no fix."""
    if latitude_deg is None or longitude_deg is None or (latitude_deg == 0 and longitude_deg == 0):
        return {}
    if abs(latitude_deg) > 90 or abs(longitude_deg) > 180:
        return {}
    return {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg}


def _dji_properties(path: Path, packet: bytes) -> dict[str, str]:
    """Returns the properties in DJI's namespace, written as attributes or as elements."""
    if len(packet) > _MAX_XMP_BYTES:
        raise DatasetError(f"{path}: its XMP is larger than {_MAX_XMP_BYTES >> 20} MiB.")
    found: dict[str, str] = {}
    # The packet may be padded with white space, and some writers end it with zeros.
    stream = io.BytesIO(packet.strip(b"\0 \r\n\t"))
    members = XmlMembers(stream, f"{path}, XMP", ("RDF", "Description"), Findings())
    try:
        for member in members:
            for element in member.iter():
                pairs = [*element.items(), (element.tag, element.text)]
                for name, value in pairs:
                    if (
                        isinstance(name, str)
                        and isinstance(value, str)
                        and _DJI_NAMESPACE in namespace_of(name)
                    ):
                        found.setdefault(local_name(name), value)
    except CityModelError as error:
        raise DatasetError(
            error.message, "Remove the XMP, or copy the photo from the drone again."
        ) from error
    return found


def _dewarp(text: str | None) -> Dewarp | None:
    """Returns ``date;fx,fy,cx,cy,k1,k2,p1,p2,k3`` taken apart, or None where it is anything else."""
    date, _, listed = (text or "").rpartition(";")
    numbers = [_number(word) for word in listed.split(",")]
    values = [number for number in numbers if number is not None]
    if len(values) != 9 or len(numbers) != 9 or values[0] <= 0 or values[1] <= 0:
        return None
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = values
    return Dewarp(date, fx, fy, cx, cy, (k1, k2, p1, p2, k3))


def _pixel_mm(exif: Mapping[int, Any]) -> tuple[float, float] | None:
    per_x, per_y = _positive(exif.get(_PLANE_X)), _positive(exif.get(_PLANE_Y))
    unit = _MM_PER_UNIT.get(exif.get(_PLANE_UNIT, 2))
    return None if per_x is None or per_y is None or unit is None else (unit / per_x, unit / per_y)


def _degrees(parts: Any, reference: Any) -> float | None:
    """Returns degrees, minutes and seconds as signed degrees."""
    try:
        numbers = [_number(part) for part in parts]
    except TypeError:
        return None
    if len(numbers) != 3 or None in numbers:
        return None
    degrees, minutes, seconds = (float(number) for number in numbers if number is not None)
    sign = -1.0 if _text(reference).upper() in ("S", "W") else 1.0
    return sign * (degrees + minutes / 60 + seconds / 3600)


def _number(value: Any) -> float | None:
    """Returns a finite number, or None: EXIF has rationals with zero below, XMP any text."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def _positive(value: Any) -> float | None:
    number = _number(value)
    return number if number is not None and number > 0 else None


def _text(value: Any) -> str:
    text = value.decode("ascii", "replace") if isinstance(value, bytes) else str(value or "")
    return text.split("\0", 1)[0].strip()
