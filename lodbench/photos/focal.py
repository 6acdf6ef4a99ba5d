"""From a drone photo's EXIF to a focal length in pixels; what no camera can have is not believed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

from lodbench.photos.metadata import PhotoMetadata

# Sensors, millimetres: widths as published by DJI with the drones, heights by the shape of whole photos.
_SMALL, _ONE_INCH, _FOUR_THIRDS, _FULL = (6.17, 4.6275), (13.2, 8.8), (17.3, 12.975), (35.9, 35.9 * 2 / 3)
_SENSOR_MM = {  # by EXIF's model
    "FC220": _SMALL,  # Mavic Pro, 1/2.3 inch
    "FC330": _SMALL,  # Phantom 4
    "FC300X": _SMALL,  # Phantom 3
    "FC350": _SMALL,  # Zenmuse X3
    "FC550": _FOUR_THIRDS,  # Zenmuse X5, 4/3 inch
    "FC6310": _ONE_INCH,  # Phantom 4 Pro, 1 inch
    "FC6310S": _ONE_INCH,
    "FC6310R": _ONE_INCH,  # Phantom 4 RTK
    "FC6510": _ONE_INCH,  # Zenmuse X4S
    "FC6520": _FOUR_THIRDS,  # Zenmuse X5S
    "L1D-20C": _ONE_INCH,  # Mavic 2 Pro
    "L2D-20C": _FOUR_THIRDS,  # Mavic 3
    "FC3411": _ONE_INCH,  # Air 2S
    "M3E": _FOUR_THIRDS,  # Mavic 3 Enterprise
    "ZENMUSEP1": _FULL,
}
# Diagonals of the sensors behind DJI's lenses, millimetres: the above, X7, 1/1.3, 1/1.7 and 1/2 inch.
_DIAGONALS_MM = (43.1, 28.2, 21.6, 15.9, 12.1, 9.3, 8.0, 7.7)
# Pixels of drones' thermal cameras, millimetres; shapes of their pictures, of which some wider are enlarged.
_THERMAL_PIXELS_MM, _THERMAL_SHAPES, _THERMAL_WIDTH = (0.012, 0.017), (1.24, 1.32), 640
# Widths of drones' sensors, from mobile phones' to medium format, with a margin.
_SENSOR_WIDTH_MM = (3.0, 55.0)
# A sensor's pixels are square; the widths of one that is known, as stated and as published; one by its lens.
_SQUARE, _SAME_SENSOR, _SAME_DIAGONAL = 0.06, 0.15, 0.03
# The shortest lens of a drone that takes pictures without a fisheye's distortion, as an equivalent.
_WIDEST_MM = 18.0
# The diagonal of the 36 x 24 mm picture that "35 mm equivalent" means.
_DIAGONAL_35MM = math.hypot(36.0, 24.0)
# DJI writes the equivalent of the whole sensor, 4:3 where the table above has no other, into photos of 16:9,
# which show all of its width, too: by the definition a photo of 24 mm would have 26 mm then.
_WIDE, _WHOLE_HEIGHT = 1.6, 3.0 / 4.0
# How far a lens's nominal focal length is from its own, and the error of a whole millimetre, as deviations.
NOMINAL_PERCENT, _ROUNDED_MM = 1.0, 0.5 / math.sqrt(3.0)
# Focal lengths in pixels and as an equivalent differ by less, unless one is of another picture or lens.
_LIKE = 0.3


class Focal(NamedTuple):
    """A focal length.

    Attributes:
        fx: Pixels.
        fy: Pixels.
        source: ``focal_plane``, ``sensor``, ``field_of_view`` or ``35mm``.
        percent: Its standard deviation.
    """

    fx: float
    fy: float
    source: str
    percent: float = NOMINAL_PERCENT


def focal_lengths(photo: PhotoMetadata, width: int, height: int) -> Iterator[Focal]:
    """Yields the focal lengths that a photo of so many pixels states but for its calibration, best first.

    A digital zoom multiplies the lens's focal length. Whether the 35 mm equivalent holds it differs among
    DJI's cameras: see ``_zooms``. Others' do, by the definition.
    """
    if photo.focal_mm is not None:
        focal_mm = photo.focal_mm * photo.digital_zoom
        pixel = _pixel_mm(photo, width, height)
        if pixel is not None:
            yield Focal(focal_mm / pixel[0], focal_mm / pixel[1], "focal_plane")
        by_sensor = by_known_sensor(photo, width, height)
        if by_sensor is not None:
            yield Focal(by_sensor, by_sensor, "sensor")
    if photo.field_across_deg is not None and photo.digital_zoom == 1.0:
        across = width / 2 / math.tan(math.radians(photo.field_across_deg) / 2)
        down = across
        if photo.field_down_deg is not None:
            down = height / 2 / math.tan(math.radians(photo.field_down_deg) / 2)
        if _is_near(across, down, _SQUARE):
            yield Focal(across, down, "field_of_view")
    equivalents = equivalents_px(photo, width, height)
    if photo.focal_35mm is not None and equivalents:
        middle = math.sqrt(equivalents[0] * equivalents[-1])
        rounded = 100.0 * _ROUNDED_MM / photo.focal_35mm
        percent = math.hypot(NOMINAL_PERCENT, rounded, 100.0 * (equivalents[-1] / middle - 1.0))
        yield Focal(middle, middle, "35mm", min(percent, 100.0))


def is_like_equivalent(photo: PhotoMetadata, focal_px: float, width: int, height: int) -> bool:
    """Tells whether a focal length fits the 35 mm equivalent, or there is none."""
    equivalents = equivalents_px(photo, width, height)
    return not equivalents or any(is_like(focal_px, equivalent) for equivalent in equivalents)


def is_like(focal_px: float, other_px: float) -> bool:
    """Tells whether two focal lengths may be of one lens and one picture."""
    return _is_near(focal_px, other_px, _LIKE)


def by_known_sensor(photo: PhotoMetadata, width: int, height: int) -> float | None:
    """Returns the focal length, pixels, before a sensor that is known by the camera's model; else None."""
    sensor_mm = _SENSOR_MM.get(photo.model.upper())
    if photo.focal_mm is None or sensor_mm is None:
        return None
    # Photos of another shape than the sensor's show all of its width or all of its height.
    per_mm = max(max(width, height) / sensor_mm[0], min(width, height) / sensor_mm[1])
    return photo.focal_mm * photo.digital_zoom * per_mm


def why_no_sensor(photo: PhotoMetadata, width: int, height: int) -> str:
    """Returns why EXIF's focal plane resolution is not believed, as a clause; "" where nothing speaks so."""
    if photo.pixel_mm is None or _pixel_mm(photo, width, height) is not None:
        return ""
    across, down = photo.pixel_mm[0] * width, photo.pixel_mm[1] * height
    return f"its focal plane resolution would be that of a sensor of {across:.3g} x {down:.3g} mm"


def equivalents_px(photo: PhotoMetadata, width: int, height: int) -> tuple[float, ...]:
    """Returns the focal lengths, pixels, rising, that the 35 mm equivalent may mean, if there is one."""
    if photo.focal_35mm is None:
        return ()
    longer, shorter = max(width, height), min(width, height)
    shown = (width, height)
    if _is_dji(photo) and longer > _WIDE * shorter:
        shown = (longer, round(longer * _WHOLE_HEIGHT))
    focal = photo.focal_35mm / _DIAGONAL_35MM * math.hypot(*shown)
    return tuple(focal * zoom for zoom in _zooms(photo, *shown))


def _zooms(photo: PhotoMetadata, width: int, height: int) -> tuple[float, ...]:
    """Returns by what the 35 mm equivalent may have to be multiplied, rising.

    DJI's zoomed photos state the equivalent with the zoom or without. Where only one of both leaves a lens
    and a sensor that drones have, that is meant; otherwise nobody knows.
    """
    zoom = photo.digital_zoom
    if zoom == 1.0 or not _is_dji(photo):
        return (1.0,)
    if photo.focal_mm is None or photo.focal_35mm is None:
        return (1.0, zoom)
    diagonals: tuple[float, ...] = _DIAGONALS_MM
    if _THERMAL_SHAPES[0] <= width / height <= _THERMAL_SHAPES[1]:
        enlarged = (1.0,) if width <= _THERMAL_WIDTH else (1.0, 2.0)
        whole = [math.hypot(width, height) / by for by in enlarged]
        diagonals = tuple(pixels * pixel_mm for pixels in whole for pixel_mm in _THERMAL_PIXELS_MM)
    fitting = []
    for factor, lens_35mm in ((1.0, photo.focal_35mm / zoom), (zoom, photo.focal_35mm)):
        diagonal = _DIAGONAL_35MM * photo.focal_mm / lens_35mm
        is_known = any(_is_near(diagonal, known, _SAME_DIAGONAL) for known in diagonals)
        if is_known and lens_35mm >= _WIDEST_MM:
            fitting.append(factor)
    return (fitting[0],) if len(fitting) == 1 else (1.0, zoom)


def _pixel_mm(photo: PhotoMetadata, width: int, height: int) -> tuple[float, float] | None:
    """Returns the size of a sensor's pixel by EXIF's focal plane resolution, if that can be one.

    Programs that scale photos leave it, makers write a display's 72 per inch, and those of thermal cameras
    the sensor's own size, which is believed where it is one of their pixels.
    """
    if photo.pixel_mm is None:
        return None
    across, down = photo.pixel_mm
    longer_mm = max(across * width, down * height)
    known = _SENSOR_MM.get(photo.model.upper())
    is_sensor = _SENSOR_WIDTH_MM[0] <= longer_mm <= _SENSOR_WIDTH_MM[1]
    is_own = known is None or _is_near(longer_mm, known[0], _SAME_SENSOR)
    if is_sensor and is_own and _is_near(across, down, _SQUARE):
        return photo.pixel_mm
    for unit_mm in (1.0, 10.0, 25.4):
        pixel = (unit_mm / across / width, unit_mm / down / height)
        if any(all(_is_near(side, known_mm, 0.01) for side in pixel) for known_mm in _THERMAL_PIXELS_MM):
            return pixel
    return None


def _is_dji(photo: PhotoMetadata) -> bool:
    """Tells whether a photo is of a drone of DJI, of whose cameras some are Hasselblad's."""
    return photo.make.upper() == "DJI" or photo.model.upper() in ("L1D-20C", "L2D-20C")


def _is_near(one: float, other: float, share: float) -> bool:
    return abs(math.log(one / other)) <= math.log1p(share)
