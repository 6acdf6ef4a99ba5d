"""What a drone photo states: EXIF of any camera, XMP of some makers, a video's subtitles; without its pixels.

Nothing here is converted: degrees, metres and pixels are as the file states them. What they mean for
a pose and a height is in ``pose``, for a camera in ``camera``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from lodbench.errors import DatasetError
from lodbench.photos.tags import exif_values, number_of, place_of, read_header
from lodbench.photos.xmp import Dewarp, LaserRange, xmp_values


@dataclass(frozen=True, slots=True)
class PhotoMetadata:
    """What a photo states; None for what it does not."""

    name: str  # file name
    width: int  # pixels, of the stored picture, whatever ``orientation`` says
    height: int  # pixels
    make: str = ""  # maker of the camera
    model: str = ""  # model of the camera
    orientation: int = 1  # EXIF's turn for display, 1 for none
    # Width and height that EXIF states; scaling a photo often leaves them
    size_when_taken: tuple[int, int] | None = None
    taken_at: str = ""  # local time as written, ``2023:10:18 11:46:19``
    taken_fraction_s: float | None = None  # of the second of ``taken_at``
    latitude_deg: float | None = None  # WGS 84; XMP's value, which has more digits, before EXIF's
    longitude_deg: float | None = None  # likewise
    # Absolute altitude, metres, above what the drone takes for sea level, or above the ellipsoid
    # (``HeightOptions``)
    altitude_m: float | None = None
    relative_altitude_m: float | None = None  # height above the take-off point, metres
    gimbal_yaw_deg: float | None = None  # clockwise from true north
    gimbal_pitch_deg: float | None = None  # 0 at the horizon, -90 straight down
    gimbal_roll_deg: float | None = None  # about the optical axis
    why_no_angles: str = ""  # what XMP states instead of the gimbal's angles, as a clause; "" for nothing
    focal_mm: float | None = None  # focal length, millimetres
    # Focal length of a 36 x 24 mm camera with the same diagonal field of view
    focal_35mm: float | None = None
    # Width and height of a sensor's pixel, millimetres (EXIF's focal plane resolution)
    pixel_mm: tuple[float, float] | None = None
    # What part of the lens's picture the photo shows enlarged: 2 for a half; 1 for all of it
    digital_zoom: float = 1.0
    field_across_deg: float | None = None  # horizontal field of view
    field_down_deg: float | None = None  # vertical field of view
    calibrated_focal_px: float | None = None  # the maker's focal length in pixels, of DJI by design
    calibrated_focal_y_px: float | None = None  # the same along y, where that is another
    optical_center_x_px: float | None = None  # the maker's principal point, pixels, of DJI by design
    optical_center_y_px: float | None = None  # likewise
    dewarp: Dewarp | None = None  # DJI's calibration with lens distortion
    is_dewarped: bool = False  # the drone has undistorted the picture already
    has_rtk: bool = False  # the height is that of an RTK receiver, above the ellipsoid
    # An RTK receiver had no corrections, and nothing says whether the height is its own
    is_single_point: bool = False
    vertical_reference: str = ""  # what XMP says that the altitude is above (``VertCS``)
    # The altitude is EXIF's, above the ellipsoid by version 3.0, above sea level before
    is_exif3_height: bool = False
    # How a stitched panorama was laid flat, ``equirectangular``; "" for a lens's picture
    projection: str = ""
    xmp_fault: str = ""  # why XMP that is there cannot be read, in words; "" where it can
    laser: LaserRange | None = None  # what DJI's laser measured, where its status is normal
    # (6,) standard deviations of x, y, z (metres), pitch, roll and yaw (degrees) by the receiver and the
    # gimbal; None where nobody states one
    sigmas: tuple[float | None, ...] = (None,) * 6
    refused: tuple[str, ...] = ()  # why measurements that XMP states are none, in clauses

    @property
    def has_position(self) -> bool:
        """Tells whether the photo says where it was taken (privacy: this goes with the file)."""
        return self.latitude_deg is not None and self.longitude_deg is not None

    @property
    def is_turned(self) -> bool:
        """Tells whether a program turned the pixels by 90 degrees since: the gimbal is that of before."""
        if self.size_when_taken is None or self.width == self.height:
            return False
        width, height = self.size_when_taken
        return (width > height) == (self.width < self.height)


def read_photo_metadata(path: str | Path) -> PhotoMetadata:
    """Returns what a photo's header states; numbers that are none are taken as absent.

    Raises:
        DatasetError: The file cannot be read, is no JPEG, PNG or TIFF, or has too many pixels to be a photo.
            XMP that is malformed or holds a DOCTYPE is a fault only of who needs it: ``xmp_fault``.
    """
    path = Path(path)
    size, exif, xmp = read_header(path)
    stated, fault = exif_values(exif), ""
    try:
        stated = _with_xmp(stated, *xmp_values(path, xmp)) if xmp else stated
    except DatasetError as error:
        fault = error.message.rstrip(".")
    known = {field.name for field in fields(PhotoMetadata)}
    return PhotoMetadata(
        name=path.name,
        width=size[0],
        height=size[1],
        xmp_fault=fault,
        **{name: value for name, value in stated.items() if name in known and value is not None},
    )


def _with_xmp(exif: dict[str, Any], xmp: dict[str, Any], repeated: dict[str, Any]) -> dict[str, Any]:
    """Returns what all state, makers' XMP first; what EXIF says of an altitude goes with its own."""
    known = {name: value for name, value in exif.items() if value not in (None, "")}
    stated = exif | repeated | known | xmp
    if "altitude_m" in xmp:
        stated["is_exif3_height"] = False
    return stated


# The first second: what a drone does not know of its first frame, it knows soon.
_FIRST_CUES, _MOST_BYTES = 30, 1 << 16
_PRY = ("pitch", "roll", "yaw")
_NUMBER = r"[-+]?\d+(?:\.\d+)?"
# ``[rel_alt: 80.1 abs_alt: 203.4]``, and ``BAROMETER:80.1`` of older drones.
_NAMED = re.compile(rf"([A-Za-z_]+) ?: ?({_NUMBER})(?![\d/])")
_NAMES = {
    "latitude": "latitude_deg",
    "longitude": "longitude_deg",
    "longtitude": "longitude_deg",  # so misspelt by older firmware
    "abs_alt": "altitude_m",
    "rel_alt": "relative_altitude_m",
    "barometer": "relative_altitude_m",
    **{f"{gimbal}_{angle}": f"gimbal_{angle}_deg" for gimbal in ("gb", "gimbal") for angle in _PRY},
}
# Older drones' lists: ``GPS(LONGITUDE,LATITUDE,...)``, and ``G.PRY (PITCH, ROLL, YAW)`` of the gimbal.
_GPS = re.compile(rf"\bGPS ?\( ?({_NUMBER}), ?({_NUMBER})\b")
_GIMBAL = re.compile(rf"\bG\.PRY ?\( ?({_NUMBER})°?, ?({_NUMBER})°?, ?({_NUMBER})")
_ANGLES = tuple(f"gimbal_{angle}_deg" for angle in _PRY)


def find_subtitles(video: Path) -> Path | None:
    """Returns the file of subtitles beside a video; None where there is none."""
    beside = (video.with_suffix(suffix) for suffix in (".SRT", ".srt"))
    return next((path for path in beside if path.is_file()), None)


def stated_at_start(subtitles: Path, video: PhotoMetadata) -> PhotoMetadata:
    """Returns what subtitles state of a video's first frame, each number as soon as it is stated.

    A film's, which state nothing of it, leave the video as it is.

    Args:
        subtitles: As of ``find_subtitles``.
        video: Its name and size.
    """
    with subtitles.open("rb") as stream:
        text = stream.read(_MOST_BYTES).decode("utf-8", "replace")
    stated: dict[str, Any] = {}
    # Texts of subtitles follow a line of times.
    for cue in (part.partition("\n")[2] for part in text.split("-->")[1 : 1 + _FIRST_CUES]):
        stated = _stated(cue) | stated
    if not any(stated.get(name) for name in _ANGLES):  # zeros, wherever it looks
        stated = {name: value for name, value in stated.items() if name not in _ANGLES}
    if not stated:  # of a film
        return video
    return PhotoMetadata(video.name, video.width, video.height, make="DJI", **stated)


def _stated(cue: str) -> dict[str, float]:
    named = ((_NAMES.get(name.lower()), number_of(number)) for name, number in _NAMED.findall(cue))
    stated = {name: number for name, number in named if name is not None and number is not None}
    if match := _GPS.search(cue):
        stated |= {"longitude_deg": float(match[1]), "latitude_deg": float(match[2])}
    if match := _GIMBAL.search(cue):
        stated |= dict(zip(_ANGLES, map(float, match.groups()), strict=True))
    return stated | place_of(stated.pop("latitude_deg", None), stated.pop("longitude_deg", None))
