"""From a drone photo's metadata to its camera, by the best of what it states; photos without distortion.

A focal length in pixels comes from EXIF where nothing better is stated; what no camera can have is not
believed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import DatasetError
from lodbench.geometry import Camera, CameraSigmas
from lodbench.geometry.camera import CALIBRATED, MAKER, UNKNOWN, distort
from lodbench.photos.metadata import PhotoMetadata
from lodbench.photos.xmp import Dewarp

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
    """A focal length."""

    fx: float  # pixels
    fy: float  # pixels
    source: str  # ``focal_plane``, ``sensor``, ``field_of_view`` or ``35mm``
    percent: float = NOMINAL_PERCENT  # its standard deviation


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


# Sizes are whole pixels, so scaling changes the aspect a little; cropping changes it more.
_ASPECT_TOLERANCE = 0.01
# Shapes of whole sensors: photos of 16:9 are cut out of them, and optical centres stated of the whole.
_SENSOR_SHAPES = (4.0 / 3.0, 3.0 / 2.0)
# A horizontal field of view beyond these, degrees, is a wrong number: fisheyes have no such focal length.
FIELD_DEG = (3.0, 150.0)
# Principal points are off the middle by less, as a share of half the picture.
_OFF_CENTER = 0.05


@dataclass(frozen=True, slots=True)
class PhotoCamera:
    """A camera and where its numbers came from."""

    camera: Camera  # of the picture as stored, lens distortion included where it is known
    source: str  # ``dewarp`` or ``calibrated``, by the maker; as of ``Focal``; or ``given`` by a person
    # Standard deviation of a focal length that is the lens's nominal one, percent, rounding included, or as a
    # person states it; None for a calibrated one
    lens_percent: float | None = None
    camera_sigmas: CameraSigmas = CALIBRATED  # standard deviations of all of its numbers


def camera_given(camera: Camera, sigmas: CameraSigmas | None) -> PhotoCamera:
    """Returns a camera that a person gave, with what they state of it."""
    known = sigmas or CALIBRATED
    return PhotoCamera(camera, "given", known.stated_focal_percent, known)


def camera_flag(width: int, height: int) -> str:
    """Returns the flag that gives the camera of a photo of this size, but for its focal length."""
    return f"`--camera 'SIMPLE_PINHOLE {width} {height} FOCAL_PX {width / 2:g} {height / 2:g}'`"


def require_photo_size(camera: Camera, name: str, width: int, height: int, *, is_video: bool = False) -> None:
    """Makes sure that intrinsics are of a photo as it is stored, or of a video's frames as they are shown.

    Raises:
        DatasetError: They are of a picture of another size.
    """
    if (camera.width, camera.height) != (width, height):
        raise DatasetError(
            f"The camera is of {camera.width} x {camera.height} pixels, {name} has {width} x {height}.",
            "Give the intrinsics of the frames as players show them: turned, where the video says so."
            if is_video
            else "Give the intrinsics of the photo as it is stored.",
        )


def states_focal_length(photo: PhotoMetadata) -> bool:
    """Tells whether a photo states anything that ``camera_from_photo`` can make a camera of."""
    return _calibrated_px(photo) is not None or any(focal_lengths(photo, photo.width, photo.height))


def why_no_focal_length(photo: PhotoMetadata) -> str:
    """Returns what a photo states that is no focal length, as a clause in brackets; "" for nothing."""
    reasons = [why_no_sensor(photo, photo.width, photo.height)]
    if _calibrated_px(photo) is not None and _picture(photo, photo.width, photo.height) is None:
        x, y = photo.optical_center_x_px, photo.optical_center_y_px
        reasons.append(
            f"its calibration has the optical centre {x:g}, {y:g}, which is of no picture of this shape"
        )
    clause = "; ".join(filter(None, reasons))
    return f" ({clause})" if clause else ""


def require_lens_picture(photo: PhotoMetadata) -> None:
    """Makes sure that a photo is what a lens has made, and no stitched panorama.

    Raises:
        DatasetError: It is one: no pinhole has taken it, whatever camera its tags repeat.
    """
    if photo.projection:
        raise DatasetError(
            f"{photo.name} is a panorama ({photo.projection}): no single camera has taken it.",
            "Take the photos that it was stitched of.",
        )


def camera_from_photo(photo: PhotoMetadata) -> PhotoCamera:
    """Returns the camera of a photo.

    Tried in order: DJI's calibration with its distortion (without it where the drone has undistorted the
    picture already), the maker's focal length in pixels, EXIF's focal length with the size of a pixel or with
    the width of a known sensor, a field of view, and the equivalent of a 35 mm camera, which is rounded to a
    millimetre and so good to a few percent. What no camera can have is passed over (``focal``).

    A digital zoom enlarges the middle of the lens's picture, and the maker's numbers, which are of the whole
    picture, are left out. The equivalent tells a photo that was scaled since by a program that also changed
    the size in EXIF, and the second lens of a drone whose table has the first; the calibration's optical
    centre tells a photo that was scaled, too, and by how much.

    Raises:
        DatasetError: The photo states none of them, or one that no camera has, was cropped or scaled, or is a
            panorama.
    """
    require_lens_picture(photo)
    width, height = _size_when_taken(photo)
    calibrated = _calibrated(photo, width, height)
    if calibrated is not None:
        return calibrated
    for fx, fy, source, percent in focal_lengths(photo, width, height):
        if source == "focal_plane":
            _require_own_pixels(photo, fx, width, height)
        if source == "35mm" or is_like_equivalent(photo, fx, width, height):
            camera = _checked(photo, Camera(width, height, fx, fy, width / 2, height / 2))
            return PhotoCamera(camera, source, percent, _sigmas(source, percent))
    zoomed = "" if photo.digital_zoom == 1.0 else ", taken with a digital zoom,"
    raise DatasetError(
        f"{photo.name}{zoomed} does not say its camera's focal length{why_no_focal_length(photo)}.",
        f"Give {camera_flag(photo.width, photo.height)}, or another of COLMAP's models.",
    )


def _size_when_taken(photo: PhotoMetadata) -> tuple[int, int]:
    """Returns the size that numbers in pixels belong to: another than the file's if it was scaled since."""
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


def _calibrated_px(photo: PhotoMetadata) -> tuple[float, float] | None:
    """Returns fx and fy of the maker's calibration; None where there is none, or the picture is zoomed."""
    if photo.digital_zoom != 1.0:
        return None
    if photo.dewarp is not None:
        return photo.dewarp.fx, photo.dewarp.fy
    focal = photo.calibrated_focal_px or 0.0
    return (focal, photo.calibrated_focal_y_px or focal) if focal > 0 else None


def _calibrated(photo: PhotoMetadata, width: int, height: int) -> PhotoCamera | None:
    """Returns the camera of the maker's calibration; None where there is none that is this picture's."""
    focal, picture = _calibrated_px(photo), _picture(photo, width, height)
    if focal is None or picture is None:
        return None
    scale, center = picture[0], picture[1:]
    fx, fy = (number / scale for number in focal)
    nominal = by_known_sensor(photo, width, height)
    if photo.focal_35mm is None and nominal is not None and not is_like(fx, nominal):
        return None
    _require_own_pixels(photo, fx, width, height)
    # The scale is as well known as the optical centre is in the middle.
    percent = None if scale == 1.0 else NOMINAL_PERCENT
    source = "calibrated" if photo.dewarp is None else "dewarp"
    camera = Camera(width, height, fx, fy, *center)
    camera = _checked(
        photo, camera if photo.dewarp is None else _dewarped(photo, photo.dewarp, scale, camera)
    )
    return PhotoCamera(camera, source, percent, _sigmas(source, percent))


def _dewarped(photo: PhotoMetadata, dewarp: Dewarp, scale: float, camera: Camera) -> Camera:
    """Returns a camera with the optical centre and, unless the drone has undone it, the distortion of DJI."""
    cx, cy = camera.width / 2 + dewarp.cx / scale, camera.height / 2 + dewarp.cy / scale
    if not (0 < cx < camera.width and 0 < cy < camera.height):
        raise DatasetError(
            f"{photo.name}: its calibration (DewarpData) has the optical centre {cx:.0f}, {cy:.0f}, outside "
            f"of {camera.width} x {camera.height} pixels.",
            f"Give {camera_flag(photo.width, photo.height)}.",
        )
    camera = replace(camera, cx=cx, cy=cy)
    if photo.is_dewarped or not any(dewarp.distortion):
        return camera
    return replace(camera, distortion=(*dewarp.distortion, 0.0, 0.0, 0.0), lens="FULL_OPENCV")


def _picture(photo: PhotoMetadata, width: int, height: int) -> tuple[float, float, float] | None:
    """Returns how the picture that was calibrated, whose middle is near its optical centre, became this one.

    Returns:
        How many of its pixels are one here, and the optical centre here; None if it was another picture. The
        centre is the middle where it is not stated, or the photo was turned since.
    """
    x, y = photo.optical_center_x_px, photo.optical_center_y_px
    if x is None or y is None:
        return 1.0, width / 2, height / 2
    shapes = [width / height, *(shape if width >= height else 1 / shape for shape in _SENSOR_SHAPES)]
    for across, down in ((x, y), (y, x)) if min(x, y) > 0 else ():
        for shape in shapes:
            whole = max(width, height * shape), max(height, width / shape)
            scales = 2 * across / whole[0], 2 * down / whole[1]
            if abs(math.log(scales[0] / scales[1])) > _OFF_CENTER:
                continue
            scale = (scales[0] + scales[1]) / 2
            scale = 1.0 if abs(math.log(scale)) <= _OFF_CENTER else scale
            if (across, down) != (x, y):
                return scale, width / 2, height / 2
            return scale, x / scale - (whole[0] - width) / 2, y / scale - (whole[1] - height) / 2
    return None


def _sigmas(source: str, lens_percent: float | None) -> CameraSigmas:
    if lens_percent is None:
        return replace(MAKER, source=source)
    focal_percent = max(UNKNOWN.focal_percent, round(lens_percent, 2))
    return replace(UNKNOWN, focal_percent=focal_percent, source=source)


def _require_own_pixels(photo: PhotoMetadata, focal_px: float, width: int, height: int) -> None:
    if not is_like_equivalent(photo, focal_px, width, height):
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


# Focal lengths tried, as multiples of the lens's own: wider would stretch the rim, narrower leave little.
_LEAST_ZOOM, _MOST_ZOOM = 0.6, 4.0
# Points along each side at which it is looked whether the photo reaches there.
_GRID = 65


def pinhole_of(camera: Camera) -> Camera:
    """Returns the widest pinhole of the same size whose every pixel the photo shows.

    Principal point and the ratio of the focal lengths stay. A pinhole comes back as it is. With every
    pixel shown there are no black corners, which a mask would count as "no building".

    Raises:
        DatasetError: There is no such pinhole: the parameters are those of no lens.
    """
    if not camera.distortion:
        return camera
    low, high = _LEAST_ZOOM, _MOST_ZOOM
    if not _is_shown(camera, high):
        raise DatasetError(
            f"The lens distortion of {camera.lens} {camera.distortion} cannot be undone: the picture folds.",
            "Check the order of the parameters.",
        )
    if _is_shown(camera, low):
        return _zoomed(camera, low)
    while high - low > 1e-4:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if _is_shown(camera, middle) else (middle, high)
    return _zoomed(camera, high)


def undistorted(picture: NDArray[Any], camera: Camera, pinhole: Camera) -> NDArray[Any]:
    """Returns a picture as the pinhole shows it, of the same shape and type, linearly interpolated.

    Args:
        picture: (H, W) or (H, W, 3), of any size: the cameras are scaled to it.
        camera: The lens the picture was taken with.
        pinhole: From ``pinhole_of``.
    """
    import cv2

    if not camera.distortion:
        return picture
    height, width = picture.shape[:2]
    source = _source_pixels(camera.scaled(width, height), pinhole.scaled(width, height))
    # OpenCV counts from pixel centres, COLMAP from corners. A mask may be half a pixel short: repeat it.
    x, y = ((axis - 0.5).astype(np.float32) for axis in source)
    result = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(result)


def _zoomed(camera: Camera, zoom: float) -> Camera:
    return replace(camera.without_distortion(), fx=camera.fx * zoom, fy=camera.fy * zoom)


def _source_pixels(
    camera: Camera, pinhole: Camera, x: NDArray[Any] | None = None, y: NDArray[Any] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns where the lens's picture shows the pinhole's pixels, COLMAP's coordinates.

    Args:
        camera: The lens.
        pinhole: The pinhole, of the same size.
        x: Columns to look at, COLMAP's coordinates; the centres of all by default.
        y: Rows, likewise.
    """
    x = np.arange(pinhole.width) + 0.5 if x is None else x
    y = np.arange(pinhole.height) + 0.5 if y is None else y
    ray_x, ray_y = np.meshgrid((x - pinhole.cx) / pinhole.fx, (y - pinhole.cy) / pinhole.fy)
    distorted_x, distorted_y = distort(camera.lens, camera.distortion, ray_x, ray_y)
    return camera.fx * distorted_x + camera.cx, camera.fy * distorted_y + camera.cy


def _is_shown(camera: Camera, zoom: float) -> bool:
    """Tells whether the photo shows a whole pinhole, once each way round: polynomials fold back far out."""
    width, height = camera.width, camera.height
    columns, rows = np.linspace(0, width, _GRID), np.linspace(0, height, _GRID)
    x, y = _source_pixels(camera, _zoomed(camera, zoom), columns, rows)
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        return False
    inside = (x.min() >= 0) and (x.max() <= width) and (y.min() >= 0) and (y.max() <= height)
    (dx_down, dx_right), (dy_down, dy_right) = np.gradient(x), np.gradient(y)
    return bool(inside and (dx_right * dy_down - dx_down * dy_right > 0).all())
