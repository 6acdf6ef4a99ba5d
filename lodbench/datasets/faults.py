"""What is wrong with datasets: the codes of findings; cameras, photos, masks and poses that do not fit.

``lodbench dataset check`` and the notes of runs name findings by their codes: LB50x files and names, LB51x
frames and poses, LB52x what the check looks at besides, LB53x and LB54x parts that contradict each other. An
ERROR makes queries fail or results wrong, a WARNING puts them in doubt, INFO states what was decided. A code
never changes its meaning and is never reused.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.datasets.pose_text import inverted
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import DatasetError
from lodbench.findings import Severity, catalogue_of, graded
from lodbench.geometry import Camera, Pose
from lodbench.photos.camera import FIELD_DEG
from lodbench.photos.pictures import picture_size

_E, _W, _I = graded(Severity.ERROR), graded(Severity.WARNING), graded(Severity.INFO)

FILE_MISSING = _E(500, "A file that a run needs is not there.")
SPLIT_MISSING = _W(501, "The folder of a split is not there; the split is left out.")
NOT_IN_SPLIT = _I(502, "A pose is not listed in the split's file; it is not a query.")
NO_TRUTH = _E(503, "A query has no true pose; it is excluded from recall.")
NO_PRIOR = _E(504, "A query has no prior; it fails.")
NO_CAMERA = _E(505, "A query has no intrinsics; it fails.")
NO_IMAGE = _W(506, "A query has no photo; segmenters that need one fail on it.")
SEVERAL_PRIORS = _I(507, "A query has several prior lines; the first is its prior, all are hypotheses.")
STEM_AMBIGUOUS = _W(508, "One per-image file fits the names of two queries, with and without _img.")
FILE_CHOSEN = _I(509, "Several files could be the priors; the first known one is read.")
TURNED_TO_ENU = _I(510, "Shifted earth-centred coordinates are transformed to east, north, up.")
FRAME_ASSUMED = _W(511, "The frame is clear from neither walls nor cameras; east, north, up is assumed.")
FRAMES_DIFFER = _W(512, "City and poses are in different frames; each is transformed separately.")
POSES_DISAGREE = _W(513, "The text file and the per-image file hold different poses; the latter counts.")
SAME_POSE = _W(514, "Two queries have exactly the same true pose: one is a wrong copy.")
WRONG_DIRECTION = _E(515, "Poses see the city only if read as camera to world: they need inverting.")
CITY_NOT_IN_VIEW = _W(516, "No building of the city model is in view from a true pose.")
BELOW_CITY = _W(517, "A camera lies below the lowest point of the city model.")
NAME_DISAGREES = _W(518, "The height or attitude in a synthetic image's name differs from its pose.")
COUNT_UNEXPECTED = _W(
    520, "The number of queries in a split differs from what the paper's percentages imply."
)
CHECKSUM_DIFFERS = _W(521, "A file is not the published one: its SHA-256 differs.")
IMAGE_SIZE = _E(522, "The size of an image differs from its intrinsics.")
IMAGE_UNREADABLE = _E(523, "An image cannot be read, or has too many pixels to be one.")
GPS_IN_IMAGE = _W(524, "A photo carries its GPS position; strip it before you publish the photo.")
PRIORS_UNLIKE_PAPER = _W(525, "The priors' median errors differ from the paper's by more than 10 %.")
MASK_UNFIT = _E(
    526, "A mask, or labels of buildings, cannot be read, or its aspect ratio is not the photo's."
)
CRS_DIFFERS = _E(527, "Dataset and city model have different reference systems.")
PRIOR_FAR = _E(528, "A prior lies kilometres outside the city model; its query fails.")
KEY_TWICE = _E(529, "Duplicate names of queries in a split; nothing runs on them.")
FIELD_OF_VIEW = _E(530, "A camera's field of view is implausible; its query fails.")
PRINCIPAL_EXCHANGED = _E(531, "A camera's cx and cy are exchanged; its query fails.")
PRINCIPAL_POINT = _W(532, "A camera's principal point is far from the middle of the photo.")
FOCAL_UNLIKE_PHOTO = _W(533, "The focal length in a photo's EXIF differs from its camera's.")
CAMERA_UNLIKE_VIEW = _E(
    534, "A mask or photo fits the city from its true pose only with different intrinsics."
)
MASK_TURNED = _E(535, "A mask fits the city from its true pose only mirrored, turned or inverted.")
MASK_EXCHANGED = _E(536, "A mask belongs to another query: it fits the city from that one's true pose.")
MASK_UNLIKE_CITY = _W(537, "A mask fits the city poorly from its true pose: pose, mask or map is wrong.")
PHOTO_TWICE = _E(538, "Queries with different poses have the same photo.")
PHOTO_EXCHANGED = _E(
    539, "A photo belongs to another query: its edges fit the city from that one's true pose."
)
TRUTH_LIKE_PLAN = _W(540, "True poses are as regular as a flight plan; those of real flights are not.")
TRUTH_OFF_GPS = _W(541, "True poses are far from their photos' GPS positions.")
PHOTO_UNLIKE_CITY = _W(542, "Photos show no edges at the city's outlines from the true poses.")
UNLIKE_RECONSTRUCTION = _W(
    543, "A true pose differs from the dataset's reconstruction, or that cannot be read."
)
READING_INFERRED = _I(
    544, "Something that the dataset's documentation does not state was inferred from the data."
)
READING_CONTRADICTED = _W(
    545, "The data contradicts a setting for something that its documentation does not state."
)
HEIGHTS_UNLIKE = _E(
    546, "Cameras are not as high above the city's ground as they can be: another vertical datum."
)

CATALOGUE = catalogue_of(globals())


# Beyond this a mask shows another part of the scene; ``check_mask`` holds the decoded ones to the same.
_ASPECT_TOLERANCE = 0.02


def photo_fault(entry: Entry) -> str:
    """Returns why a query's photo cannot be used; "" if it can, or if there is none."""
    if entry.image is None or entry.camera is None:
        return ""
    size, camera = picture_size(entry.image), (entry.camera.width, entry.camera.height)
    if size is None:
        return f"the photo {entry.image.name} cannot be read"
    if size != camera:
        return f"the photo is {size[0]} x {size[1]}, its intrinsics are of {camera[0]} x {camera[1]}"
    return ""


def mask_fault(mask: Path, size: tuple[int, int]) -> str:
    """Returns why a mask's file does not fit a photo of some width and height; "" if it does."""
    mask_size = picture_size(mask)
    if mask_size is None:
        return f"the mask {mask.name} cannot be read"
    return aspect_fault(mask_size, size)


def aspect_fault(mask_size: tuple[int, int], size: tuple[int, int]) -> str:
    """Returns why a mask of some width and height does not fit a photo of another; "" if it does."""
    width, height = mask_size
    apart = abs((width / height) / (size[0] / size[1]) - 1.0)
    # Sides are whole: of a photo a few pixels wide, rounding alone changes the aspect by more.
    if apart > max(_ASPECT_TOLERANCE, 0.5 / width, 0.5 / height):
        return f"the mask is {width} x {height}, the photo {size[0]} x {size[1]}: another aspect"
    return ""


def is_decodable(path: Path) -> bool:
    """Tells whether all of a picture is there; unlike OpenCV, Pillow does not pass a cut-off file."""
    from PIL import Image

    try:
        # The header has been read: beyond the warning, but not beyond the error.
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            # JPEG: an eighth of the size, which still reads the file to its end.
            image.draft("L", (max(1, image.width // 8), max(1, image.height // 8)))
            image.load()
    except Exception:  # Pillow lets the errors of its decoders through
        return False
    return True


# Pixels are square, to this factor.
_SQUARE = 1.5
# Principal points lie this near the middle, as a share of the side, and in no whole photo beyond the second.
_NEAR, _FAR = 0.05, 0.1
_CROPPED = 0.25


def field_fault(camera: Camera) -> str:
    """Returns why a camera's focal length is none of a photo; "" if it may be."""
    field = math.degrees(2 * math.atan(camera.width / (2 * camera.fx)))
    if not FIELD_DEG[0] <= field <= FIELD_DEG[1]:
        in_mm = " (is it in millimetres?)" if field > FIELD_DEG[1] else ""
        return f"a focal length of {camera.fx:.4g} px sees {field:.0f} degrees; no photo does{in_mm}"
    if not 1 / _SQUARE < camera.fx / camera.fy < _SQUARE:
        return f"fx is {camera.fx:.4g} and fy {camera.fy:.4g} px; pixels are square"
    return ""


def exchange_fault(camera: Camera) -> str:
    """Returns why cx and cy of a camera are exchanged; "" if they are not."""
    exchanged = Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cy, camera.cx)
    if _off_middle(camera) > _FAR and _off_middle(exchanged) < _NEAR:
        return f"cx {camera.cx:.4g} and cy {camera.cy:.4g} of {camera.width} x {camera.height} are exchanged"
    return ""


def camera_fault(camera: Camera) -> str:
    """Returns why no photo was taken by a camera; "" if one may have been."""
    return field_fault(camera) or exchange_fault(camera)


def crop_doubt(camera: Camera) -> str:
    """Returns why a camera can only be of a crop; "" if it need not."""
    if _off_middle(camera) <= _CROPPED:
        return ""
    return f"cx {camera.cx:.4g}, cy {camera.cy:.4g} of {camera.width} x {camera.height}"


def _off_middle(camera: Camera) -> float:
    """Returns how far a principal point is from the middle, as a share of the side: the larger of both."""
    return max(abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5))


Points = NDArray[np.float64]

# Corners of a city and poses of a dataset that are looked at: enough to tell, whatever their number.
_MAX_CORNERS, _MAX_POSES = 20_000, 60
# Poses are wrong if hardly any sees the city as given, and nearly all do the other way.
_HARDLY_ANY, _NEARLY_ALL = 0.2, 0.8


def sample_corners(scene: Scene) -> Points:
    """Returns (N, 3) corners of a city, evenly through its buildings, in ``scene``'s frame."""
    step = -(-len(scene.vertices) // _MAX_CORNERS)
    return scene.vertices[:: max(step, 1)].astype(np.float64)


def sees(camera: Camera, pose: Pose, corners: Points) -> bool:
    """Tells whether any of (N, 3) points lies in a picture."""
    pixels = camera.without_distortion().project(corners @ pose.rotation.T + pose.translation)
    # NaN, behind the camera, is never within.
    with np.errstate(invalid="ignore"):
        inside = (pixels >= 0) & (pixels <= (camera.width, camera.height))
    return bool(inside.all(axis=1).any())


def require_direction(dataset: Dataset, entries: Sequence[Entry], scene: Scene) -> None:
    """Makes sure that true poses and priors are not camera to world where world to camera is meant.

    Args:
        dataset: The dataset; poses are in its frame.
        entries: The queries to look at.
        scene: The city, whose origin is in the same frame.

    Raises:
        DatasetError: They see the city only when read in the other direction.
    """
    corners = sample_corners(scene)
    truth = [(entry.camera, dataset.truth.get(entry.key)) for entry in entries]
    priors = [(entry.camera, entry.prior) for entry in entries]
    for what, pairs in (("true poses", truth), ("priors", priors)):
        words = suspect_direction(pairs, corners, scene.origin)
        if words is not None:
            raise DatasetError(
                f"The {what} of {dataset.name} are the wrong way round: {words}.",
                "Text poses are world to camera (x_cam = R x_world + t); invert them.",
            )


def suspect_direction(
    pairs: Iterable[tuple[Camera | None, Pose | None]], corners: Points, origin: Points
) -> str | None:
    """Returns in words that poses see a city only if they are inverted, or None.

    Args:
        pairs: Cameras and poses; where one is missing the pair is left out.
        corners: (N, 3) points of the city less its origin.
        origin: (3,) of the city in the poses' frame.
    """
    known = [(camera, pose) for camera, pose in pairs if camera is not None and pose is not None]
    known = known[:: max(1, len(known) // _MAX_POSES)]
    if not known:
        return None
    given = sum(sees(camera, pose.shifted(-origin), corners) for camera, pose in known)
    if given > _HARDLY_ANY * len(known):
        return None
    other = sum(sees(camera, inverted(pose).shifted(-origin), corners) for camera, pose in known)
    if other < _NEARLY_ALL * len(known):
        return None
    return f"{given} of {len(known)} see the city as given, {other} if read camera to world"
