"""From a drone photo's metadata to its camera, by the best of what it states."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from lodbench.datasets.camera_faults import FIELD_DEG
from lodbench.datasets.photo_metadata import PhotoMetadata
from lodbench.datasets.photo_xmp import Dewarp
from lodbench.errors import DatasetError
from lodbench.geometry import Camera

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
# The diagonal of the 36 x 24 mm picture that "35 mm equivalent" means.
_DIAGONAL_35MM = math.hypot(36.0, 24.0)
# DJI writes the equivalent of the whole sensor, 4:3 where the table above has no other, into photos of 16:9,
# which show all of its width, too: by the definition a photo of 24 mm would have 26 mm then.
_WIDE, _WHOLE_HEIGHT = 1.6, 3.0 / 4.0
# Sizes are whole pixels, so scaling changes the aspect a little; cropping changes it more.
_ASPECT_TOLERANCE = 0.01
# How far a lens's nominal focal length is from its own, and the error of a whole millimetre, as deviations.
_NOMINAL_PERCENT, _ROUNDED_MM = 1.0, 0.5 / math.sqrt(3.0)
# Focal lengths in pixels and as an equivalent differ by less, unless one is of another picture or lens.
_EQUIVALENT_TOLERANCE = 1.3


@dataclass(frozen=True, slots=True)
class PhotoCamera:
    """A camera and where its numbers came from.

    Attributes:
        camera: Of the picture as stored, lens distortion included where it is known.
        source: ``dewarp``, ``calibrated``, ``focal_plane``, ``sensor`` or ``35mm``; or ``given`` by a person.
        lens_percent: Standard deviation of a focal length that is the lens's nominal one, percent, rounding
            included; None for a calibrated one.
    """

    camera: Camera
    source: str
    lens_percent: float | None = None


def camera_flag(width: int, height: int) -> str:
    """Returns the flag that gives the camera of a photo of this size, but for its focal length."""
    return f"--camera 'SIMPLE_PINHOLE {width} {height} FOCAL_PX {width / 2:g} {height / 2:g}'"


def require_photo_size(camera: Camera, name: str, width: int, height: int) -> None:
    """Makes sure that intrinsics are of a photo or a frame as it is stored.

    Raises:
        DatasetError: They are of a picture of another size.
    """
    if (camera.width, camera.height) != (width, height):
        raise DatasetError(
            f"The camera is of {camera.width} x {camera.height} pixels, {name} has {width} x {height}.",
            "Give the intrinsics of the photo as it is stored.",
        )


def states_focal_length(photo: PhotoMetadata) -> bool:
    """Tells whether a photo states anything that ``camera_from_photo`` can make a camera of."""
    is_whole = photo.digital_zoom == 1.0
    in_pixels = photo.dewarp is not None or (photo.calibrated_focal_px or 0.0) > 0
    has_sensor = photo.pixel_mm is not None or photo.model.upper() in _SENSOR_MM
    in_mm = photo.focal_mm is not None and has_sensor
    return (is_whole and in_pixels) or in_mm or photo.focal_35mm is not None


def camera_from_photo(photo: PhotoMetadata) -> PhotoCamera:
    """Returns the camera of a photo.

    Tried in order: DJI's calibration with its distortion (without it where the drone has undistorted
    the picture already), DJI's focal length in pixels, EXIF's focal length with the size of a pixel,
    with the width of a known sensor, and as the equivalent of a 35 mm camera, which is rounded to a
    millimetre and so good to a few percent.

    A digital zoom enlarges the middle of the lens's picture. So it multiplies EXIF's focal length, and DJI's
    numbers, which are of the whole picture, are left out. The equivalent has the photo's field of view
    by its definition, zoom included. So it tells a photo that was scaled since by a program that also
    changed the size in EXIF, and the second lens of a drone whose table has the first. DJI's of a photo of
    16:9 is that of the whole sensor.

    Raises:
        DatasetError: The photo states none of them, or one that no camera has, or was cropped or scaled.
    """
    width, height = _size_when_taken(photo)
    if photo.digital_zoom != 1.0:
        photo = replace(
            photo,
            dewarp=None,
            calibrated_focal_px=None,
            optical_center_x_px=None,
            optical_center_y_px=None,
        )
    if photo.dewarp is not None:
        _require_own_pixels(photo, photo.dewarp.fx, width, height)
        return PhotoCamera(_checked(photo, _dewarped(photo, photo.dewarp, width, height)), "dewarp")
    fx, fy, source = _focal_px(photo, width, height)
    cx = width / 2 if photo.optical_center_x_px is None else photo.optical_center_x_px
    cy = height / 2 if photo.optical_center_y_px is None else photo.optical_center_y_px
    if not (0 < cx < width and 0 < cy < height):
        cx, cy = width / 2, height / 2
    return PhotoCamera(
        _checked(photo, Camera(width, height, fx, fy, cx, cy)), source, _lens_percent(photo, source)
    )


def _size_when_taken(photo: PhotoMetadata) -> tuple[int, int]:
    """Returns the size that numbers in pixels belong to: another than the file's if it was scaled since.

    Raises:
        DatasetError: It was cropped since: nobody knows where in the lens's picture it lies.
    """
    if photo.size_when_taken is None or not all(photo.size_when_taken):
        return photo.width, photo.height
    width, height = photo.size_when_taken
    if _is_same_shape(width, height, photo):
        return width, height
    if not _is_same_shape(height, width, photo):
        raise DatasetError(
            f"{photo.name} was cropped since it was taken: {width} x {height} then, "
            f"{photo.width} x {photo.height} now.",
            f"Take the photo as it was stored, or give {camera_flag(photo.width, photo.height)}.",
        )
    return photo.width, photo.height


def _is_same_shape(width: int, height: int, photo: PhotoMetadata) -> bool:
    return abs(width * photo.height / (height * photo.width) - 1) < _ASPECT_TOLERANCE


def _dewarped(photo: PhotoMetadata, dewarp: Dewarp, width: int, height: int) -> Camera:
    numbers = (dewarp.fx, dewarp.fy, width / 2 + dewarp.cx, height / 2 + dewarp.cy)
    if not (0 < numbers[2] < width and 0 < numbers[3] < height):
        raise DatasetError(
            f"{photo.name}: DewarpData puts the optical centre {dewarp.cx:.0f}, {dewarp.cy:.0f} px from the "
            f"middle of {width} x {height}, which is outside the photo.",
            f"Give {camera_flag(photo.width, photo.height)}.",
        )
    if photo.is_dewarped or not any(dewarp.distortion):
        return Camera(width, height, *numbers)
    return Camera(width, height, *numbers, (*dewarp.distortion, 0.0, 0.0, 0.0), "FULL_OPENCV")


def _focal_px(photo: PhotoMetadata, width: int, height: int) -> tuple[float, float, str]:
    """Returns fx and fy in pixels, and what they were made from."""
    if photo.calibrated_focal_px is not None and photo.calibrated_focal_px > 0:
        _require_own_pixels(photo, photo.calibrated_focal_px, width, height)
        return photo.calibrated_focal_px, photo.calibrated_focal_px, "calibrated"
    if photo.focal_mm is not None and photo.pixel_mm is not None:
        focal_mm = photo.focal_mm * photo.digital_zoom
        _require_own_pixels(photo, focal_mm / photo.pixel_mm[0], width, height)
        return focal_mm / photo.pixel_mm[0], focal_mm / photo.pixel_mm[1], "focal_plane"
    sensor_mm = _SENSOR_MM.get(photo.model.upper())
    if photo.focal_mm is not None and sensor_mm is not None:
        # Photos of another shape than the sensor's show all of its width or all of its height.
        per_mm = max(max(width, height) / sensor_mm[0], min(width, height) / sensor_mm[1])
        focal = photo.focal_mm * photo.digital_zoom * per_mm
        if _is_like_equivalent(photo, focal, width, height):
            return focal, focal, "sensor"
    equivalent = _equivalent_px(photo, width, height)
    if equivalent is not None:
        return equivalent, equivalent, "35mm"
    zoomed = "" if photo.digital_zoom == 1.0 else ", taken with a digital zoom,"
    raise DatasetError(
        f"{photo.name}{zoomed} does not say its camera's focal length.",
        f"Give {camera_flag(photo.width, photo.height)}, or another of COLMAP's models.",
    )


def _lens_percent(photo: PhotoMetadata, source: str) -> float | None:
    if source == "calibrated":
        return None
    if source != "35mm" or photo.focal_35mm is None:
        return _NOMINAL_PERCENT
    return math.hypot(_NOMINAL_PERCENT, 100.0 * _ROUNDED_MM / photo.focal_35mm)


def _equivalent_px(photo: PhotoMetadata, width: int, height: int) -> float | None:
    if photo.focal_35mm is None:
        return None
    longer, shorter = max(width, height), min(width, height)
    if photo.make.upper() == "DJI" and longer > _WIDE * shorter:
        width, height = longer, round(longer * _WHOLE_HEIGHT)
    return photo.focal_35mm / _DIAGONAL_35MM * math.hypot(width, height)


def _is_like_equivalent(photo: PhotoMetadata, focal_px: float, width: int, height: int) -> bool:
    """Tells whether a focal length fits the 35 mm equivalent; with a digital zoom some drones' does not."""
    equivalent = _equivalent_px(photo, width, height)
    if equivalent is None or photo.digital_zoom != 1.0:
        return True
    return abs(math.log(focal_px / equivalent)) <= math.log(_EQUIVALENT_TOLERANCE)


def _require_own_pixels(photo: PhotoMetadata, focal_px: float, width: int, height: int) -> None:
    if not _is_like_equivalent(photo, focal_px, width, height):
        raise DatasetError(
            f"{photo.name}: a focal length of {focal_px:.0f} px is not of {width} x {height} pixels, by its "
            f"35 mm equivalent of {photo.focal_35mm:g} mm: it was scaled since it was taken.",
            f"Take the photo as it was stored, or give {camera_flag(photo.width, photo.height)}.",
        )


def _checked(photo: PhotoMetadata, camera: Camera) -> Camera:
    field = math.degrees(2 * math.atan(camera.width / (2 * camera.fx)))
    if not FIELD_DEG[0] <= field <= FIELD_DEG[1]:
        raise DatasetError(
            f"{photo.name}: a focal length of {camera.fx:.0f} px sees {field:.1f} degrees; no photo does.",
            f"Give {camera_flag(photo.width, photo.height)}.",
        )
    return camera if camera.width == photo.width else camera.scaled(photo.width, photo.height)
