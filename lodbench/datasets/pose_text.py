"""Text poses and cameras, what every pose format is read into, and how files' faults are named.

Lines are ``name qw qx qy qz tx ty tz`` and ``name MODEL W H params...``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple, TypeVar

from lodbench.errors import DatasetError, LodbenchError
from lodbench.geometry import Camera, CameraSigmas, Pose
from lodbench.geometry.camera import split_sigmas
from lodbench.photos.measurements import Measurements, parse_measurements
from lodbench.storage.json_text import parse_json

T = TypeVar("T")

# No place on Earth is further from the origin of its CRS.
_MAX_COORDINATE_M = 1e8
_POSE_LAYOUT = "name qw qx qy qz tx ty tz"
_CAMERA_LAYOUT = "name PINHOLE W H fx fy cx cy"


def read_poses(path: str | Path) -> dict[str, Pose]:
    """Returns world-to-camera poses by image name, from lines ``name qw qx qy qz tx ty tz``.

    A folder before the name (``query/``) is dropped. Empty lines and lines starting with # are
    skipped.

    Raises:
        DatasetError: The file cannot be read, or a line is malformed, repeats a name or holds a
            coordinate beyond 1e8 m; the message names the line.
    """
    return _only_ones(Path(path), _parse_place, _POSE_LAYOUT)


def read_hypotheses(path: str | Path) -> dict[str, tuple[Pose, ...]]:
    """Returns all world-to-camera poses of each image, in the order of the lines; a name may occur often.

    Raises:
        DatasetError: As for ``read_poses``, but for the repeated name.
    """
    hypotheses: dict[str, tuple[Pose, ...]] = {}
    for _, name, pose in _read_lines(Path(path), _parse_place, _POSE_LAYOUT):
        hypotheses[name] = (*hypotheses.get(name, ()), pose)
    return hypotheses


def read_cameras(path: str | Path) -> dict[str, Camera]:
    """Returns cameras by image name, from lines ``name MODEL W H params...`` (COLMAP's models).

    Raises:
        DatasetError: As for ``read_poses``.
    """
    return {name: camera for name, (camera, _) in read_known_cameras(path).items()}


def read_known_cameras(path: str | Path) -> dict[str, tuple[Camera, CameraSigmas | None]]:
    """Returns cameras, and how well they are known where a line says so after the parameters.

    Raises:
        DatasetError: As for ``read_poses``.
    """
    return _only_ones(Path(path), parse_camera, _CAMERA_LAYOUT)


def read_words(path: str | Path) -> dict[str, str]:
    """Returns one word by image name, from lines ``name word``: the flight of each photo, for example.

    Raises:
        DatasetError: As for ``read_poses``.
    """
    return _only_ones(Path(path), _only_word, "name sequence")


def read_percents(path: str | Path) -> dict[str, float]:
    """Returns one number above 0 by image name, from lines ``name percent``.

    Raises:
        DatasetError: As for ``read_poses``.
    """
    return _only_ones(Path(path), _only_percent, "name percent")


def read_measurements(path: str | Path) -> dict[str, Measurements]:
    """Returns what was measured beside each image by its name, from lines ``name east=0.02 range=81.2 ...``.

    Raises:
        DatasetError: As for ``read_poses``; or as for ``parse_measurements``, with the line.
    """
    return _only_ones(Path(path), parse_measurements, "name east=METRES range=METRES ...")


def format_pose(name: str, pose: Pose, decimals: tuple[int, int] | None = None) -> str:
    """Returns the line of a pose; its translation comes back to the last bit, its rotation to rounding.

    Args:
        name: Of the image.
        pose: World to camera.
        decimals: Of the quaternion and of the translation; None for as many as restore them.
    """
    if decimals is None:
        numbers = [repr(float(value)) for value in (*pose.quat_wxyz, *pose.translation)]
    else:
        numbers = [f"{value:.{decimals[0]}f}" for value in pose.quat_wxyz]
        numbers += [f"{value:.{decimals[1]}f}" for value in pose.translation]
    return " ".join([name, *numbers])


def format_camera(name: str, camera: Camera, sigmas: CameraSigmas | None = None) -> str:
    """Returns the line of a camera, with as many digits as restore it exactly, and how well it is known."""
    model, numbers = camera.to_colmap()
    known = [] if sigmas is None else sigmas.words()
    return " ".join([name, model, str(camera.width), str(camera.height), *(repr(v) for v in numbers), *known])


def lines_to_text(lines: Iterable[str]) -> str:
    """Returns lines as the text of a file."""
    return "".join(line + "\n" for line in lines)


def _only_word(words: list[str]) -> str:
    if len(words) != 1:
        raise LodbenchError(f"{len(words)} words after the name instead of 1")
    if PurePosixPath(words[0]).name != words[0] or words[0] == "..":
        # It names a file of the run's folder.
        raise LodbenchError(f"{words[0]} is no plain name")
    return words[0]


def _only_percent(words: list[str]) -> float:
    if len(words) != 1:
        raise LodbenchError(f"{len(words)} values after the name instead of 1")
    percent = float(words[0])
    if not 0 < percent <= 100:
        raise LodbenchError(f"{words[0]} is not within 0 to 100")
    return percent


def _only_ones(path: Path, parse: Callable[[list[str]], T], layout: str) -> dict[str, T]:
    """Returns what the lines say by name, each name once."""
    values: dict[str, T] = {}
    for number, name, value in _read_lines(path, parse, layout):
        if name in values:
            raise DatasetError(
                f"{path}, line {number}: the name {name} occurs twice.", f"Each line reads: {layout}"
            )
        values[name] = value
    return values


def _read_lines(path: Path, parse: Callable[[list[str]], T], layout: str) -> Iterator[tuple[int, str, T]]:
    """Yields number, name and value of each line."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise DatasetError(
            f"{path} cannot be read: {reason}.", f"A text file of lines {layout} is needed."
        ) from error
    except UnicodeDecodeError as error:
        raise DatasetError(f"{path} cannot be read: it is no UTF-8 text.", "Save it as UTF-8.") from error
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        words = line.split()
        try:
            value = parse(words[1:])
        except (LodbenchError, ValueError) as error:
            reason = str(error).rstrip(".")
            raise DatasetError(f"{path}, line {number}: {reason}.", f"Each line reads: {layout}") from error
        yield number, PurePosixPath(words[0]).name, value


def parse_pose(words: list[str]) -> Pose:
    """Returns the pose of the seven words ``qw qx qy qz tx ty tz``, world to camera.

    Raises:
        LodbenchError: There are fewer or more, or they are no pose.
        ValueError: A word is no number.
    """
    if len(words) != 7:
        raise LodbenchError(f"{len(words)} values after the name instead of 7")
    numbers = [float(word) for word in words]
    return Pose.from_quaternion(numbers[:4], numbers[4:])


def _parse_place(words: list[str]) -> Pose:
    """Returns the pose of ``parse_pose``, if it can be a place in a city."""
    pose = parse_pose(words)
    furthest = max((float(value) for value in pose.translation), key=abs)
    if abs(furthest) > _MAX_COORDINATE_M:
        raise LodbenchError(f"the coordinate {furthest:g} m is beyond {_MAX_COORDINATE_M:g} m")
    return pose


def parse_camera(words: list[str]) -> tuple[Camera, CameraSigmas | None]:
    """Returns the camera of the words ``MODEL W H params...`` (COLMAP's models), and how well it is known.

    The latter is None unless words such as ``sigma_f=0.5%`` say it, see ``split_sigmas``.

    Raises:
        LodbenchError: There are too few, the model is unknown, or they are no camera.
        ValueError: A word is no number.
    """
    words, sigmas = split_sigmas(words)
    if len(words) < 4:
        raise LodbenchError("too few values")
    numbers = [float(word) for word in words[3:]]
    return Camera.from_colmap(words[0], int(words[1]), int(words[2]), numbers), sigmas


# What poses by latitude and longitude declare.
DEGREES_CRS = "EPSG:4326"


class FoundPose(NamedTuple):
    """A posed image of a file."""

    name: str  # as written
    where: str  # the file and line it stood at
    pose: Pose  # world to camera
    # Intrinsics of the picture, lens distortion included; None where the format has none
    camera: Camera | None = None
    # Reference system of the pose as its file declares it; None where it declares none. In ``EPSG:4326`` its
    # centre is longitude, latitude (degrees) and height in the city's heights, and it is turned against true
    # north: see ``pose_files.brought``.
    crs: str | None = None
    no_camera: str = ""  # why ``camera`` is None, where the format has one for each image


def with_slashes(name: str) -> str:
    """Returns the name of an image with the folders that programs of Windows put backslashes between."""
    return name.replace("\\", "/")


def inverted(pose: Pose) -> Pose:
    """Returns the pose that the same matrix means in the other direction."""
    return Pose.from_matrix(pose.world_from_cam)


def numbers_of(pose: Pose) -> list[float]:
    """Returns ``qw qx qy qz tx ty tz``, world to camera."""
    return [*pose.quat_wxyz, *(float(v) for v in pose.translation)]


class LayoutGuard:
    """Names the place and the layout in whatever goes wrong inside a ``with`` block."""

    def __init__(self, where: str, layout: str) -> None:
        self._where, self._layout = where, layout

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type | None, error: BaseException | None, trace: object) -> None:
        """Turns a fault inside into one that names the place.

        Raises:
            DatasetError: Something inside was malformed.
        """
        is_fault = isinstance(error, LodbenchError | ValueError | KeyError | TypeError | ArithmeticError)
        if is_fault and not isinstance(error, DatasetError):
            reason = f"there is no {error}" if isinstance(error, KeyError) else str(error).rstrip(".")
            raise DatasetError(f"{self._where}: {reason}.", f"Expected: {self._layout}") from error


def read_text(path: Path) -> str:
    """Returns a UTF-8 text file.

    Raises:
        DatasetError: It cannot be read.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise DatasetError(
            f"{path} is not a text file.", "Poses are text: lines of numbers, for example."
        ) from error
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}.", "Check the path.") from error


def content(path: Path, keep_empty: bool = False) -> Iterator[tuple[str, str]]:
    """Yields the lines of a file that are no comments, each with its place.

    Raises:
        DatasetError: The file cannot be read.
    """
    for number, line in enumerate(read_text(path).split("\n"), start=1):
        if line.lstrip().startswith("#") or not (line.strip() or keep_empty):
            continue
        yield f"{path}, line {number}", line


def read_json(path: Path) -> dict[str, Any]:
    """Returns a JSON object.

    Raises:
        DatasetError: The file cannot be read, or is not a JSON object of finite numbers.
    """
    with LayoutGuard(str(path), "a JSON object"):
        value = parse_json(read_text(path), is_strict=True)
        if not isinstance(value, dict):
            raise ValueError("no JSON object")
    return value


def require_plain_names(names: list[str], forbidden: str, format_name: str) -> None:
    """Makes sure that a format can hold image names.

    Raises:
        DatasetError: A name holds a character that would end it, or occurs twice.
    """
    earlier: set[str] = set()
    for name in names:
        if not name or any(letter in forbidden for letter in name):
            raise DatasetError(
                f"The image name {name!r} cannot be written as {format_name}.", "Rename the image."
            )
        if name in earlier:
            raise DatasetError(f"Two images are called {name!r}.", "Export one split at a time.")
        earlier.add(name)
