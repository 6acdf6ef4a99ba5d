"""What every pose format is read into, and how their files are read and their faults named."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from lodbench.errors import DatasetError, LodbenchError
from lodbench.geometry import Camera, Pose
from lodbench.storage.json_text import parse_json

# What poses by latitude and longitude declare.
DEGREES_CRS = "EPSG:4326"


class FoundPose(NamedTuple):
    """A posed image of a file.

    Attributes:
        name: As written.
        where: The file and line it stood at.
        pose: World to camera.
        camera: Intrinsics of the picture, lens distortion included; None where the format has none.
        crs: Reference system of the pose as its file declares it; None where it declares none.
            In ``EPSG:4326`` its centre is longitude, latitude (degrees) and height in the city's heights,
            and it is turned against true north: see ``pose_files.brought``.
        no_camera: Why ``camera`` is None, where the format has one for each image.
    """

    name: str
    where: str
    pose: Pose
    camera: Camera | None = None
    crs: str | None = None
    no_camera: str = ""


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
    seen: set[str] = set()
    for name in names:
        if not name or any(letter in forbidden for letter in name):
            raise DatasetError(
                f"The image name {name!r} cannot be written as {format_name}.", "Rename the image."
            )
        if name in seen:
            raise DatasetError(f"Two images are called {name!r}.", "Export one split at a time.")
        seen.add(name)
