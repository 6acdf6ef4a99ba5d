"""The tags in a photo's header, read by Pillow: EXIF's, and the XMP packet; damaged ones are absent."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lodbench.errors import DatasetError
from lodbench.photos.pictures import stored_size

# Multi-picture JPEGs, as some drones write, are opened as JPEG.
_FORMATS = ("JPEG", "PNG", "TIFF")
# EXIF 3.0 tags.
_MAKE, _MODEL, _ORIENTATION = 0x010F, 0x0110, 0x0112
_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_DNG_VERSION = 0xC612
_VERSION, _TAKEN_AT, _TAKEN_FRACTION = 0x9000, 0x9003, 0x9291
_FOCAL_MM, _FOCAL_35MM, _WIDTH, _HEIGHT = 0x920A, 0xA405, 0xA002, 0xA003
_PLANE_X, _PLANE_Y, _PLANE_UNIT, _ZOOM = 0xA20E, 0xA20F, 0xA210, 0xA404
_LAT_REF, _LAT, _LON_REF, _LON, _ALT_REF, _ALT = 1, 2, 3, 4, 5, 6
# GPSAltitudeRef: 0 and 1 are above and below sea level, since EXIF 3.0 the ellipsoid, which has 2 and 3 for
# sea level; programs that took up the new version's number need not have taken up the new meaning.
_BELOW, _OF_EITHER = (1, 3), (0, 1)
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0}
# What XMP calls EXIF's tags, for those that are numbers.
_IN_XMP = {
    "FocalLength": _FOCAL_MM,
    "FocalLengthIn35mmFilm": _FOCAL_35MM,
    "FocalPlaneXResolution": _PLANE_X,
    "FocalPlaneYResolution": _PLANE_Y,
    "DigitalZoomRatio": _ZOOM,
    "PixelXDimension": _WIDTH,
    "PixelYDimension": _HEIGHT,
}


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
        raise DatasetError(f"{path} is not a JPEG, PNG or TIFF picture.", "Export it again.") from error
    except DatasetError:
        raise
    except Exception as error:  # a damaged header makes Pillow raise anything from struct.error to KeyError
        raise DatasetError(f"{path}: its header is damaged ({type(error).__name__}).") from error
    return size, tags, xmp.encode() if isinstance(xmp, str) else bytes(xmp)


def exif_values(tags: Mapping[int, Any]) -> dict[str, Any]:
    """Returns what EXIF tags state, by the names of ``PhotoMetadata``; None for what they do not."""
    exif, gps = tags[_EXIF_IFD], tags[_GPS_IFD]
    altitude = number_of(gps.get(_ALT))
    reference = _byte(gps.get(_ALT_REF))
    orientation = number_of(tags.get(_ORIENTATION))
    width, height = _positive(exif.get(_WIDTH)), _positive(exif.get(_HEIGHT))
    return {
        "make": _text(tags.get(_MAKE)),
        "model": _text(tags.get(_MODEL)),
        "orientation": int(orientation) if orientation is not None else 1,
        "size_when_taken": None if width is None or height is None else (round(width), round(height)),
        "taken_at": _text(exif.get(_TAKEN_AT)),
        "taken_fraction_s": _fraction(exif.get(_TAKEN_FRACTION)),
        **place_of(_degrees(gps.get(_LAT), gps.get(_LAT_REF)), _degrees(gps.get(_LON), gps.get(_LON_REF))),
        "altitude_m": -altitude if altitude is not None and reference in _BELOW else altitude,
        "is_exif3_height": altitude is not None
        and reference in _OF_EITHER
        and _text(exif.get(_VERSION)) >= "0300",
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


def place_of(latitude_deg: float | None, longitude_deg: float | None) -> dict[str, float]:
    """Returns the position, or nothing where it is incomplete, off the globe, or DJI's 0, 0 for no fix."""
    if latitude_deg is None or longitude_deg is None or (latitude_deg == 0 and longitude_deg == 0):
        return {}
    if abs(latitude_deg) > 90 or abs(longitude_deg) > 180:
        return {}
    return {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg}


def _pixel_mm(exif: Mapping[int, Any]) -> tuple[float, float] | None:
    per_x, per_y = _positive(exif.get(_PLANE_X)), _positive(exif.get(_PLANE_Y))
    unit = _MM_PER_UNIT.get(exif.get(_PLANE_UNIT, 2))
    return None if per_x is None or per_y is None or unit is None else (unit / per_x, unit / per_y)


def _degrees(parts: Any, reference: Any) -> float | None:
    """Returns degrees, minutes and seconds as signed degrees."""
    try:
        numbers = [number_of(part) for part in parts]
    except TypeError:
        return None
    if len(numbers) != 3 or None in numbers:
        return None
    degrees, minutes, seconds = (float(number) for number in numbers if number is not None)
    sign = -1.0 if _text(reference).upper() in ("S", "W") else 1.0
    return sign * (degrees + minutes / 60 + seconds / 3600)


def tags_in_xmp(stated: Mapping[str, str]) -> dict[int, Any]:
    """Returns EXIF's tags that XMP repeats, by its names, in the form of ``read_header``."""
    exif: dict[int, Any] = {tag: stated[name] for name, tag in _IN_XMP.items() if name in stated}
    exif[_PLANE_UNIT] = number_of(stated.get("FocalPlaneResolutionUnit", 2))
    below = stated.get("GPSAltitudeRef", "").strip().lower()
    gps: dict[int, Any] = {_ALT: stated.get("GPSAltitude"), _ALT_REF: int(below.startswith(("1", "below")))}
    for name, tag, reference in (("GPSLatitude", _LAT, _LAT_REF), ("GPSLongitude", _LON, _LON_REF)):
        text = stated.get(name, "").strip()  # 48,21.1367N or 48,21,8N; some write -48.352278
        body = text.rstrip("NSEWnsew")
        gps[tag], gps[reference] = [*body.split(","), "0", "0"][:3], text[len(body) :]
    top = {tag: stated[name] for name, tag in (("Make", _MAKE), ("Model", _MODEL)) if name in stated}
    return {**top, _ORIENTATION: stated.get("Orientation"), _EXIF_IFD: exif, _GPS_IFD: gps}


def number_of(value: Any) -> float | None:
    """Returns a finite number, or None: EXIF has rationals with zero below, XMP any text and fractions."""
    try:
        above, is_fraction, below = value.partition("/") if isinstance(value, str) else (value, "", "")
        number = float(above) / float(below) if is_fraction else float(above)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def _byte(value: Any) -> Any:
    """Returns the number of a single byte, which some formats have as such already."""
    return value[0] if isinstance(value, bytes) and len(value) == 1 else value


def _positive(value: Any) -> float | None:
    number = number_of(value)
    return number if number is not None and number > 0 else None


def _text(value: Any) -> str:
    text = value.decode("ascii", "replace") if isinstance(value, bytes) else str(value or "")
    return text.split("\0", 1)[0].strip()
