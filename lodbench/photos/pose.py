"""From a drone photo's metadata to a rough pose in the city's coordinates.

The steps, and what each is wrong by if it is left out: WGS 84 to the city's datum and projection
(anything), true to grid north (up to 3 degrees in UTM), heights above the ellipsoid to those of the
city (up to 100 m), the gimbal's roll about the optical axis (what it is).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, cast, get_args

from lodbench.errors import ConfigError, DatasetError, Words, nearest_names, require_within
from lodbench.geometry import Pose
from lodbench.geometry.angles import rotation_from_dji
from lodbench.photos.camera import camera_flag, require_lens_picture, states_focal_length, why_no_focal_length
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.metadata import PhotoMetadata

_AUTEL, _PARROT, _SKYDIO = "AUTEL", "PARROT", "SKYDIO"
# Parrot: "with reference to the WGS84 ellipsoid", on other models the EGM96 geoid (embedded photo metadata).
_ELLIPSOIDAL_PARROTS = "anafiai"
# What Pix4D's VertCS says beside codes of EPSG.
_ELLIPSOIDAL = "ellipsoidal"


def is_above_ellipsoid(photo: PhotoMetadata) -> bool:
    """Tells whether a photo's altitude is above the WGS 84 ellipsoid, and not above sea level.

    So it is where an RTK receiver measured it, where XMP says so (``VertCS``), and on Parrot's Anafi Ai.
    Autel's drones write ``VertCS`` of heights above sea level, too, and are not believed.
    """
    if photo.has_rtk:
        return True
    if _is_by(photo, _PARROT) and _plain(photo.model).startswith(_ELLIPSOIDAL_PARROTS):
        return True
    return photo.vertical_reference.lower() == _ELLIPSOIDAL and not _is_by(photo, _AUTEL)


def height_doubt(photo: PhotoMetadata) -> str:
    """Returns why an altitude that is not known to be above the ellipsoid may be; "" for no reason."""
    if is_above_ellipsoid(photo):
        return ""
    if photo.is_single_point:
        return "an RTK receiver without corrections, RtkFlag 16"
    if _is_by(photo, _AUTEL):
        return "Autel's drones differ"
    if _is_by(photo, _SKYDIO) and not photo.vertical_reference:
        return "Skydio's drones differ"
    return "GPSAltitudeRef changed its meaning with EXIF 3.0" if photo.is_exif3_height else ""


def _is_by(photo: PhotoMetadata, maker: str) -> bool:
    return photo.make.upper().startswith(maker)


def _plain(name: str) -> str:
    return "".join(letter for letter in name.lower() if letter.isalnum())


# What says of many photos where each was taken.
START_OF_EACH = "`--start FILE` with a rough pose of each photo by its name"
HeightSource = Literal["auto", "sea_level", "ellipsoid", "takeoff"]


@dataclass(frozen=True, slots=True)
class HeightOptions:
    """How a drone's heights become the city's.

    Raises:
        ConfigError: The source is unknown or lacks the take-off height, a height is not finite, or one is
            given that the source does not use.
    """

    # ``sea_level``: the absolute altitude is taken as it stands, as that of a drone without RTK is meant.
    # ``ellipsoid``: it is above the WGS 84 ellipsoid, as with RTK. ``takeoff``: the relative altitude above
    # ``takeoff_m``. ``auto``: takeoff where ``takeoff_m`` is given, else ellipsoid where ``source_for`` says
    # so, else sea_level.
    source: HeightSource = "auto"
    takeoff_m: float | None = None  # height of the take-off point, in the city's heights
    geoid_m: float | None = None  # height of the city's zero above the ellipsoid there; None asks PROJ
    offset_m: float = 0.0  # added in the end, whatever the height came from

    def __post_init__(self) -> None:
        if self.source not in get_args(HeightSource):
            raise ConfigError(
                f"`heights={self.source}` is unknown.", nearest_names(self.source, get_args(HeightSource))
            )
        if self.source == "takeoff" and self.takeoff_m is None:
            raise ConfigError(
                "Heights above the take-off point need its own height.", "Give `--takeoff METRES`."
            )
        require_within("--takeoff", self.takeoff_m, -math.inf)
        require_within("--geoid", self.geoid_m, -math.inf)
        require_within("--height-offset", self.offset_m, -math.inf)
        self._require_used()

    def _require_used(self) -> None:
        used = "takeoff" if self.source == "auto" and self.takeoff_m is not None else self.source
        for name, value, users in (
            ("--takeoff", self.takeoff_m, ("auto", "takeoff")),
            ("--geoid", self.geoid_m, ("auto", "ellipsoid")),
        ):
            if value is not None and used not in users:
                why = f"--heights {self.source}" if self.source != "auto" else "--takeoff"
                own = "takeoff" if name == "--takeoff" else "ellipsoid"
                hint = f"Leave `{name}` or `{why}` out; `--heights {own}` uses `{name}`."
                raise ConfigError(f"`{name}` is not used with `{why}`.", hint)

    def source_for(self, photo: PhotoMetadata) -> str:
        """Returns the source that counts for a photo."""
        if self.source != "auto":
            return self.source
        if self.takeoff_m is not None:
            return "takeoff"
        return "ellipsoid" if is_above_ellipsoid(photo) else "sea_level"


@dataclass(frozen=True, slots=True)
class RoughPlace:
    """A rough pose in the terms of gimbals and maps; what is given here goes before the photo's own.

    Raises:
        ConfigError: The place is not on Earth, or a number is not finite.
    """

    latitude_deg: float | None = None  # WGS 84
    longitude_deg: float | None = None  # WGS 84
    height_m: float | None = None  # in the city's heights
    heading_deg: float | None = None  # clockwise from true north
    pitch_deg: float | None = None  # 0 at the horizon, -90 straight down
    roll_deg: float | None = None  # about the optical axis

    def __post_init__(self) -> None:
        require_within("--lat", self.latitude_deg, -90, 90)
        require_within("--lon", self.longitude_deg, -360, 360)
        require_within("--height", self.height_m, -math.inf)
        require_within("--heading", self.heading_deg, -math.inf)
        require_within("--pitch", self.pitch_deg, -180, 180)
        require_within("--roll", self.roll_deg, -360, 360)


class PoseNotStated(DatasetError):
    """Neither a photo nor anybody else says where it was taken, or what for a pose is needed besides.

    Args:
        message: As of ``LodbenchError``.
        hint: Likewise, of one photo.
        hint_for_many: What to do where it is one of many.
    """

    def __init__(self, message: str, hint: str, hint_for_many: str) -> None:
        super().__init__(message, hint)
        self.hint_for_many = Words(hint_for_many)


def require_stated(
    photo: PhotoMetadata,
    heights: HeightOptions | None = None,
    given: RoughPlace | None = None,
    *,
    knows_place: bool = False,
    knows_look: bool = False,
    knows_camera: bool = True,
) -> None:
    """Makes sure that all that a rough pose needs is in a photo or given.

    Args:
        photo: What the photo states.
        heights: How the drone's heights become the city's.
        given: What is known better, or not in the photo.
        knows_place: Whether the place is known from elsewhere.
        knows_look: Whether the angles are.
        knows_camera: Whether the camera is.

    Raises:
        PoseNotStated: Something is missing; the one message names all of it, the hint the options for it.
        DatasetError: It is a panorama.
    """
    require_lens_picture(photo)
    given = given or RoughPlace()
    lacking: list[tuple[str, str]] = []
    if not knows_place:
        if _first(given.latitude_deg, photo.latitude_deg) is None or (
            _first(given.longitude_deg, photo.longitude_deg) is None
        ):
            lacking.append(("where it was taken", "`--lat` and `--lon`"))
        source = (heights or HeightOptions()).source_for(photo)
        if given.height_m is None and _stated_height(photo, source) is None:
            kind = "above its take-off point" if source == "takeoff" else "absolute"
            lacking.append((f"how high it was ({kind})", "`--height`, in the city's heights"))
    states_look = None not in (
        _first(given.heading_deg, photo.gimbal_yaw_deg),
        _first(given.pitch_deg, photo.gimbal_pitch_deg),
    )
    if not knows_look and not states_look:
        looks = "`--heading` and `--pitch` (0 at the horizon, -90 straight down)"
        angles = photo.why_no_angles or "gimbal angles of DJI, Autel, Parrot or Skydio"
        lacking.append((f"where its camera looked ({angles})", looks))
    many = [_flags_for_many([flags for _, flags in lacking])] if lacking else []
    if not knows_camera and not states_focal_length(photo):
        many.append(camera_flag(photo.width, photo.height))
        lacking.append((f"its camera's focal length{why_no_focal_length(photo)}", many[-1]))
    if lacking:
        what, flags = (_listed(words) for words in zip(*lacking, strict=True))
        local = "" if knows_place else " For a city without a reference system give `--center EAST NORTH UP`."
        fault = f": {photo.xmp_fault}" if photo.xmp_fault else ""
        raise PoseNotStated(
            f"{photo.name} does not say {what}{fault}.",
            f"lodbench localize takes {flags}.{local}",
            f"lodbench localize takes {_listed(many)}.",
        )


def _flags_for_many(flags: Sequence[str]) -> str:
    """Returns the options for photos that lack what these say of one: a place can only be of one photo."""
    if any("--lat" in each for each in flags):
        return START_OF_EACH
    return f"{_listed(flags)}, the same for all, or {START_OF_EACH}"


def _listed(words: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(words[:-1]), words[-1]]))


def _stated_height(photo: PhotoMetadata, source: str) -> float | None:
    return photo.relative_altitude_m if source == "takeoff" else photo.altitude_m


def pose_from_photo(
    photo: PhotoMetadata,
    frame: MapFrame,
    heights: HeightOptions | None = None,
    given: RoughPlace | None = None,
) -> Pose:
    """Returns the pose that a photo's metadata states, in the city's coordinates.

    Args:
        photo: What the photo states.
        frame: The city's coordinates.
        heights: How the drone's heights become the city's.
        given: What is known better, or not in the photo.

    Raises:
        DatasetError: The position, a height or the heading is neither in the photo nor given; or the
            height cannot be converted.
    """
    given = given or RoughPlace()
    require_stated(photo, heights, given)
    latitude, longitude = latitude_longitude_of(photo, given)
    east, north = frame.east_north(latitude, longitude)
    height = given.height_m
    options = heights or HeightOptions()
    if height is None:
        height = _height(photo, frame, options, latitude, longitude)
    height += options.offset_m
    return pose_at((east, north, height), frame.convergence_deg(east, north), photo, given)


def latitude_longitude_of(photo: PhotoMetadata, given: RoughPlace) -> tuple[float, float]:
    """Returns latitude and longitude of a photo of which both are stated or given, degrees, WGS 84."""
    latitude = cast("float", _first(given.latitude_deg, photo.latitude_deg))
    return latitude, cast("float", _first(given.longitude_deg, photo.longitude_deg))


def pose_at(
    center: tuple[float, float, float],
    convergence_deg: float,
    photo: PhotoMetadata,
    given: RoughPlace | None = None,
) -> Pose:
    """Returns the pose at a known place in the city's coordinates, looking as the photo or the user says.

    Args:
        center: East, north, up, metres.
        convergence_deg: Clockwise angle from true to grid north there; 0 where headings are the grid's.
        photo: What the photo states.
        given: Angles that are known better.

    Raises:
        DatasetError: The heading or the pitch is neither in the photo nor given.
    """
    given = given or RoughPlace()
    require_stated(photo, given=given, knows_place=True)
    yaw = cast("float", _first(given.heading_deg, photo.gimbal_yaw_deg))
    pitch = cast("float", _first(given.pitch_deg, photo.gimbal_pitch_deg))
    roll = _first(given.roll_deg, photo.gimbal_roll_deg) or 0.0
    return Pose.from_center(rotation_from_dji(yaw, pitch, roll, convergence_deg), center)


def _height(
    photo: PhotoMetadata, frame: MapFrame, options: HeightOptions, latitude: float, longitude: float
) -> float:
    source = options.source_for(photo)
    stated = cast("float", _stated_height(photo, source))
    if source == "takeoff" and options.takeoff_m is not None:
        height = options.takeoff_m + stated
    elif source == "ellipsoid" and options.geoid_m is not None:
        height = stated - options.geoid_m
    elif source == "ellipsoid":
        height = frame.height_from_ellipsoid(latitude, longitude, stated)
    else:
        height = stated
    return height


def _first(given: float | None, stated: float | None) -> float | None:
    return stated if given is None else given
